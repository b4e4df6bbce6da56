"""A stochastic policy with a value function: the network that PPO trains.

PPO reads of a network only what every such network offers:

| name                | what                                                                                           |
|---------------------|------------------------------------------------------------------------------------------------|
| `in_keys`           | what the policy reads from the environment's TensorDict                                        |
| `critic_keys`       | what the critic reads: in training it may know what the policy doesn't see                     |
| `policy`            | module from `in_keys` to location and scale (..., m) of a normal, whose tanh acts        |
| `policy.limit`      | (low, high) → brings the scale between two bounds                                              |
| `critic`            | module from `critic_keys` to the value (..., 1), in multiples of `unit`                        |
| `unit`              | buffer of one element: the mean cost of a step, 0 until the training has set it                |
| `normalise`         | TensorDict (N,) of what random actions showed → sets the normalisation                         |

`ActorCritic` is the one for states and references, `PixelActorCritic` of `policies.pixel_actor_critic` for pictures.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from policies.networks import NetworkConfig, PlanNetwork

# tanh is within 1e-4 of its bound here. Farther out float32 rounds an action so coarsely that its probability, which is
# found from the action, would be wrong.
LOCATION_LIMIT = 5.0


@dataclass(frozen=True)
class ActorCriticConfig:
    """Shape of both networks: sizes of what goes in and comes out, widths in between (see `NetworkConfig`)."""

    observations: int
    states: int
    window: tuple[int, int]
    actions: int
    encoder: str
    features: int = 64
    filters: int = 20
    widths: tuple[int, ...] = (64, 64, 64)


class Trunk(nn.Module):
    """The network of APG up to its last hidden layer, (..., inputs) and (..., H, w) to (..., widths[-1]).

    A `PlanNetwork` ends in a tanh layer; where it plans a single action of `widths[-1]` entries, that layer is the last
    hidden one.
    """

    def __init__(self, config, inputs):
        super().__init__()
        *widths, last = config.widths
        shape = {"features": config.features, "filters": config.filters, "widths": tuple(widths)}
        self.layers = PlanNetwork(NetworkConfig(inputs, config.window, last, 1, config.encoder, **shape))

    def forward(self, inputs, window):
        return self.layers(inputs, window).squeeze(-2)


class StochasticPolicy(nn.Module):
    """Location and scale (..., m) of the normal distribution whose tanh is the action.

    The scale is learned and the same in all states.

    Args:
        trunk: module from what the policy reads to features (..., width).
        width: how many features there are.
        actions: m.
    """

    def __init__(self, trunk, width, actions):
        super().__init__()
        self.trunk = trunk
        self.head = nn.Linear(width, actions)
        self.log_scale = nn.Parameter(torch.zeros(actions))
        with torch.no_grad():  # the first actions are spread about the middle of their range in every state
            self.head.weight.mul_(0.01)
            self.head.bias.zero_()

    def forward(self, *seen):
        location = self.head(self.trunk(*seen))
        location = LOCATION_LIMIT * torch.tanh(location / LOCATION_LIMIT)
        return location, self.log_scale.exp().expand_as(location)

    @torch.no_grad()
    def limit(self, low, high):
        """Bring the scale between two bounds."""
        self.log_scale.copy_(self.log_scale.exp().clamp(low, high).log())


class Critic(nn.Module):
    """The value (..., 1): discounted rewards to come."""

    def __init__(self, config):
        super().__init__()
        self.trunk = Trunk(config, config.states)
        self.head = nn.Linear(config.widths[-1], 1)

    def forward(self, state, window):
        return self.head(self.trunk(state, window))


class ActorCritic(nn.Module):
    """Policy and critic with trunks of their own, both with the layers of an APG network.

    The critic reads the whole state in place of the observation. The way left to a target, for one, is not observed,
    but most of the cost of a flight comes at its end; a critic that can't foresee it takes it for noise.
    """

    Config: ClassVar[type] = ActorCriticConfig
    in_keys: ClassVar[tuple[str, ...]] = ("observation", "window")
    critic_keys: ClassVar[tuple[str, ...]] = ("state", "window")

    def __init__(self, config: ActorCriticConfig):
        super().__init__()
        self.config = config
        self.policy = StochasticPolicy(Trunk(config, config.observations), config.widths[-1], config.actions)
        self.critic = Critic(config)
        self.register_buffer("unit", torch.zeros(()))

    @staticmethod
    def contract(task):
        """The fields of an `ActorCriticConfig` that a task prescribes."""
        sizes = PlanNetwork.contract(task)
        del sizes["horizon"]
        return {**sizes, "states": len(task.system.State._fields)}

    def normalise(self, seen):
        """Take the normalisation of both networks from a TensorDict (N,) of what the environment showed."""
        self.policy.trunk.layers.normalise(*(seen[key] for key in self.in_keys))
        self.critic.trunk.layers.normalise(*(seen[key] for key in self.critic_keys))


def actor_critic_for(task, width=None):
    """An `ActorCritic` of the size that a task needs; `width`: neurons of every hidden layer, None: as in the paper."""
    features, *widths = task.layers if width is None else (width,) * len(task.layers)
    return ActorCritic(ActorCriticConfig(**ActorCritic.contract(task), features=features, widths=tuple(widths)))


class MeanAction(nn.Module):
    """The deterministic policy: tanh of the location."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, *inputs):
        return torch.tanh(self.policy(*inputs)[0])


def as_mean_actor(network):
    """The policy of an actor-critic as a TensorDict module that reads its `in_keys` and writes `action`."""
    return TensorDictModule(MeanAction(network.policy), in_keys=list(network.in_keys), out_keys=["action"])
