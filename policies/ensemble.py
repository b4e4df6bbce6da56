"""A probabilistic ensemble as dynamics: Gaussian networks that predict how a state changes, learned from transitions.

Chua, Calandra, McAllister and Levine (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
Dynamics Models". Inputs are what doesn't depend on the place (`System.residual_inputs`), outputs are changes in the
tangent space of the state (`System.difference`), so a quaternion stays a unit one. Shapes below: E members, R rows, i
inputs, d tangent entries, n states, m actions.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from envs.errors import InputError
from policies.cem import PlannerConfig

FLAT = 1e-6  # inputs and outputs that vary less than this are not scaled up
TIGHTEST, WIDEST = -10.0, 0.5  # first bounds of the log-variance, as in the reference implementation of the paper


@dataclass(frozen=True)
class EnsembleConfig:
    """Shape of an ensemble, and how it is planned with."""

    inputs: int
    outputs: int
    members: int = 5
    width: int = 64
    layers: int = 2  # hidden ones
    planner: PlannerConfig = field(default_factory=PlannerConfig)

    def __post_init__(self):
        if isinstance(self.planner, dict):  # read from the text of a checkpoint
            object.__setattr__(self, "planner", PlannerConfig(**self.planner))
        for name in ("inputs", "outputs", "members", "width", "layers"):
            if getattr(self, name) < 1:
                raise InputError(f"EnsembleConfig.{name} {getattr(self, name)}: expected at least 1")


class Ensemble(nn.Module):
    """E networks side by side, each giving a Gaussian over the change of the state in one control period.

    The log-variance is softly clamped between two learned bounds, which all members share.
    """

    Config = EnsembleConfig

    def __init__(self, config):
        super().__init__()
        self.config = config
        sizes = (config.inputs, *(config.width,) * config.layers, 2 * config.outputs)
        shapes = [(config.members, a, b) for a, b in pairwise(sizes)]
        self.weights = nn.ParameterList(_initial(shape) for shape in shapes)
        self.biases = nn.ParameterList(torch.zeros(shape[0], 1, shape[2]) for shape in shapes)
        self.min_logvar = nn.Parameter(torch.full((config.outputs,), TIGHTEST))
        self.max_logvar = nn.Parameter(torch.full((config.outputs,), WIDEST))
        for name, size in (("input", config.inputs), ("output", config.outputs)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))

    @staticmethod
    def contract(task):
        """The fields of the configuration that a task decides."""
        x = task.system.State(*torch.zeros(len(task.system.State._fields)))
        return {"inputs": len(task.system.residual_input_names), "outputs": len(task.system.difference(x, x))}

    def forward(self, inputs):
        """Mean and log-variance (E, R, d), both in normalised units, of inputs (E, R, i), or (R, i) for all members."""
        hidden = (inputs - self.input_mean) / self.input_scale
        hidden = hidden.expand(self.config.members, *hidden.shape[-2:])
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if i < last:
                hidden = functional.silu(hidden, inplace=not hidden.requires_grad)
        mean, logvar = hidden.chunk(2, -1)
        logvar = self.max_logvar - functional.softplus(self.max_logvar - logvar)
        return mean, self.min_logvar + functional.softplus(logvar - self.min_logvar)

    def loss(self, inputs, outputs):
        """Negative log-likelihood of normalised outputs (E, R, d), per entry and without its constant: (E,)."""
        mean, logvar = self(inputs)
        return 0.5 * ((mean - outputs).square() * (-logvar).exp() + logvar).mean((-1, -2))

    def normalised(self, outputs):
        """Changes of state in the units that the networks predict."""
        return (outputs - self.output_mean) / self.output_scale

    @torch.no_grad()
    def normalise(self, inputs, outputs):
        """Take the normalisation from samples (N, i) and (N, d); entries that hardly vary keep unit scale."""
        for name, samples in (("input", inputs), ("output", outputs)):
            spread = samples.std(0, correction=0)  # of a single row: 0
            getattr(self, f"{name}_mean").copy_(samples.mean(0))
            getattr(self, f"{name}_scale").copy_(torch.where(spread > FLAT, spread, torch.ones_like(spread)))


def _initial(shape):
    """Weights (E, in, out), uniform with standard deviation 1 / sqrt(in)."""
    limit = math.sqrt(3 / shape[1])
    return torch.empty(shape).uniform_(-limit, limit)


class EnsembleDynamics(nn.Module):
    """An ensemble as dynamics: `dynamics(state, action) -> next_state`, the mean of all members."""

    def __init__(self, network, system):
        super().__init__()
        self.network, self.system = network, system

    @property
    def dt(self):
        """Control period [s]."""
        return self.system.dt

    @property
    def members(self):
        """Number of networks in the ensemble."""
        return self.network.config.members

    @property
    def outputs(self):
        """Number of tangent entries."""
        return self.network.config.outputs

    def forward(self, state, action):
        """Next state (..., n) of state (..., n) and action (..., m) in [-1, 1]."""
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        state, action = (part.expand(*batch, -1).reshape(-1, part.shape[-1]) for part in (state, action))
        mean = self.network(model_inputs(self.system, state, action))[0].mean(0)
        return self._displaced(state, mean).reshape(*batch, -1)

    def sample(self, state, action, noise):
        """Next states of particles, each of the same member as before (TS-infinity of the paper).

        Args:
            state: (E, R, n), first axis the members.
            action: (R, m) or (E, R, m).
            noise: standard normal, shape (E, R, d) or one that broadcasts to it; zeros give each member's mean.
        """
        action = action.expand(*state.shape[:-1], -1)
        mean, logvar = self.network(model_inputs(self.system, state, action))
        return self._displaced(state, torch.addcmul(mean, (0.5 * logvar).exp(), noise))

    def _displaced(self, state, change):
        change = change * self.network.output_scale + self.network.output_mean
        x = self.system.State(*state.unbind(-1))
        return torch.stack(tuple(self.system.displaced(x, change.unbind(-1))), -1)


def model_inputs(system, state, action):
    """What the networks see (..., i) of state (..., n) and action (..., m)."""
    x, u = system.State(*state.unbind(-1)), system.Action(*action.unbind(-1))
    return torch.stack(tuple(system.residual_inputs(x, u)), -1)


def model_outputs(system, state, following):
    """What the networks learn (..., d): the change from state to the following one (..., n) in the tangent space."""
    x, y = system.State(*state.unbind(-1)), system.State(*following.unbind(-1))
    return torch.stack(tuple(system.difference(x, y)), -1)


@dataclass(frozen=True)
class FitConfig:
    """Settings of one fit of an ensemble to all transitions so far."""

    steps: int = 1000  # gradient steps
    batch: int = 64  # rows for each member in a step
    learning_rate: float = 2e-3
    weight_decay: float = 1e-5
    every: int = 25  # steps between looks at the held-out rows

    def __post_init__(self):
        for name in ("steps", "batch", "learning_rate", "every"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"FitConfig.{name} {getattr(self, name)}: expected more than 0")
        if not 0 <= self.weight_decay < math.inf:
            raise InputError(f"FitConfig.weight_decay {self.weight_decay}: expected 0 or more")


def fit(network, inputs, outputs, counts, config, generator):
    """Fit an ensemble to rows, keeping the weights that were best on held-out rows.

    It doesn't end early: the learning rate begins high again in each round and only its fall shows what was gained. The
    loss is the paper's: negative log-likelihood, and 0.01 times the width between the bounds of the log-variance.

    Args:
        inputs: (N, i).
        outputs: (N, d), not normalised.
        counts: (N, E), how often each member's bootstrap sample holds a row; -1 where a row is held out of all.
        config: `FitConfig`.

    Returns:
        Held-out negative log-likelihood (a float), and the number of steps left out as not finite.
    """
    outputs = network.normalised(outputs)
    held = counts[:, 0] < 0
    seen = inputs[held], outputs[held]
    if not held.any():  # too few rows to spare any
        seen = inputs, outputs
    drawn = [_bootstrap(column.clamp(min=0)) for column in counts.unbind(-1)]
    lengths = torch.tensor([len(rows) for rows in drawn]).unsqueeze(-1)
    table = nn.utils.rnn.pad_sequence(drawn, batch_first=True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=0)
    best, weights, skipped = _held_out(network, *seen), _copy(network), 0
    for step in range(config.steps):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        places = (torch.rand(len(drawn), config.batch, generator=generator) * lengths).long()
        rows = table.gather(1, places)
        loss = network.loss(inputs[rows], outputs[rows]).sum()
        loss = loss + 0.01 * (network.max_logvar - network.min_logvar).sum()
        loss = loss + config.weight_decay * sum(weight.square().sum() for weight in network.weights)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        if not torch.isfinite(norm):
            skipped += 1
            continue
        optimizer.step()
        if (step + 1) % config.every == 0 or step + 1 == config.steps:
            likelihood = _held_out(network, *seen)
            if likelihood < best:
                best, weights = likelihood, _copy(network)
    network.load_state_dict(weights)
    return best, skipped


def _bootstrap(counts):
    """Indices of the rows, each as often as counted; each once where none is."""
    counts = counts if counts.any() else torch.ones_like(counts)
    return torch.arange(len(counts)).repeat_interleave(counts)


@torch.no_grad()
def _held_out(network, inputs, outputs):
    value = float(network.loss(inputs, outputs).mean())
    return value if math.isfinite(value) else math.inf


def _copy(network):
    return {name: value.clone() for name, value in network.state_dict().items()}
