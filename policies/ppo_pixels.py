"""PPO from pictures: the policy sees what a camera sees, and is trained from rewards alone.

The same algorithm as `policies.ppo`, on another network: see `PixelActorCritic`. In training the critic knows the
state; the policy, which is all that is flown later, sees nothing but the last pictures.
"""

import math
from dataclasses import dataclass

import torch

from envs.errors import InputError
from policies import ppo
from policies.pixel_actor_critic import PixelActorCritic, pixel_actor_critic_for
from policies.ppo import actor, finetuning

__all__ = ["PRESETS", "Config", "Network", "actor", "begin", "finetuning", "train"]

Network = PixelActorCritic


@dataclass(frozen=True)
class Config(ppo.Config):
    """Settings of a training run, see `policies.ppo.Config`."""

    spread: float = 0.7  # [m] most that flights begin to either side of where those of the task do

    def __post_init__(self):
        super().__post_init__()
        if not 0 <= self.spread < math.inf:
            raise InputError(f"ppo_pixels.Config.spread {self.spread}: expected at least 0")


# Small steps from little noise, because a pole that is pushed about shows nothing of what a policy is worth. The critic
# knows the state and is taught well, so that short traces do: they leave less noise in the advantages, and a network
# that reads pictures would learn noise by heart.
PRESETS = {
    "cartpole": Config(
        samples=150_000,
        batch=32,
        steps=32,
        epochs=3,
        minibatches=16,
        critic_epochs=10,
        trace=0.5,
        exploration=0.15,
        final_exploration=0.03,
        final_rate=0.2,
    )
}


def begin(dynamics, task, banks, config, seed, network=None):
    """A training run before its first update, see `policies.ppo.begin`.

    Raises:
        InputError: when the task has no camera.
    """
    PixelActorCritic.contract(task)
    return ppo.begin(dynamics, task, _scattered(banks, task, config), config, seed, network, pixel_actor_critic_for)


def train(run, dynamics, task, banks, config):
    """Advance a training run to its last update; yields a dict of metrics after each, see `policies.ppo.train`."""
    return ppo.train(run, dynamics, task, _scattered(banks, task, config), config)


def _scattered(banks, task, config):
    """Training episodes that begin farther apart, in coordinates that the path of the task leaves free (not a number).

    There neither cost nor equations notice, but the camera sees the robot in other places. Without it a policy that
    drifts comes to where it has never seen itself, and fails. Episodes are starting states in tasks with a camera.
    """
    drawn = torch.rand(len(banks[0]), 1, generator=torch.Generator().manual_seed(0)).to(banks[0])
    offset = (2 * drawn - 1) * config.spread
    return [torch.where(task.path(bank)[:, 0].isnan(), bank + offset, bank) for bank in banks]
