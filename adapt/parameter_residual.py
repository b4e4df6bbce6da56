"""The residual of kind "parameters": the model's own equations, with named parameters changed and disturbances added.

White box: what is learned has a name, a unit and a standard error, and holds wherever the equations do.
"""

from dataclasses import fields, replace
from functools import partial

import torch

from adapt.residual_dynamics import ResidualDynamics
from envs.domains import DISTURBANCES, SCALAR
from envs.errors import InputError

AXES = "xyz"


def own_parameters(system):
    """{name: value} of the numeric fields of a system that can be refitted; the control period is agreed on."""
    values = {item.name: getattr(system, item.name) for item in fields(system) if item.name != "dt"}
    return {name: value for name, value in values.items() if isinstance(value, float)}


def candidates(system):
    """Names of what can be refitted: numeric fields of the system, and strengths of disturbances by axis."""
    own = tuple(own_parameters(system))
    forces = [name for name in DISTURBANCES if name != "wind"]  # a steady wind is a push, or a field of the system
    strengths = [(name,) for name in forces if name in SCALAR]
    strengths += [tuple(f"{name}_{axis}" for axis in AXES) for name in forces if name not in SCALAR]
    return (*own, *(part for parts in strengths for part in parts))


def nominal(system, name):
    """The value of a parameter in the model; disturbances have none there."""
    return own_parameters(system).get(name, 0.0)


class ParameterResidual(ResidualDynamics):
    """The base with other values of the parameters that `config.parameters` names, and of its disturbances.

    A strength of a disturbance is named after it, with the axis where it has one: `drag`, `push_x`. The low-level
    controller keeps its beliefs, as in a target.
    """

    def _build(self, generator):
        for name in self.config.parameters:
            if name not in candidates(self.system):
                known = ", ".join(candidates(self.system))
                raise InputError(f"parameters: {self.system.name} has no {name!r}; expected one of {known}")
        values = [nominal(self.system, name) for name in self.config.parameters]
        self.register_buffer("values", torch.tensor(values, dtype=torch.float64))
        self.register_buffer("errors", torch.full((len(values),), torch.inf, dtype=torch.float64))
        self.changed = None

    def simplify(self):
        """Take the fitted values as constants; later changes of them don't count."""
        self.changed = changed(self.base, dict(zip(self.config.parameters, self.values.tolist(), strict=True)))

    def corrected(self, state, action):
        if self.changed is None:
            self.simplify()
        return self.changed(state, action)

    def casadi(self):
        if self.changed is None:
            self.simplify()
        return self.changed.casadi()


def changed(base, values, change=replace):
    """Dynamics with these values {name: number} of parameters.

    Args:
        change: makes a system with other fields, given by name.

    Raises:
        InputError: values that make no physical sense, such as a negative mass.
    """
    system = base.system
    own = {name: value for name, value in values.items() if name in own_parameters(system)}
    strengths = {}
    for name, value in values.items():
        if name not in own:
            force, _, axis = name.rpartition("_") if name not in SCALAR else (name, "", "x")
            strengths.setdefault(force, [0.0, 0.0, 0.0])[AXES.index(axis)] = value
    forces = tuple(partial(DISTURBANCES[name], strength=tuple(strength)) for name, strength in strengths.items())
    system = change(system.configured(), **own) if own else system
    return replace(base, system=system, disturbances=(*base.disturbances, *forces))
