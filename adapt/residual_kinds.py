"""The kinds of residual by name: make an unfitted one, or read one from a file."""

from dataclasses import fields, replace

from adapt.acceleration_residual import AccelerationResidual
from adapt.parameter_residual import ParameterResidual
from adapt.residual_dynamics import FORMAT, ResidualConfig
from adapt.state_residual import StateResidual
from envs import make_system
from envs.dynamics import Dynamics
from envs.errors import InputError
from policies.files import read_safetensors

RESIDUALS = {"acceleration": AccelerationResidual, "state": StateResidual, "parameters": ParameterResidual}


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
        shape = {name: tuple(value) if isinstance(value, list) else value for name, value in said["config"].items()}
        config = ResidualConfig(**shape)
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
