"""The residual of kind "state": what is learned is added to the whole next state."""

import torch

from adapt.correction import Correction
from adapt.residual_dynamics import ResidualDynamics, casadi_step
from envs.dynamics import TORCH


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
        return casadi_step(state, action, project(self.base.casadi()(state, action) + added))
