"""The network that PPO trains from pictures; what PPO reads of it is said in `policies.actor_critic`."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from envs.errors import InputError
from policies.actor_critic import ActorCritic, Critic, StochasticPolicy
from policies.pixel_network import PixelEncoder


@dataclass(frozen=True)
class PixelActorCriticConfig:
    """Shape of both networks: `picture`, `convolutions` and `features` are the policy's, the rest the critic's.

    `picture` is channels, height and width of the stack of pictures.
    """

    picture: tuple[int, int, int]
    actions: int
    states: int
    window: tuple[int, int]
    encoder: str
    convolutions: tuple[int, ...] = (16, 24, 32, 32)  # filters of each
    features: int = 64
    filters: int = 20
    widths: tuple[int, ...] = (64, 64, 64)


class PixelTrunk(nn.Module):
    """The image network of APG up to its last hidden layer: pictures (..., C, H, W), uint8, to (..., features)."""

    def __init__(self, config):
        super().__init__()
        self.encoder = PixelEncoder(config.picture, config.convolutions, config.features)
        self.layer = nn.Linear(config.features, config.features)

    def forward(self, pixels):
        return torch.relu(self.layer(self.encoder(pixels)))

    @torch.no_grad()
    def normalise(self, pixels):
        """Let the outputs of each layer before its ReLU have mean 0 and deviation 1 on pictures (N, C, H, W).

        Pictures of a robot are all alike. With the usual random weights, what they have in common and the biases would
        drown what differs, and a policy gradient, being noisy, would take long to find it. Salimans and Kingma (2016),
        "Weight normalization", sect. 3.
        """
        self.encoder.normalise(pixels)
        for layer in (*self.encoder.convolutions, self.encoder.layer, self.layer):
            seen = []
            with layer.register_forward_hook(lambda layer, inputs, output, seen=seen: seen.append(output)):
                self(pixels)
            outputs = seen[0].transpose(0, 1).flatten(1)
            mean, scale = outputs.mean(1), outputs.std(1).clamp(min=1e-6)
            layer.weight.div_(scale.reshape(-1, *[1] * (layer.weight.ndim - 1)))
            layer.bias.sub_(mean).div_(scale)


class PixelActorCritic(nn.Module):
    """A policy that sees pictures and nothing of the state, and a critic that knows the state.

    The critic is privileged in training only, as in Pinto, Andrychowicz, Welinder, Zaremba and Abbeel (2018),
    "Asymmetric actor critic for image-based robot learning": it judges what was done better and learns sooner, and is
    not needed to fly. What flies, and what `as_mean_actor` makes of this network, sees pictures only.
    """

    Config: ClassVar[type] = PixelActorCriticConfig
    in_keys: ClassVar[tuple[str, ...]] = ("pixels",)
    critic_keys: ClassVar[tuple[str, ...]] = ("state", "window")

    def __init__(self, config: PixelActorCriticConfig):
        super().__init__()
        self.config = config
        self.policy = StochasticPolicy(PixelTrunk(config), config.features, config.actions)
        self.critic = Critic(config)
        self.register_buffer("unit", torch.zeros(()))

    @staticmethod
    def contract(task):
        """The fields of a `PixelActorCriticConfig` that a task prescribes.

        Raises:
            InputError: when the task has no camera.
        """
        if task.camera is None:
            raise InputError(f"{task.system.name}: the task has no camera, a policy from pictures needs one; use ppo")
        sizes = ActorCritic.contract(task)
        del sizes["observations"]
        return {"picture": task.camera.shape, **sizes}

    def normalise(self, seen):
        """Take the normalisation of both networks from a TensorDict (N,) of what the environment showed."""
        self.policy.trunk.normalise(seen["pixels"])
        self.critic.trunk.layers.normalise(*(seen[key] for key in self.critic_keys))


def pixel_actor_critic_for(task, width=None):
    """A `PixelActorCritic` of the size that a task needs; `width`: neurons of every layer that isn't a convolution."""
    shape = {} if width is None else {"features": width, "widths": (width,) * 3}
    return PixelActorCritic(PixelActorCriticConfig(**PixelActorCritic.contract(task), **shape))
