"""Dynamics f + Δφ that can stand wherever f did: the model, not how it is fitted.

Wiedemann, Wuest et al. (2023), sect. IV-D, add a network to the whole next state: kind "state" here. Kinematics are
exact, though, so what is missing is a force or a torque: form "acceleration" learns that, and position, velocity
and attitude follow through the integrator. Both are exactly zero until they are fitted.
"""

import copy
import json
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, fields, replace

import torch
from torch import nn

from envs.errors import InputError
from policies.files import replacing

FORMAT = "apg-adapt residual 1"
SPEED = "speed"  # name of the factor


@dataclass(frozen=True)
class ResidualConfig:
    """Shape of a residual."""

    kind: str = "acceleration"
    hidden: int = 64  # width of the network; 0 is none
    activation: str = "tanh"  # of the network, see `Correction`
    context_names: tuple[str, ...] = ()  # inputs that are neither state nor action, such as the battery voltage
    factors: tuple[str, ...] = (SPEED,)  # the linear part also sees its inputs times each: the speed, or a context
    parameters: tuple[str, ...] = ()  # of the model that have other values, see `adapt.parameter_residual`


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
        from safetensors.torch import save

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
            temporary.write_bytes(save(tensors, {"format": FORMAT, "residual": json.dumps(said)}))


def casadi_step(state, action, following):
    """The function of a step, with the names of its input and output."""
    import casadi

    return casadi.Function("residual", [state, action], [following], ["state", "action"], ["next_state"])
