"""Dynamics f + Δφ that can stand wherever f did: the model, not how it is fitted.

Wiedemann, Wuest et al. (2023), sect. IV-D, add a network to the whole next state: kind "state" here. Kinematics are
exact, though, so what is missing is a force or a torque: the default kind "acceleration" learns that, and position,
velocity and attitude follow through the integrator. Both are exactly zero until they are fitted.
"""

import copy
import json
import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, fields, replace
from itertools import islice

import torch
from torch import nn

from adapt.transitions import read_safetensors, replacing
from envs import make_system
from envs.dynamics import TORCH, Dynamics, casadi_backend
from envs.errors import InputError

FORMAT = "apg-adapt residual 1"
SPEED = "speed"  # name of the factor
TERMS = 40  # [-] weights up to which terms are cheaper than a matrix
NOTHING = ((0.0, ()),)  # the terms of an output that nothing is added to
SMALL = 1e-12  # [m^2/s^2] keeps the gradient of the speed finite at rest


class Correction(nn.Module):
    """A tanh network with one hidden layer; its last layer starts at zero, so that its output does and it can learn.

    (Were all layers zero, no gradient would reach any of them.) Tensors are buffers: a residual that a policy is tuned
    in must not collect gradients. They are kept in float64 and used in the dtype of what comes in.
    """

    def __init__(self, inputs, outputs, hidden, generator=None):
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        tensors = {
            "mean": torch.zeros(inputs),
            "scale": torch.ones(inputs),
            "first": torch.randn(hidden, inputs, generator=generator) / math.sqrt(inputs),
            "first_bias": torch.randn(hidden, generator=generator) / 2,
            "last": torch.zeros(outputs, hidden),
            "last_bias": torch.zeros(outputs),
            "size": torch.ones(outputs),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor.to(torch.float64))

    def forward(self, inputs):
        """Outputs (..., k) of inputs (..., p), both in physical units."""
        mean, scale, first, first_bias, last, last_bias, size = (t.to(inputs.dtype) for t in self.buffers())
        hidden = torch.tanh((inputs - mean) / scale @ first.T + first_bias)
        return size * (hidden @ last.T + last_bias)

    def casadi(self, inputs):
        """The same for a CasADi column, in whole matrices."""
        import casadi

        mean, scale, first, first_bias, last, last_bias, size = (casadi.DM(t.tolist()) for t in self.buffers())
        return size * (last @ casadi.tanh(first @ ((inputs - mean) / scale) + first_bias) + last_bias)


@dataclass(frozen=True)
class ResidualConfig:
    """Shape of a residual."""

    kind: str = "acceleration"
    hidden: int = 64  # width of the network; 0 is none
    context_names: tuple[str, ...] = ()  # inputs that are neither state nor action, such as the battery voltage
    factors: tuple[str, ...] = (SPEED,)  # the linear part also sees its inputs times each: the speed, or a context


class ResidualDynamics(nn.Module, ABC):
    """Dynamics of a base (the source) with a learned residual: `residual(state, action) -> next_state`.

    With `detach` set the value stays as it is and the gradient is that of the base alone.

    Args:
        base: the `Dynamics` that the residual completes.
        config: its shape.
        generator: draws the first layer of the network; None is a fresh one with seed 0.
    """

    def __init__(self, base, config, generator=None):
        super().__init__()
        self.base, self.config = base, config
        self.detach = False
        self.context = None
        self.network = None
        self._build(generator)

    @property
    def system(self):
        return self.base.system

    @property
    def dt(self):
        """Control period [s]."""
        return self.base.dt

    def with_context(self, context):
        """The same residual (weights shared) that sees `context` (..., c), broadcast over the states of a call."""
        context = torch.as_tensor(context)
        if context.shape[-1:] != (len(self.config.context_names),):
            expected = ", ".join(self.config.context_names) or "none"
            raise InputError(f"residual: context of shape {tuple(context.shape)}, expected the columns {expected}")
        fixed = copy.copy(self)
        fixed.context = context
        return fixed

    def forward(self, state, action):
        """Next state (..., n) of state (..., n) and action (..., m) in [-1, 1]."""
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        state, action = state.expand(*batch, -1), action.expand(*batch, -1)
        if not self.detach:
            return self.corrected(state, action)
        with torch.no_grad():
            value = self.corrected(state, action)
        following = self.base(state, action)
        return following + (value - following).detach()

    @abstractmethod
    def _build(self, generator):
        """Register the tensors of an unfitted residual."""

    @abstractmethod
    def corrected(self, state, action):
        """The next state (..., n) with its gradient; state and action have the same batch shape."""

    @abstractmethod
    def casadi(self):
        """The same step as a `casadi.Function` (state, action) -> next_state; a network stays in matrices (MX)."""

    def simplify(self):
        """Make a step as cheap as the fitted weights allow; later changes of them need not count."""

    def drop_network(self):
        """Remove a network that adds nothing: the residual is cheaper without."""
        self.network = None
        self.config = replace(self.config, hidden=0)

    def _context_for(self, state):
        """The context (..., c) for states (..., n); no columns where there is none."""
        if not self.config.context_names:
            return state[..., :0]
        if self.context is None:
            names = ", ".join(self.config.context_names)
            raise InputError(f"residual: it was fitted with {names}; give their values by with_context(values)")
        return self.context.to(state).expand(*state.shape[:-1], -1)

    def _casadi_context(self):
        import casadi

        context = self._context_for(torch.zeros(len(self.system.State._fields), dtype=torch.float64))
        return casadi.DM(context.tolist()) if context.numel() else casadi.DM.zeros(0, 1)

    def _symbols(self, kind):
        return kind.sym("state", len(self.system.State._fields)), kind.sym("action", len(self.system.Action._fields))

    def save(self, path):
        """Write weights and what is needed to make the same residual again; `load_residual` reads it.

        Raises:
            InputError: a base that isn't a source, or a place that can't be written.
        """
        from safetensors.torch import save_file

        if self.base.disturbances:
            raise InputError(f"{path}: this residual completes a model with disturbances, which can't be written")
        said = {
            "system": self.system.name,
            "parameters": {item.name: getattr(self.system, item.name) for item in fields(self.system)},
            "dynamics": {"integrator": self.base.integrator, "substeps": self.base.substeps},
            "config": asdict(self.config),
        }
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.state_dict().items()}
        with replacing(path) as temporary:
            save_file(tensors, temporary, {"format": FORMAT, "residual": json.dumps(said)})


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
            self.network = Correction(inputs + contexts, outputs, self.config.hidden, generator)

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
            return _casadi_step(state, action, following)
        step = casadi.Function("pushed", [state, action, push], [following])
        inputs = casadi.Function("inputs", [state, action], [casadi.vertcat(*self.system.residual_inputs(x, u))])
        state, action = self._symbols(casadi.MX)
        seen = casadi.vertcat(inputs(state, action), *context)
        return _casadi_step(state, action, step(state, action, self.network.casadi(seen)))


class StateResidual(ResidualDynamics):
    """The paper's form: a network of state and action added to the whole next state, which is then projected."""

    def _build(self, generator):
        states = len(self.system.State._fields)
        inputs = states + len(self.system.Action._fields) + len(self.config.context_names)
        if self.config.hidden:
            self.network = Correction(inputs, states, self.config.hidden, generator)

    def inputs(self, state, action):
        """What the network sees (..., p)."""
        return torch.cat((state, action, self._context_for(state)), -1)

    def corrected(self, state, action):
        following = self.base(state, action)
        if self.network is None:
            return following
        following = following + self.network(self.inputs(state, action))
        return TORCH.pack(self.system.project(self.system.State(*following.unbind(-1))))

    def casadi(self):
        import casadi

        if self.network is None:
            return self.base.casadi()
        state, action = self._symbols(casadi.SX)
        projected = casadi.vertcat(*self.system.project(self.system.State(*casadi.vertsplit(state))))
        project = casadi.Function("project", [state], [projected])
        state, action = self._symbols(casadi.MX)
        added = self.network.casadi(casadi.vertcat(state, action, self._casadi_context()))
        return _casadi_step(state, action, project(self.base.casadi()(state, action) + added))


RESIDUALS = {"acceleration": AccelerationResidual, "state": StateResidual}


def make_residual(base, config=ResidualConfig(), generator=None):
    """An unfitted residual, which equals its base.

    Raises:
        InputError: unknown kind.
    """
    if config.kind not in RESIDUALS:
        raise InputError(f"--residual {config.kind}: expected one of {', '.join(RESIDUALS)}")
    return RESIDUALS[config.kind](base, config, generator)


def load_residual(path, base=None):
    """Read what `ResidualDynamics.save` wrote.

    Args:
        base: the dynamics that it must complete; None makes them from the parameters in the file.

    Raises:
        InputError: a file that is missing, damaged or something else, or a residual of another system than `base`.
    """
    try:
        tensors, said = read_safetensors(path, FORMAT, "residual")
    except OSError as error:
        raise InputError(
            f"{path}: can't read a residual ({error.strerror or error}); name a file that exists"
        ) from error
    try:
        names = {name: tuple(said["config"][name]) for name in ("context_names", "factors")}
        config = ResidualConfig(**{**said["config"], **names})
        parameters = {k: tuple(v) if isinstance(v, list) else v for k, v in said["parameters"].items()}
        written = Dynamics(replace(make_system(said["system"]), **parameters), **said["dynamics"])
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: made by another version ({error}); fit the residual again") from error
    if base is not None and base.system != written.system:
        raise InputError(f"{path}: completes {_difference(written.system, base.system)}; fit one for this robot")
    residual = make_residual(base or written, config)
    try:
        residual.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path}: its tensors don't fit its description; write it again") from error
    residual.simplify()
    return residual


def _difference(written, expected):
    """What tells two systems apart, in words."""
    if written.name != expected.name:
        return f"{written.name}, expected {expected.name}"
    names = [item.name for item in fields(written) if getattr(written, item.name) != getattr(expected, item.name)]
    return ", ".join(f"{n} {getattr(written, n)}, expected {getattr(expected, n)}" for n in names)


def _casadi_step(state, action, following):
    import casadi

    return casadi.Function("residual", [state, action], [following], ["state", "action"], ["next_state"])
