"""The residual of kind "acceleration": what is learned is a force or torque per inertia."""

from dataclasses import replace
from itertools import islice

import torch

from adapt.correction import Correction
from adapt.residual_dynamics import SPEED, ResidualDynamics, casadi_step
from envs.dynamics import TORCH, casadi_backend

TERMS = 40  # [-] weights up to which terms are cheaper than a matrix
NOTHING = ((0.0, ()),)  # the terms of an output that nothing is added to
SMALL = 1e-12  # [m^2/s^2] keeps the gradient of the speed finite at rest


class AccelerationResidual(ResidualDynamics):
    """A learned acceleration: linear in the translation-invariant inputs of the system, plus a network.

    The linear part also sees each input times the speed, because what air does grows with its square (a parasitic drag
    is linear in speed times velocity), and times each context, because that may change how the robot answers.

    The linear part acts inside the integrator, at each of its stages, as a disturbance does. So a drag or a payload is
    recovered exactly; a push held over the control period would have to learn how the velocity changes in it. The
    network's part is held over the period, which keeps it cheap.
    """

    def _build(self, generator):
        outputs, inputs = len(self.system.accelerations), len(self.system.residual_input_names)
        contexts = len(self.config.context_names)
        features = inputs * (1 + len(self.config.factors)) + contexts
        self.register_buffer("weights", torch.zeros(outputs, features, dtype=torch.float64))
        self.register_buffer("bias", torch.zeros(outputs, dtype=torch.float64))
        self.terms = None
        if self.config.hidden:
            self.network = Correction(inputs + contexts, outputs, self.config.hidden, generator, self.config.activation)

    def feature_names(self):
        """What each column of `weights` is multiplied with."""
        names = self.system.residual_input_names
        products = tuple(f"{factor} * {name}" for factor in self.config.factors for name in names)
        return (*names, *products, *self.config.context_names)

    def inputs(self, state, action):
        """What the network sees (..., p): `residual_inputs` of the system, then the context."""
        x, u = self._scalars(state, action)
        return torch.cat((TORCH.pack(tuple(self.system.residual_inputs(x, u))), self._context_for(state)), -1)

    def features(self, state, action):
        """What the linear part sees (..., f), in the order of `feature_names`."""
        return TORCH.pack(self._features(*self._scalars(state, action), self._context_for(state).unbind(-1)))

    def _scalars(self, state, action):
        return self.system.State(*state.unbind(-1)), self.system.Action(*action.unbind(-1))

    def _features(self, x, u, context, used=None):
        """The same as a list of scalars; what none of the columns `used` needs is not computed (None)."""
        count = len(self.system.residual_input_names)
        needed = count if used is None else max((c % count + 1 for c in used if c < self._context_column()), default=0)
        inputs = list(islice(self.system.residual_inputs(x, u), needed)) + [None] * (count - needed)
        values = dict(zip(self.config.context_names, context, strict=True))
        if SPEED in self.config.factors:
            values[SPEED] = (sum(v * v for v in self.system.velocity(x)) + SMALL).sqrt()
        pairs = [(values[factor], value) for factor in self.config.factors for value in inputs]
        wanted = enumerate(pairs, len(inputs))
        products = [a * b if used is None or column in used else None for column, (a, b) in wanted]
        return [*inputs, *products, *context]

    def _context_column(self):
        """The first column of the features that is a context."""
        return len(self.system.residual_input_names) * (1 + len(self.config.factors))

    def simplify(self):
        """Make a step as cheap as the fitted weights allow; later changes of them don't count.

        Factors that no output uses are left out. Few weights become terms of the equations instead of a matrix.
        """
        self._drop_factors()
        table = self.weights.tolist()
        if sum(value != 0 for row in table for value in row) <= TERMS:
            rows = (tuple((column, value) for column, value in enumerate(row) if value) for row in table)
            self.terms = tuple(zip(self.bias.tolist(), rows, strict=True))

    def _drop_factors(self):
        inputs = len(self.system.residual_input_names)
        blocks = self.weights[:, inputs : inputs * (1 + len(self.config.factors))].unflatten(-1, (-1, inputs))
        used = blocks.abs().sum((0, 2)) > 0
        rest = self.weights[:, inputs * (1 + len(self.config.factors)) :]
        self.weights = torch.cat((self.weights[:, :inputs], blocks[:, used].flatten(1), rest), -1)
        factors = tuple(name for name, on in zip(self.config.factors, used.tolist(), strict=True) if on)
        self.config = replace(self.config, factors=factors)

    def corrected(self, state, action):
        if self.network is None:
            return self.pushed(state, action)
        return self.pushed(state, action, self.network(self.inputs(state, action)))

    def pushed(self, state, action, push=None, share=1.0):
        """A `share` of a control period under the linear part and, if given, a `push` (..., k) held over it."""
        rates = None
        if push is not None:
            rates = self.system.residual_rates(self.system.State(*state.unbind(-1)), push.unbind(-1))
        dynamics = self._with_linear(self._context_for(state))
        if share != 1:
            dynamics = replace(dynamics, system=replace(dynamics.system, dt=share * dynamics.dt))
        return dynamics.advance(state, action, rates)

    def _with_linear(self, context):
        """The base with the linear part as one more disturbance; context (..., c) is constant in a step."""
        if self.terms is not None:
            return self._with(lambda x, u: self._sum_of_terms(x, u, context.unbind(-1)))
        weights, bias, context = self.weights.to(context.dtype), self.bias.to(context.dtype), context.unbind(-1)
        return self._with(lambda x, u: (TORCH.pack(self._features(x, u, context)) @ weights.T + bias).unbind(-1))

    def _with(self, force):
        """The base with `force`, a function of x and u, as one more disturbance."""
        if self.terms == NOTHING * len(self.system.accelerations):
            return self.base

        def learned(system, x, u):
            rates = system.residual_rates(x, force(x, u))
            return {name: rate for name, rate in rates.items() if not isinstance(rate, float) or rate}

        return replace(self.base, disturbances=(*self.base.disturbances, learned))

    def _sum_of_terms(self, x, u, context):
        features = self._features(x, u, context, {column for _, row in self.terms for column, _ in row})
        return [sum((value * features[column] for column, value in row), bias) for bias, row in self.terms]

    def casadi(self):
        import casadi

        context, backend = casadi.vertsplit(self._casadi_context()), casadi_backend()
        weights, bias = casadi.DM(self.weights.tolist()), casadi.DM(self.bias.tolist())
        base = self._with(lambda x, u: casadi.vertsplit(weights @ backend.pack(self._features(x, u, context)) + bias))
        (state, action), push = self._symbols(casadi.SX), casadi.SX.sym("push", len(self.bias))
        x, u = self.system.State(*casadi.vertsplit(state)), self.system.Action(*casadi.vertsplit(action))
        rates = None if self.network is None else self.system.residual_rates(x, casadi.vertsplit(push))
        following = base.advance(state, action, rates, backend)
        if self.network is None:
            return casadi_step(state, action, following)
        step = casadi.Function("pushed", [state, action, push], [following])
        inputs = casadi.Function("inputs", [state, action], [casadi.vertcat(*self.system.residual_inputs(x, u))])
        state, action = self._symbols(casadi.MX)
        seen = casadi.vertcat(inputs(state, action), *context)
        return casadi_step(state, action, step(state, action, self.network.casadi(seen)))
