"""Policies, and the table of the methods that they come from.

A trained method is a module with `Config`, `PRESETS`, `finetuning`, `Network`, `begin`, `train` and `actor`:
`policies.apg` is the one to follow. A planner is a module with `actor(dynamics, task, …)`: it has nothing to train, but
needs a model.
"""

from dataclasses import dataclass
from importlib import import_module

from envs.errors import InputError


@dataclass(frozen=True)
class Method:
    """Where a method lives, and for a planner the dynamics that it plans in: "source", "residual" or "target"."""

    home: str
    model: str | None = None
    pixels: bool = False  # whether its policies see pictures in place of the state
    plans: bool = False  # whether an action takes planning, so that a flight takes minutes

    @property
    def trained(self):
        """Whether its policies are checkpoints that `adapt.pretrain` makes."""
        return self.model is None

    @property
    def module(self):
        """The module, imported on first use."""
        return import_module(self.home)


METHODS = {
    "apg": Method("policies.apg"),
    "apg-pixels": Method("policies.apg_pixels", pixels=True),
    "ppo": Method("policies.ppo"),
    "ppo-pixels": Method("policies.ppo_pixels", pixels=True),
    "pets": Method("policies.pets", plans=True),
    "mpc": Method("policies.mpc", model="source", plans=True),
    "mpc-residual": Method("policies.mpc", model="residual", plans=True),
    "mpc-target": Method("policies.mpc", model="target", plans=True),
}


def pick_method(name, trained=False):
    """A method by name.

    Raises:
        InputError: when there is none of that name, or only `trained` ones are asked for and it isn't.
    """
    known = [key for key, method in METHODS.items() if method.trained or not trained]
    if name not in known:
        raise InputError(f"--method {name}: expected one of {', '.join(known)}")
    return METHODS[name]
