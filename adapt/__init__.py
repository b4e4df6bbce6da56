"""Adapt a policy to a robot that differs from its model: collect, fit_residual, finetune, adapt.

The verbs are imported on first use, so that the commands answer `--help` at once.
"""

from importlib import import_module

_HOMES = {
    "Transitions": "transitions",
    "collect": "flying",
    "ResidualDynamics": "residual_dynamics",
    "fit_residual": "residual",
    "load_residual": "residual_kinds",
    "prediction_error": "prediction",
    "adapt": "adaptation",
    "finetune": "finetuning",
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name in _HOMES:
        return getattr(import_module(f"adapt.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'adapt' has no attribute {name!r}")
