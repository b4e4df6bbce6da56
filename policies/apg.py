"""Analytic policy gradient: train a policy by differentiating the task's cost through the dynamics.

Wiedemann, Wuest, Loquercio, Mueller, Floreano and Scaramuzza (2023), "Training Efficient Controllers via Analytic
Policy Gradient": receding horizon, data collected by the partly trained policy, a curriculum over the allowed
divergence and the speed of the reference. All actions of the horizon are planned at once, or one after another: see
`policies.modes`. Where we differ: see `APGConfig`.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch

from envs.errors import InputError
from policies.modes import look_ahead
from policies.networks import MODES, PlanNetwork, as_actor, network_for

RAMPS = ("both", "threshold", "speed")
OPTIMIZERS = {
    "adam": lambda parameters: torch.optim.Adam(parameters),
    "sgd": lambda parameters: torch.optim.SGD(parameters, momentum=0.9),
}


@dataclass(frozen=True)
class APGConfig:
    """Settings of a training run.

    The paper alternates between collecting a data set and epochs of SGD on it. Here many episodes are flown side by
    side and each update advances all of them by one step, so that the data are always those of the present policy; the
    optimiser is Adam with a falling learning rate.

    The mode is that of a new network. Training that goes on with a network goes on in the network's mode.
    """

    updates: int = 3000
    batch: int = 256  # episodes flown side by side
    width: int | None = None  # neurons of every layer of the network; None: those of the paper
    mode: Literal["concurrent", "autoregressive", "recurrent"] = "concurrent"  # see `policies.networks`
    learning_rate: float = 3e-3
    final_rate: float = 0.01  # [-] last learning rate as a share of the first
    warmup: float = 0.02  # [-] share of the updates in which the learning rate rises
    optimizer: Literal["adam", "sgd"] = "adam"  # sgd has momentum 0.9
    clip: float = 1.0  # [-] gradients of a larger norm are scaled down to it
    curriculum: float = 0.5  # [-] share of the updates after which the last threshold and speed are reached
    ramps: Literal["both", "threshold", "speed"] = "both"  # what the curriculum raises; the other has its last value
    exploration: float = 0.1  # [-] standard deviation of noise on the flown actions
    episodes: int = 4000  # training episodes drawn
    every: ClassVar[int] = 500  # updates between validations, unless another number is asked for

    def __post_init__(self):
        for name in ("updates", "batch", "width", "learning_rate", "clip", "episodes"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected more than 0")
        for name in ("final_rate", "warmup", "curriculum", "exploration"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected between 0 and 1")
        if self.mode not in MODES:
            raise InputError(f"{_called('mode')} {self.mode}: expected one of {', '.join(MODES)}")
        if self.ramps not in RAMPS:
            raise InputError(f"{_called('ramps')} {self.ramps}: expected one of {', '.join(RAMPS)}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"{_called('optimizer')} {self.optimizer!r}: expected one of {', '.join(OPTIMIZERS)}")


def _called(name):
    """A setting as the user gave it: an option of the commands, or a field where there is none."""
    options = ("mode", "updates", "batch", "width", "learning_rate", "curriculum", "ramps", "exploration")
    return f"--{name.replace('_', '-')}" if name in options else f"APGConfig.{name}"


PRESETS = {
    "cartpole": APGConfig(updates=2000),
    "quadrotor": APGConfig(updates=4000, width=128, learning_rate=1e-2, curriculum=0.3),
    # Much noise: episodes all start at cruise, and what a policy does at other speeds is otherwise left to chance.
    "fixed_wing": APGConfig(updates=2000, exploration=0.5),
    "paper": APGConfig(
        updates=50000,  # 200 epochs of 2000 samples
        batch=8,
        learning_rate=8e-5,  # 1e-5 on the loss summed over the batch; here it is averaged
        final_rate=1.0,
        warmup=0.0,
        optimizer="sgd",
        clip=1e9,
        exploration=0.0,
    ),
}


Config, Network = APGConfig, PlanNetwork  # the names that every trained method has


def actor(network, task, seed=0):
    """The network's next action, as a TensorDict module; nothing is drawn, the seed doesn't matter."""
    return as_actor(network)


# The policy is trained already: no curriculum, a lower learning rate, few updates. They visit few states, so these are
# spread by more noise than in training; without it a rare flight far from the others can get worse.
FINETUNE = APGConfig(updates=500, learning_rate=3e-3, curriculum=0.0, warmup=0.05, exploration=0.2, episodes=1000)
# So much noise throws a pole about: the policy would be tuned for recovering, and get worse at rest (validation).
FINETUNES = {"cartpole": replace(FINETUNE, learning_rate=1e-3, exploration=0.05)}


def finetuning(config, system):
    """Settings to continue the training of a policy of a system that was trained with `config`."""
    return FINETUNES.get(system.name, FINETUNE)


class Flight:
    """Episodes flown side by side by the partly trained policy.

    What the policy remembers of each, `hidden` (B, 2, memory), is carried along; None where it has no memory.
    """

    def __init__(self, task, dynamics, episodes, size, generator, memory=0):
        self.task, self.dynamics, self.generator = task, dynamics, generator
        self.episodes = episodes
        self.row = self._draw(len(episodes), size)
        self.step = self._draw(task.steps, size)
        self.state = task.start(episodes[self.row], self.step)
        self.hidden = self.state.new_zeros(size, 2, memory) if memory else None

    def _draw(self, limit, size):
        return torch.randint(limit, (size,), generator=self.generator).to(self.episodes.device)

    def switch(self, episodes):
        """Continue on other episodes, such as faster ones."""
        self.episodes = episodes
        self.state = self.task.start(episodes[self.row], self.step)
        self.hidden = None if self.hidden is None else torch.zeros_like(self.hidden)

    def look(self):
        """The present states and the references ahead of them."""
        return self.state, self.ahead(0, self.state)

    def ahead(self, periods, state):
        """The references ahead of the states (B, n) that so many control periods from now lead to."""
        return self.task.reference(self.episodes[self.row], self.step + periods, state)

    @torch.no_grad()
    def advance(self, action, threshold, exploration, hidden=None):
        """One control period; who strays farther than the threshold is put back on the reference.

        Args:
            hidden: what the policy remembers now. Nothing where an episode begins or is put back.
        """
        task = self.task
        noise = exploration * torch.randn(action.shape, generator=self.generator).to(action)
        self.state = self.dynamics(self.state, (action + noise).clamp(-1, 1))
        self.step = self.step + 1
        rows = self.episodes[self.row]
        strayed = ~(task.distance(rows, self.step, self.state) <= threshold)
        ended = (self.step >= task.steps) | task.arrived(rows, self.step, self.state)
        ended |= task.diverged(rows, self.step, self.state)
        fresh = self._draw(len(self.episodes), len(self.row))
        self.row = torch.where(ended, fresh, self.row)
        self.step = torch.where(ended, torch.zeros_like(self.step), self.step)
        back = (strayed | ended).unsqueeze(-1)
        self.state = torch.where(back, task.start(self.episodes[self.row], self.step), self.state)
        if hidden is not None:
            self.hidden = torch.where(back.unsqueeze(-1), torch.zeros_like(hidden), hidden)
        return strayed.float().mean()


def learning_rate(config, update):
    """Linear warm-up, then a cosine fall to `final_rate`."""
    share = update / config.updates
    if share < config.warmup:
        return config.learning_rate * (update + 1) / (config.warmup * config.updates + 1)
    fall = 0.5 * (1 + math.cos(math.pi * (share - config.warmup) / (1 - config.warmup)))
    return config.learning_rate * (config.final_rate + (1 - config.final_rate) * fall)


def normalise(network, task, dynamics, episodes, generator, size=256, steps=40):
    """Set the normalisation of a network from states that random actions lead to around the reference."""
    flight = Flight(task, dynamics, episodes, size, generator)
    seen = []
    for _ in range(steps):
        state, reference = flight.look()
        seen.append((task.observe(state), task.window(state, reference)))
        action = 2 * torch.rand(size, len(task.system.Action._fields), generator=generator).to(state) - 1
        flight.advance(action, task.thresholds[1], 0.0)
    network.normalise(*(torch.cat(parts) for parts in zip(*seen, strict=True)))


@dataclass
class Training:
    """Everything that a training run changes, so that it can be saved and continued."""

    network: torch.nn.Module
    optimizer: torch.optim.Optimizer
    flight: Flight
    generator: torch.Generator
    update: int = 0
    skipped: int = 0  # updates left out because their gradient was not finite

    @property
    def samples(self):
        """Transitions flown so far."""
        return self.update * len(self.flight.row)

    def state_dict(self):
        """Tensors and numbers only."""
        flight = {name: getattr(self.flight, name) for name in ("row", "step", "state")}
        if self.flight.hidden is not None:
            flight["hidden"] = self.flight.hidden
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "flight": flight,
            "generator": self.generator.get_state(),
            "update": self.update,
            "skipped": self.skipped,
        }

    def load_state_dict(self, saved, banks, config, task):
        """Continue where `saved` left off, on the episodes that were flown then."""
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.generator.set_state(saved["generator"])
        self.update, self.skipped = saved["update"], saved["skipped"]
        self.flight.episodes = banks[stage(config, task, len(banks), max(0, self.update - 1), config.ramps)[1]]
        for name, value in saved["flight"].items():
            setattr(self.flight, name, value.to(self.flight.episodes.device))


def begin(dynamics, task, banks, config, seed, network=None):
    """A training run at its first update, of a copy of the network.

    Without a network, a new one is drawn from the seed and normalised.

    Raises:
        InputError: where the settings ask for another mode than that of the network.
    """
    generator = torch.Generator().manual_seed(seed)
    if network is None:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = network_for(task, config.width, mode=config.mode).to(banks[0].device)
        normalise(network, task, dynamics, banks[-1], generator)
    else:
        if config.mode not in (APGConfig.mode, network.config.mode):  # the default is not asked for
            raise InputError(f"--mode {config.mode}: the policy is {network.config.mode} and stays so; leave it out")
        network = copy.deepcopy(network)
    flight = Flight(task, dynamics, banks[0], config.batch, generator, network.config.memory)
    return Training(network, OPTIMIZERS[config.optimizer](network.parameters()), flight, generator)


def training_banks(task, config, seed, device="cpu"):
    """The training episodes at each speed of the curriculum, slowest first: the same paths, played slower."""
    return [task.episodes(config.episodes, "train", seed, speed=speed).to(device) for speed in task.speeds]


def train(run, dynamics, task, banks, config):
    """Advance a training run to its last update; yields a dict of metrics after each.

    Args:
        run: `Training`, changed in place.
        dynamics: what the gradient flows through; data are collected in those that the run was begun with.
        banks: training episodes of each speed of the curriculum, slowest first.
    """
    while run.update < config.updates:
        threshold, bank = stage(config, task, len(banks), run.update, config.ramps)
        if run.flight.episodes is not banks[bank]:
            run.flight.switch(banks[bank])
        ahead = look_ahead(run.network, dynamics, task, run.flight)
        cost = ahead.cost.mean()
        norm = descend(run, cost, config)
        resets = run.flight.advance(ahead.action.detach(), threshold, config.exploration, ahead.hidden)
        run.update += 1
        yield {
            "update": run.update,
            "samples": run.samples,
            "cost": float(cost.detach()),
            "gradient_norm": norm,
            "threshold": threshold,
            "stage": bank,
            "resets": float(resets),
            "skipped": run.skipped,
        }


def descend(run, cost, config):
    """One step of the optimiser down a cost, left out where the gradient is not finite; returns the gradient's norm.

    Args:
        run: has `network`, `optimizer`, `update` and `skipped`.
        config: has `clip` and what `learning_rate` reads.
    """
    for group in run.optimizer.param_groups:
        group["lr"] = learning_rate(config, run.update)
    run.optimizer.zero_grad(set_to_none=True)
    cost.backward()
    norm = torch.nn.utils.clip_grad_norm_(run.network.parameters(), config.clip)
    if torch.isfinite(norm):
        run.optimizer.step()
    else:
        run.skipped += 1
    return float(norm)


def stage(config, task, banks, update, ramps="both"):
    """Divergence threshold and speed stage: the threshold rises linearly in each stage and starts again in the next.

    Args:
        ramps: "both", or which of "threshold" and "speed" rises alone; the other has its last value from the start.
    """
    first, last = task.thresholds
    share = update / max(1, config.curriculum * config.updates)
    if share >= 1:
        return last, banks - 1
    if ramps == "threshold":
        return first + (last - first) * share, banks - 1
    bank = int(share * banks)
    return last if ramps == "speed" else first + (last - first) * (share * banks - bank), bank
