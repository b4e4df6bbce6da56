"""PPO from pictures: the policy sees what a camera sees, and is trained from rewards alone.

The same algorithm as `policies.ppo`, on another network: see `PixelActorCritic`. In training the critic knows the
state; the policy, which is all that is flown later, sees nothing but the last pictures.
"""

from policies import ppo
from policies.pixel_actor_critic import PixelActorCritic, pixel_actor_critic_for
from policies.ppo import Config, actor, finetuning, train

__all__ = ["PRESETS", "Config", "Network", "actor", "begin", "finetuning", "train"]

Network = PixelActorCritic

# Small steps from little noise, because a pole that is pushed about shows nothing of what a policy is worth. The critic
# knows the state and is taught well, so that short traces do: they leave less noise in the advantages, and a network
# that reads pictures would learn noise by heart.
PRESETS = {
    "cartpole": Config(
        samples=80_000,
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
    return ppo.begin(dynamics, task, banks, config, seed, network, fresh=pixel_actor_critic_for)
