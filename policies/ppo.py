"""PPO: train a policy from rewards alone, without a gradient of the dynamics.

Schulman, Wolski, Dhariwal, Radford and Klimov (2017), "Proximal Policy Optimization Algorithms", built of TorchRL's
parts, on the observations, references, action ranges and curriculum of APG.
"""

import copy
import math
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict

from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.pixels import reseed
from policies.actor_critic import ActorCritic, actor_critic_for, as_mean_actor
from policies.apg import stage
from policies.ppo_update import environment, fly, improve, joined, judge, place_keys, study

Network = ActorCritic


@dataclass(frozen=True)
class Config:
    """Settings of a training run.

    `exploration` bounds the learned scale from above and falls geometrically to `final_exploration`, which bounds it
    from below: so no bonus on the entropy is needed, and the last policy is tuned close to how it will be flown. The
    learning rate of the policy follows `target_kl`, which falls linearly; that of the critic falls with it.
    """

    samples: int = 1_500_000  # transitions taken from the environment
    batch: int = 128  # episodes flown side by side
    steps: int = 16  # control periods flown between updates
    least_updates: int = 10  # fewer episodes are flown side by side where the samples would last for less
    epochs: int = 4  # passes over the data of an update, fewer where the policy has moved too far
    minibatches: int = 4
    critic_epochs: int = 0  # passes before those, in which only the critic learns
    width: int | None = None  # neurons of every layer of both networks; None: those of the paper
    learning_rate: float = 1e-3
    target_kl: float = 0.02  # divergence of the policies before and after an update
    final_rate: float = 0.3  # [-] last learning rate of the critic, and last target_kl, as a share of the first
    discount: float = 0.9
    trace: float = 0.95  # [-] lambda of generalised advantage estimation
    clip: float = 0.2
    exploration: float = 0.5  # standard deviation of the actions before the tanh
    final_exploration: float = 0.06
    norm: float = 1.0  # gradients of a larger norm are scaled down to it
    anywhere: bool = True  # whether later flights, as the first, start at any step of their reference
    curriculum: float = 0.5  # [-] share of the updates after which the last threshold and speed are reached
    episodes: int = 4000  # training episodes drawn

    def __post_init__(self):
        for name in ("samples", "batch", "steps", "least_updates", "epochs", "minibatches", "episodes", "width"):
            if getattr(self, name) is not None and not getattr(self, name) >= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected at least 1")
        for name in ("learning_rate", "target_kl", "clip", "final_exploration", "exploration", "norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected more than 0")
        if not self.critic_epochs >= 0:
            raise InputError(f"ppo.Config.critic_epochs {self.critic_epochs}: expected at least 0")
        for name in ("final_rate", "discount", "trace", "curriculum"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected between 0 and 1")
        if self.discount == 1:
            raise InputError("ppo.Config.discount 1: expected less than 1, flights have no end that a value knows")
        if self.final_exploration > self.exploration:
            raise InputError(f"--exploration {self.exploration}: expected at least {self.final_exploration}, the last")

    @property
    def side_by_side(self):
        """Episodes flown side by side."""
        return max(1, min(self.batch, self.samples // (self.least_updates * self.length)))

    @property
    def length(self):
        """Control periods flown between updates."""
        return min(self.steps, self.samples)

    @property
    def collected(self):
        """Transitions of an update."""
        return self.side_by_side * self.length

    @property
    def updates(self):
        """Updates that the samples last for."""
        return self.samples // self.collected


def _called(name):
    """A setting as the user gave it: an option of the commands, or a field where there is none."""
    options = ("samples", "batch", "width", "learning_rate", "curriculum", "exploration")
    return f"--{name.replace('_', '-')}" if name in options else f"ppo.Config.{name}"


# Few transitions an update and many updates: 128 robots learn several times faster from each transition than 512 do.
# The fixed wing starts level, not in the direction of its target: close to that no flight can still reach it, and the
# costs of such flights would drown what tells a near miss from a hit.
PRESETS = {
    "cartpole": Config(samples=600_000, discount=0.95, final_exploration=0.03, final_rate=0.1, curriculum=0.3),
    "quadrotor": Config(),
    "fixed_wing": Config(anywhere=False),
}


def finetuning(config, system):
    """Settings to continue in a target what was trained with `config`, on any number of samples.

    The policy flies already: it explores less and moves slowly, so that few transitions can't spoil it. Discount and
    starts stay as they are, because the critic knows no others.
    """
    changes = {"learning_rate": 3e-4, "target_kl": 0.01, "exploration": 0.1, "final_exploration": 0.05}
    return replace(config, samples=1000, curriculum=0.0, **changes)


def actor(network, task, seed=0):
    """The mean of the policy as a TensorDict module; nothing is drawn, the seed doesn't matter."""
    return as_mean_actor(network)


@dataclass
class Training:
    """Everything that a training run changes, so that it can be saved and continued."""

    network: torch.nn.Module
    optimizer: torch.optim.Optimizer
    generator: torch.Generator
    place: TensorDict  # where each robot is, see `place_keys`
    rate: float  # learning rate of the policy
    update: int = 0
    samples: int = 0
    skipped: int = 0  # minibatches left out because their gradient was not finite

    def state_dict(self):
        """Tensors and numbers only."""
        numbers = {name: getattr(self, name) for name in ("rate", "update", "samples", "skipped")}
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "place": dict(self.place.items()),
            **numbers,
        }

    def load_state_dict(self, saved, banks, config, task):
        """Continue where `saved` left off."""
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.generator.set_state(saved["generator"])
        place = {name: saved["place"][name].to(self.place.device) for name in place_keys(task)}
        self.place = TensorDict(place, batch_size=self.place.batch_size, device=self.place.device)
        for name in ("rate", "update", "samples", "skipped"):
            setattr(self, name, saved[name])


def begin(dynamics, task, banks, config, seed, network=None, fresh=actor_critic_for):
    """A training run before its first update.

    Args:
        network: go on with a copy of it; None: draw one from the seed and normalise it from random actions.
        fresh: (task, width) → what is drawn.
    """
    generator = torch.Generator().manual_seed(seed)
    with drawing_from(generator) as drawn:
        if network is None:
            network = fresh(task, config.width).to(banks[0].device)
            network.normalise(_random_flights(task, banks[-1], drawn))
            network.policy.limit(config.exploration, config.exploration)
        else:
            network = copy.deepcopy(network).to(banks[0].device)
        env = environment(dynamics, task, banks[stage(config, task, len(banks), 0)[1]], config.side_by_side)
        reseed(env, drawn)
        place = env.reset().select(*place_keys(task))
    groups = [{"params": list(part.parameters())} for part in (network.policy, network.critic)]
    return Training(network, torch.optim.Adam(groups), generator, place, config.learning_rate)


@contextmanager
def drawing_from(generator):
    """A block in which torch's global generators are seeded from `generator`; they are as before behind it."""
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield seed


def _random_flights(task, episodes, seed, steps=40):
    """What the environment shows (N,) where random actions lead to around the reference.

    Flown in the nominal robot, whose model is known: no transition of the robot that is trained in is spent on it.
    """
    size = 256 if task.camera is None else 8  # a picture holds as many numbers as 10 000 states
    env = environment(Dynamics(task.system), task, episodes, size)
    reseed(env, seed)
    return env.rollout(steps, break_when_any_done=False).reshape(-1)


def train(run, dynamics, task, banks, config):
    """Advance a training run to its last update; yields a dict of metrics after each.

    Args:
        run: `Training`, changed in place.
        dynamics: what is flown.
        banks: training episodes of each speed of the curriculum, slowest first.
    """
    with torch.random.fork_rng():  # TorchRL tries the policy out
        parts = joined(run.network, dynamics, task, banks[0], config)
    parts.tracking.anywhere = config.anywhere
    while run.update < config.updates:
        share = run.update / config.updates
        threshold, bank = stage(config, task, len(banks), run.update)
        _move(run, task, banks[bank], changed=bank != stage(config, task, len(banks), max(0, run.update - 1))[1])
        parts.tracking.threshold, parts.tracking.episodes = threshold, banks[bank]
        ceiling = config.exploration * (config.final_exploration / config.exploration) ** share
        run.network.policy.limit(config.final_exploration, ceiling)
        with drawing_from(run.generator) as seed:
            flown = fly(run, parts, seed)
            metrics = judge(flown, run.network, parts, config)
            fall = 1 - (1 - config.final_rate) * share
            study(flown, run, parts, config, fall)
            metrics |= improve(flown, run, parts, config, fall)
        run.update += 1
        run.samples += flown.numel()
        counts = {"update": run.update, "samples": run.samples, "threshold": threshold, "stage": bank}
        yield {**counts, **metrics, "learning_rate": run.rate, "skipped": run.skipped}


def _move(run, task, episodes, changed):
    """Enter other episodes, such as faster ones, on their reference at the same step."""
    if changed:
        rows, step = episodes[run.place["episode"].squeeze(-1)], run.place["step"].squeeze(-1)
        run.place["state"] = task.start(rows, step)
        run.place = run.place.exclude("pixels")  # of where they were
