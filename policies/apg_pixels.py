"""APG from pictures: the policy sees what a camera sees, the gradient comes through the dynamics alone.

Wiedemann, Wuest et al. (2023), sect. "Vision-based control": only the dynamics need a gradient, not the camera. The
partly trained policy is filmed; from each state in which a picture was taken, the actions that the network plans from
the picture are played in the dynamics, and the gradient of their cost reaches the convolutions through the actions.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from envs.errors import InputError
from envs.pixels import PLACE, reseed, tracking_env
from policies.apg import descend
from policies.footage import STRAY, Footage, film
from policies.modes import plan_cost
from policies.networks import FirstAction
from policies.pixel_network import PixelConfig, PixelNetwork

Network = PixelNetwork


@dataclass(frozen=True)
class Config:
    """Settings of a training run.

    A sample is a step whose pictures are used for training. They are filmed in rounds by the policy of the time, spread
    evenly over the updates, and all that were filmed so far are used over and over. Each use is another picture of
    another state: the scene is shifted along the rail, which the cost doesn't see, and mirrored.
    """

    samples: int = 1000  # steps filmed
    rounds: int = 10  # parts that they are filmed in
    flights: int = 10  # robots that fly side by side while they are filmed
    updates: int = 1500
    batch: int = 64
    learning_rate: float = 2e-3
    final_rate: float = 0.02  # [-] last learning rate as a share of the first
    warmup: float = 0.05  # [-] share of the updates in which the learning rate rises
    decay: float = 1e-4  # weight decay
    clip: float = 1.0  # [-] gradients of a larger norm are scaled down to it
    first_exploration: float = 0.3  # standard deviation of the random actions of the first round
    exploration: float = 0.1  # standard deviation of noise on the flown actions
    stray: float = STRAY
    shift: int = 30  # [px] most that a picture is shifted to either side
    mirror: bool = True
    brightness: float = 0.0  # [-] most that the brightness of a picture is changed to either side
    episodes: int = 1000  # training episodes drawn
    every: ClassVar[int] = 250  # updates between validations, unless another number is asked for
    validations: ClassVar[int] = 10  # episodes flown in each

    def __post_init__(self):
        for name in ("samples", "rounds", "flights", "updates", "batch", "episodes"):
            if not getattr(self, name) >= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected at least 1")
        for name in ("learning_rate", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected more than 0")
        for name in ("final_rate", "warmup", "decay", "first_exploration", "exploration", "stray", "brightness"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected between 0 and 1")
        if self.shift < 0:
            raise InputError(f"{_called('shift')} {self.shift}: expected at least 0")

    @property
    def side_by_side(self):
        """Robots that fly side by side: no more than there are samples in a round."""
        return max(1, min(self.flights, self.samples // self.rounds))

    def filmed(self, update):
        """Samples that an update may use: a round more every so often, of whole steps of all robots."""
        rounds = min(self.rounds, self.samples, self.updates)
        done = min(rounds, update * rounds // self.updates + 1)
        return self.samples * done // rounds // self.side_by_side * self.side_by_side


def _called(name):
    """A setting as the user gave it: an option of the commands, or a field where there is none."""
    options = ("updates", "samples", "batch", "learning_rate", "exploration")
    return f"--{name.replace('_', '-')}" if name in options else f"apg_pixels.Config.{name}"


PRESETS = {"cartpole": Config()}


def finetuning(config, system):
    """Settings to continue the training of a policy that was trained with `config`.

    No smaller learning rate: with a quarter of it the error in a target stayed twice as large after as many updates
    (validation, another background).
    """
    return replace(config, rounds=1, updates=500)


def actor(network, task, seed=0):
    """The first action of the network's plan, as a TensorDict module; nothing is drawn, the seed doesn't matter."""
    return TensorDictModule(FirstAction(network), in_keys=["pixels"], out_keys=["action"])


@dataclass
class Training:
    """Everything that a training run changes, so that it can be saved and continued."""

    network: nn.Module
    optimizer: torch.optim.Optimizer
    generator: torch.Generator
    env: object
    footage: Footage
    place: TensorDict  # where the filmed robots are
    films: bool = True  # whether it films more; not where the footage was given
    fresh: bool = True  # whether the network was drawn, so that nothing can be flown with it at first
    update: int = 0
    skipped: int = 0  # updates left out because their gradient was not finite

    @property
    def samples(self):
        """Steps filmed so far."""
        return len(self.footage)

    def state_dict(self):
        """Tensors and numbers only."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "place": dict(self.place.select(*PLACE, "measured", strict=False).items()),
            "footage": self.footage.tensors(),
            "update": self.update,
            "skipped": self.skipped,
        }

    def load_state_dict(self, saved, banks, config, task):
        """Continue where `saved` left off."""
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.generator.set_state(saved["generator"])
        device = self.env.device
        self.place = TensorDict(saved["place"], batch_size=self.place.batch_size, device=device)
        self.footage = Footage(**{name: part.to(device) for name, part in saved["footage"].items()})
        self.update, self.skipped = saved["update"], saved["skipped"]


def begin(dynamics, task, banks, config, seed, network=None, footage=None):
    """A training run before its first update.

    Args:
        dynamics: what is filmed.
        network: go on with a copy of it; None: draw one from the seed, which is normalised by the first pictures.
        footage: what was filmed already; nothing more is then.

    Raises:
        InputError: a task without a camera.
    """
    contract = PixelNetwork.contract(task)
    generator = torch.Generator().manual_seed(seed)
    device = banks[0].device
    fresh = network is None
    if fresh:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = PixelNetwork(PixelConfig(**contract)).to(device)
    else:
        network = copy.deepcopy(network)
    env = tracking_env(
        dynamics, task, banks[-1], (config.side_by_side,), device, seed, threshold=config.stray * task.thresholds[1]
    )
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=config.decay)
    place = env.reset()
    films = footage is None
    footage = Footage.empty(task, device) if films else footage
    run = Training(network, optimizer, generator, env, footage, place, films, fresh)
    _film(run, config, 0)
    if fresh:
        network.encoder.normalise(run.footage.pixels(torch.arange(run.samples, device=device)))
    else:
        network.encoder.expose(run.footage.frames)
    return run


def _film(run, config, update):
    """Fly on until there are as many samples as an update may use."""
    steps = (config.filmed(update) - run.samples) // config.side_by_side
    if steps <= 0 or not run.films:
        return
    untrained = run.fresh and run.samples == 0
    noise = config.first_exploration if untrained else config.exploration
    reseed(run.env, int(torch.randint(2**31, (), generator=run.generator)))
    policy = None if untrained else actor(run.network, None)
    run.place = film(run.footage, run.env, policy, run.place, steps, noise, run.generator)


def train(run, dynamics, task, banks, config):
    """Advance a training run to its last update; yields a dict of metrics after each.

    Args:
        run: `Training`, changed in place.
        dynamics: what the gradient flows through; pictures are taken in those that the run was begun with.
    """
    while run.update < config.updates:
        _film(run, config, run.update)
        state, pixels = varied(run.footage, task.system, config, run.generator)
        cost = plan_cost(dynamics, task, state, run.network(pixels), task.reference(None, None, state)).mean()
        norm = descend(run, cost, config)
        run.update += 1
        yield {
            "update": run.update,
            "samples": run.samples,
            "cost": float(cost.detach()),
            "gradient_norm": norm,
            "skipped": run.skipped,
        }


def varied(footage, system, config, generator):
    """A batch of states (B, n) and pictures (B, C, H, W) of them, shifted and mirrored at random."""
    rows = torch.randint(len(footage), (config.batch,), generator=generator).to(footage.state.device)
    state, pixels = footage.state[rows], footage.pixels(rows)
    if config.shift:
        by = int(torch.randint(-config.shift, config.shift + 1, (), generator=generator))
        pixels = pixels.roll(by, -1)
    if config.mirror:
        half = config.batch // 2
        state = torch.cat((state[:half], system.mirrored(state[half:])))
        pixels = torch.cat((pixels[:half], pixels[half:].flip(-1)))
    if config.brightness:
        factor = 1 + config.brightness * (2 * torch.rand(config.batch, 1, 1, 1, generator=generator) - 1)
        pixels = (pixels * factor.to(pixels.device)).round().clamp(0, 255).to(torch.uint8)
    return state, pixels
