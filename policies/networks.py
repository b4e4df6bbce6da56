"""Policy networks: from what a policy sees to the next actions in [-1, 1]."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from envs.errors import InputError

ENCODERS = ("conv", "linear", "none")


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a policy network: sizes of what goes in and comes out, widths in between."""

    observations: int
    window: tuple[int, int]  # reference points and entries of each
    actions: int
    horizon: int  # number of actions planned at once
    encoder: str  # how the window is read: "conv" (20 filters over time), "linear", "none"
    features: int = 64  # width of the first layer of the state (and of a linear reference)
    filters: int = 20
    widths: tuple[int, ...] = (64, 64, 64)


class PlanNetwork(nn.Module):
    """The concurrent policy of Wiedemann, Wuest et al. (2023): all actions of the horizon at once.

    State and reference are normalised by fixed buffers, read by one layer each, joined, and passed through `widths`.
    tanh throughout; the output tanh equals the paper's sigmoid rescaled to [-1, 1].
    """

    Config: ClassVar[type] = NetworkConfig

    def __init__(self, config: NetworkConfig):
        super().__init__()
        if config.encoder not in ENCODERS:
            raise InputError(f"encoder {config.encoder!r}: expected one of {', '.join(ENCODERS)}")
        self.config = config
        points, entries = config.window
        self.register_buffer("observation_mean", torch.zeros(config.observations))
        self.register_buffer("observation_scale", torch.ones(config.observations))
        self.register_buffer("window_scale", torch.ones(points, entries))
        self.state_layer = nn.Linear(config.observations, config.features)
        joined = config.features
        if config.encoder == "conv":
            self.window_layer = nn.Conv1d(entries, config.filters, 3)
            joined += config.filters * (points - 2)
        elif config.encoder == "linear":
            self.window_layer = nn.Linear(points * entries, config.features)
            joined += config.features
        sizes = (joined, *config.widths)
        self.trunk = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.head = nn.Linear(sizes[-1], config.horizon * config.actions)

    def forward(self, observation, window):
        """Plan (..., T, m) in [-1, 1] for observation (..., o) and window (..., H, w)."""
        state = (observation - self.observation_mean) / self.observation_scale
        parts = [torch.tanh(self.state_layer(state))]
        if self.config.encoder != "none":
            parts.append(torch.tanh(self._read(window / self.window_scale)))
        hidden = torch.cat(parts, -1)
        for layer in self.trunk:
            hidden = torch.tanh(layer(hidden))
        plan = torch.tanh(self.head(hidden))
        return plan.unflatten(-1, (self.config.horizon, self.config.actions))

    def _read(self, window):
        if self.config.encoder == "linear":
            return self.window_layer(window.flatten(-2))
        batch = window.shape[:-2]
        features = self.window_layer(window.reshape(-1, *window.shape[-2:]).transpose(-1, -2))
        return features.reshape(*batch, -1)

    @staticmethod
    def contract(task):
        """The fields of a `NetworkConfig` that a task prescribes."""
        task = replace(task, set=task.sets[0])  # sizes are those of any set, and a file of waypoints may have gone
        episodes, step = task.episodes(1, "train", 0), torch.zeros(1, dtype=torch.long)
        state = task.start(episodes, step)
        window = task.window(state, task.reference(episodes, step, state))
        return {
            "observations": task.observe(state).shape[-1],
            "window": tuple(window.shape[-2:]),
            "actions": len(task.system.Action._fields),
            "horizon": task.horizon,
            "encoder": task.encoder,
        }

    @torch.no_grad()
    def normalise(self, observation, window):
        """Take the normalisation from samples (N, o) and (N, H, w); entries that hardly vary keep unit scale."""
        spread = observation.std(0)
        self.observation_mean.copy_(torch.where(spread > 1e-3, observation.mean(0), torch.zeros_like(spread)))
        self.observation_scale.copy_(torch.where(spread > 1e-3, spread, torch.ones_like(spread)))
        if window.numel():
            reach = window.square().mean(0).sqrt()
            self.window_scale.copy_(torch.where(reach > 1e-3, reach, torch.ones_like(reach)))


def network_for(task, width=None, **shape):
    """A network of the size that a task needs.

    Args:
        width: neurons of every hidden layer; None takes those of the paper.
        shape: overrides `features`, `filters`, `widths` of the `NetworkConfig`.
    """
    features, *widths = task.layers if width is None else (width,) * len(task.layers)
    shape = {"features": features, "widths": tuple(widths), **shape}
    return PlanNetwork(NetworkConfig(**{**PlanNetwork.contract(task), **shape}))


class FirstAction(nn.Module):
    """The receding-horizon policy: plan the whole horizon, apply the first action."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, *inputs):
        return self.network(*inputs)[..., 0, :]


def as_actor(network):
    """A network as a TorchRL policy that reads `observation` and `window` and writes `action`."""
    return TensorDictModule(FirstAction(network), in_keys=["observation", "window"], out_keys=["action"])
