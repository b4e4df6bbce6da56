"""A model with other values of its parameters, compiled once for all of them: what a fit of parameters evaluates."""

import copy
from functools import lru_cache

import torch

from adapt.parameter_residual import candidates, changed, nominal
from envs.dynamics import casadi_backend
from policies.compiled_dynamics import compile_batches, doubles
from policies.generated_code import CompilerError


class Variants:
    """`variants(values) -> dynamics`, as `changed` has it; without a gradient.

    Where there is a compiler, and the equations don't branch on a parameter, a step is machine code that takes the
    parameters as an input: a fit evaluates hundreds of values, and eager equations spend a millisecond on each of them.
    """

    def __init__(self, base):
        self.base, self.names = base, candidates(base.system)
        self.nominal = [nominal(base.system, name) for name in self.names]
        self._step = _step(base, self.names)

    def __call__(self, values):
        """Dynamics with these values {name: number} of parameters, nominal ones of all others.

        Raises:
            InputError: values that make no physical sense, such as a negative mass.
        """
        dynamics = changed(self.base, values)
        if self._step is None:
            return dynamics
        numbers = [values.get(name, value) for name, value in zip(self.names, self.nominal, strict=True)]
        return _Variant(dynamics.system, self._step, torch.tensor(numbers, dtype=torch.float64))


class _Variant:
    def __init__(self, system, step, parameters):
        self.system, self._step, self.parameters = system, step, parameters

    def __call__(self, state, action):
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        before, held = (doubles(part.expand(*batch, -1)) for part in (state, action))
        following = torch.empty_like(before)
        self._step(batch.numel(), *(part.data_ptr() for part in (before, held, self.parameters, following)))
        return following.to(state.dtype)


@lru_cache(maxsize=8)  # a fit makes many `Variants` of one base
def _step(base, names):
    """The compiled step, or None where that isn't possible."""
    try:
        (step,) = compile_batches([parametric(base, names)], shared=1)
    except (CompilerError, TypeError):
        return None
    return step


def parametric(base, names):
    """The step of `base` as a `casadi.Function` (state, action, parameters) -> next_state.

    Raises:
        TypeError: the equations do with a parameter what can't be done with a symbol.
    """
    import casadi

    sizes = len(base.system.State._fields), len(base.system.Action._fields), len(names)
    state, action, parameters = (casadi.SX.sym(name, size) for name, size in zip("xup", sizes, strict=True))
    symbols = dict(zip(names, casadi.vertsplit(parameters), strict=True))
    try:
        following = changed(base, symbols, _unchecked).advance(state, action, backend=casadi_backend())
    except Exception as error:  # CasADi has no class of its own for "not a number"
        raise TypeError(f"{base.system.name}: {error}") from error
    return casadi.Function("variant", [state, action, parameters], [following], {"cse": True})


def _unchecked(system, **values):
    """The system with other fields, whatever they are: bounds can't be asked of symbols."""
    system = copy.copy(system)
    for name, value in values.items():
        object.__setattr__(system, name, value)  # it is frozen
    return system
