"""Policy networks: from what a policy sees to the next actions in [-1, 1].

A network belongs to one of three modes (Wiedemann, Wuest et al. 2023, sect. "Training with receding-horizon"):

| mode             | what the network gives                | how the actions of a horizon come about in training       |
|------------------|---------------------------------------|-----------------------------------------------------------|
| `concurrent`     | all T actions of the horizon at once  | one call                                                  |
| `autoregressive` | the next action                       | T calls, each in the state that the last one led to       |
| `recurrent`      | the next action, with a memory: an    | as `autoregressive`; what is remembered goes on through   |
|                  | LSTM cell behind the trunk            | the calls, and from one horizon of a flight to the next   |

T, the horizon of the task, is one number for all of it: how many reference points a policy sees, and how many steps
ahead the cost looks.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from envs.errors import InputError
from policies.recurrent import RecurrentActor

ENCODERS = ("conv", "linear", "none")
MODES = ("concurrent", "autoregressive", "recurrent")
KERNEL = 3  # [-] reference points that a filter spans


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a policy network: sizes of what goes in and comes out, widths in between."""

    observations: int
    window: tuple[int, int]  # reference points and entries of each
    actions: int
    horizon: int  # number of control periods that it is trained to look ahead
    encoder: str  # how the window is read: "conv" (20 filters over time), "linear", "none"
    features: int = 64  # width of the first layer of the state (and of a linear reference)
    filters: int = 20
    widths: tuple[int, ...] = (64, 64, 64)
    mode: str = "concurrent"  # one of MODES; checkpoints of earlier versions don't say and are of this one

    @property
    def planned(self):
        """P, the number of actions that the network gives at once."""
        return self.horizon if self.mode == "concurrent" else 1

    @property
    def memory(self):
        """Neurons of the LSTM cell; 0 where there is none."""
        return self.widths[-1] if self.mode == "recurrent" else 0


class PlanNetwork(nn.Module):
    """The policy of Wiedemann, Wuest et al. (2023), in any of its modes.

    State and reference are normalised by fixed buffers, read by one layer each, joined, and passed through `widths`.
    tanh throughout; the output tanh equals the paper's sigmoid rescaled to [-1, 1]. Filters span three reference
    points, or the whole window where it is shorter: a horizon of one or two steps has no more. In the recurrent mode
    the output of the LSTM adds to what the trunk makes, so that a new network is nearly one without a memory: after 800
    updates the quadrotor's validation error is 0.0074 m, and 0.75 m where the output takes the trunk's place.
    """

    Config: ClassVar[type] = NetworkConfig

    def __init__(self, config: NetworkConfig):
        super().__init__()
        if config.encoder not in ENCODERS:
            raise InputError(f"encoder {config.encoder!r}: expected one of {', '.join(ENCODERS)}")
        if config.mode not in MODES:
            raise InputError(f"mode {config.mode!r}: expected one of {', '.join(MODES)}")
        self.config = config
        points, entries = config.window
        self.register_buffer("observation_mean", torch.zeros(config.observations))
        self.register_buffer("observation_scale", torch.ones(config.observations))
        self.register_buffer("window_scale", torch.ones(points, entries))
        self.state_layer = nn.Linear(config.observations, config.features)
        joined = config.features
        if config.encoder == "conv":
            kernel = min(KERNEL, points)
            self.window_layer = nn.Conv1d(entries, config.filters, kernel)
            joined += config.filters * (points - kernel + 1)
        elif config.encoder == "linear":
            self.window_layer = nn.Linear(points * entries, config.features)
            joined += config.features
        sizes = (joined, *config.widths)
        self.trunk = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.head = nn.Linear(sizes[-1], config.planned * config.actions)
        if config.memory:
            self.cell = nn.LSTMCell(sizes[-1], config.memory)

    def forward(self, observation, window):
        """Plan (..., P, m) in [-1, 1] for observation (..., o) and window (..., H, w); a memory is empty."""
        return self.recall(observation, window)[0]

    def recall(self, observation, window, hidden=None):
        """Plan (..., P, m) and what is remembered (..., 2, `memory`): output and cell of the LSTM.

        Args:
            hidden: what was remembered one control period before; None is nothing (zeros). Handed on as it is where
                the network has no memory.
        """
        features = self._features(observation, window)
        if self.config.memory:
            hidden = self._remembered(features, hidden)
            features = features + hidden[..., 0, :]
        plan = torch.tanh(self.head(features))
        return plan.unflatten(-1, (self.config.planned, self.config.actions)), hidden

    def _remembered(self, features, hidden):
        """One step of the LSTM cell, over any batch shape."""
        if hidden is None:
            hidden = features.new_zeros(*features.shape[:-1], 2, self.config.memory)
        flat = hidden.reshape(-1, *hidden.shape[-2:])
        output, cell = self.cell(features.reshape(-1, features.shape[-1]), (flat[:, 0], flat[:, 1]))
        return torch.stack((output, cell), -2).reshape(hidden.shape)

    def _features(self, observation, window):
        """What the trunk makes (..., widths[-1]) of observation and window."""
        state = (observation - self.observation_mean) / self.observation_scale
        parts = [torch.tanh(self.state_layer(state))]
        if self.config.encoder != "none":
            parts.append(torch.tanh(self._read(window / self.window_scale)))
        hidden = torch.cat(parts, -1)
        for layer in self.trunk:
            hidden = torch.tanh(layer(hidden))
        return hidden

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
        shape: overrides `features`, `filters`, `widths`, `mode` of the `NetworkConfig`.
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
    """A network as a TorchRL policy that reads `observation` and `window` and writes `action`.

    One with a memory also reads and writes that, see `policies.recurrent.RecurrentActor`.
    """
    if network.config.memory:
        return RecurrentActor(network)
    return TensorDictModule(FirstAction(network), in_keys=["observation", "window"], out_keys=["action"])
