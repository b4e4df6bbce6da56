"""Differentiable robots, their source and target domains, tasks, and TorchRL environments.

Names are imported on first use: torch takes seconds to load, and a command should answer `--help` at once.
"""

from importlib import import_module

_HOMES = {
    "SYSTEMS": "registry",
    "make_dynamics": "registry",
    "make_env": "registry",
    "make_system": "registry",
    "make_task": "registry",
    "DISTURBANCES": "domains",
    "Domain": "domains",
    "parse_target": "domains",
    "Dynamics": "dynamics",
    "InputError": "errors",
    "load_vehicle": "vehicles",
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name in _HOMES:
        return getattr(import_module(f"envs.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'envs' has no attribute {name!r}")
