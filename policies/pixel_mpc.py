"""Planning on pictures: learn how pictures change, and search for actions that lead to a goal picture.

The planner sees pictures only, as the image policies do: no state and no equations. From a budget of filmed steps it
learns a latent (principal components of a picture), and how the latents of the last pictures and an action give those
of the next. It plans with the cross-entropy method; the cost is the squared distance of each predicted picture to the
nearest of the goal pictures, which show the robot at rest at many places, plus that to the picture before it. So is
visual foresight (Finn and Levine 2017, "Deep Visual Foresight for Planning Robot Motion"), with a smaller model.

The paper calls image-space MPC unstable on the CartPole. With these settings, found on validation episodes, it isn't:
1000 samples are enough to hold the pole in every episode. What it takes, and what limits it, on the same episodes:

- The distance to a goal picture sees no velocity: an upright pole that falls costs nothing. With it alone (`rest` 0) a
  quarter of the episodes fail, and the cart is twice as fast; so it is where the true equations and drawing take the
  place of the learned model. It is the weight on what changes between two pictures that helps.
- 0.1 m/s moves the cart by 0.15 px between two pictures, and a pole's distance from upright flattens once the two no
  longer overlap. The cost is nearly flat where the cart is slow, and the speed stays above that of APG from pictures.
- Random actions cover some 0.4 m of the rail. Without pictures that are shifted along it, the latent is lost where the
  cart drifts farther, and so is the pole.
- Trained on single steps in place of several of its own (`unroll` 1), the network is twice as far off in speed.
- The nearest of the recorded transitions (`model="nearest"`) mostly says nothing about the action: all episodes fail,
  after a dozen steps.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from envs.errors import InputError
from envs.pixels import tracking_env
from policies.cem import CEM, PlannerConfig
from policies.footage import Footage, film
from policies.image_model import ImageModel, learn

PICTURES = 2000  # the principal components are those of about so many pictures at most
CHUNK = 500  # pictures turned into numbers at once


@dataclass(frozen=True)
class Config:
    """Settings of learning and planning."""

    samples: int = 1000  # steps filmed
    flights: int = 10  # robots filmed side by side
    exploration: float = 0.15  # standard deviation of their random actions
    episodes: int = 1000  # training episodes drawn
    mirror: bool = True  # learn from mirror images, too
    shifts: tuple[int, ...] = (-16, -8, 0, 8, 16)  # [px] and from pictures shifted along the rail
    latent: int = 24  # principal components
    history: int = 3  # pictures that a prediction reads
    model: Literal["network", "nearest"] = "network"  # or the recorded transition that is nearest
    width: int = 128  # neurons of the two hidden layers
    updates: int = 3000
    batch: int = 64
    unroll: int = 5  # steps that the network predicts in a row while it is trained
    learning_rate: float = 2e-3
    decay: float = 1e-3  # weight decay
    rest: float = 30.0  # [-] weight of the squared distance between successive pictures
    goals: int = 241  # goal pictures
    reach: float = 1.2  # [m] the farthest of them from the middle of the picture
    planner: PlannerConfig = field(default_factory=lambda: PlannerConfig(elites=8, warm_std=0.1, min_std=0.01))

    @property
    def views(self):
        """What is learned from: (shift, whether mirrored) of the pictures."""
        return tuple(
            (shift, mirrored) for shift in self.shifts for mirrored in ((False, True) if self.mirror else (False,))
        )

    def __post_init__(self):
        counts = ("samples", "flights", "episodes", "latent", "history", "width", "updates", "batch", "unroll", "goals")
        for name in counts:
            if not getattr(self, name) >= 1:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected at least 1")
        for name in ("learning_rate", "reach", "exploration"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected more than 0")
        for name in ("decay", "rest"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{_called(name)} {getattr(self, name)}: expected at least 0")
        if self.model not in ("network", "nearest"):
            raise InputError(f"{_called('model')} {self.model!r}: expected network or nearest")
        if not self.shifts:
            raise InputError(f"{_called('shifts')} is empty: expected (0,) for pictures as they are")


def _called(name):
    """A setting as the user gave it."""
    return f"--{name}" if name == "samples" else f"pixel_mpc.Config.{name}"


def fit(dynamics, task, config, seed, progress=None):
    """Film robots that act at random in `dynamics`, and learn from the pictures and actions.

    Args:
        dynamics: what is filmed, `config.samples` steps at most. Its equations and the states aren't seen.
        progress: wraps the iterable of updates, as `tqdm` does.

    Returns:
        An `ImageModel`.

    Raises:
        InputError: a task without a camera, or too few samples.
    """
    if task.camera is None:
        raise InputError(f"{task.system.name}: the task has no camera; give it one with replace(task, camera=Camera())")
    generator = torch.Generator().manual_seed(seed)
    footage = filmed(dynamics, task, config, seed, generator)
    stacks, action, following = sequences(footage, config)
    rows = windows(following, config.unroll)
    if not len(rows):
        raise InputError(f"--samples {config.samples}: none in a row of {config.unroll + 1}; film more")
    chosen = torch.randperm(len(footage), generator=generator)[: math.ceil(PICTURES / len(config.views))]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = ImageModel(task, config, torch.cat([viewed(footage.frames[chosen], *view) for view in config.views]))
        views = (viewed(footage.frames, *view) for view in config.views)
        newest = torch.cat([model.encode(part) for view in views for part in view.split(CHUNK)])
        latents = newest[stacks[:, : model.history]]
        learn(model, config, latents, action, following, rows, generator, progress)
    return model.requires_grad_(False)


def filmed(dynamics, task, config, seed, generator, split="train"):
    """`Footage` of robots that act at random, each from the start of another episode wherever one has ended."""
    flights = min(config.flights, config.samples)
    env = tracking_env(dynamics, task, task.episodes(config.episodes, split, seed), (flights,), seed=seed)
    footage = Footage.empty(task)
    film(footage, env, None, env.reset(), config.samples // flights, config.exploration, generator)
    return footage


def sequences(footage, config):
    """Rows of each stack (N, frames), actions (N, m), and the row of the next step (N,) or -1, of all views in turn.

    The states of the footage are not used.
    """
    following = torch.full((len(footage),), -1)
    order = footage.flight.argsort(stable=True)
    onward = footage.flight[order[1:]] == footage.flight[order[:-1]]
    following[order[:-1][onward]] = order[1:][onward]
    offsets = len(footage) * torch.arange(len(config.views)).unsqueeze(-1)
    stacks = (footage.stacks.flatten() + offsets).view(-1, footage.stacks.shape[1])
    action = torch.cat([-footage.action if mirrored else footage.action for _, mirrored in config.views])
    return stacks, action, torch.where(following < 0, -1, following + offsets).flatten()


def viewed(pictures, shift, mirrored):
    """Pictures (..., width) moved to the right by some columns, repeating those at the edge, and perhaps mirrored."""
    width = pictures.shape[-1]
    moved = pictures[..., (torch.arange(width) - shift).clamp(0, width - 1)]
    return moved.flip(-1) if mirrored else moved


def windows(following, length):
    """Rows (W, length) of steps that follow one another, each with a next picture."""
    rows = (following >= 0).nonzero()
    for _ in range(length - 1):
        onward = following[rows[:, -1:]]
        rows = torch.cat((rows, onward), -1)[following[onward[:, 0]] >= 0]
    return rows


class LatentSearch(CEM):
    """The cross-entropy method over latents (B, F, k) in place of states, with the image cost of an `ImageModel`."""

    def cost(self, state, plans, reference):
        """Image cost (B, N) of plans (B, N, T, m) from latents (B, F, k), infinite where it isn't finite."""
        latents, total = state.unsqueeze(1).expand(-1, plans.shape[1], -1, -1), 0.0
        for action in plans.unbind(-2):
            latents = self.dynamics(latents, action)
            total = total + self.dynamics.cost(latents)
        return torch.where(total.isfinite(), total, math.inf)


class PixelPlanner(TensorDictModuleBase):
    """A TensorDict policy that plans in an `ImageModel` at every step.

    It reads `pixels` (*B, 3 * frames, height, width) and writes `action` (*B, m). `episode`, `step` and `done` (*B, 1)
    are read where they are there, to go on from the last plan and to leave out what has ended. `calls` and `failures`
    count as those of `CEM` do.

    Args:
        seed: of all samples that are drawn.
    """

    def __init__(self, model, task, config, seed=0):
        super().__init__()
        self.in_keys, self.out_keys = ["pixels"], ["action"]
        self.model, self.search = model, LatentSearch(model, task, config.planner, seed)

    @property
    def calls(self):
        """Plans made."""
        return self.search.calls

    @property
    def failures(self):
        """Plans of which no candidate had a finite cost."""
        return self.search.failures

    @torch.no_grad()
    def forward(self, tensordict):
        batch, keys = tensordict.batch_size, set(tensordict.keys())
        latents = self.model.seen(tensordict["pixels"])
        seen = {"state": latents, "reference": latents.new_empty(*batch, 0)}  # the goals belong to the model
        seen.update((key, tensordict[key]) for key in ("episode", "step", "done") if key in keys)
        tensordict["action"] = self.search(TensorDict(seen, batch, device=tensordict.device))["action"]
        return tensordict


def actor(model, task, config, seed=0):
    """The planner in a fitted `ImageModel`; the seed is that of all samples that it draws."""
    return PixelPlanner(model, task, config, seed)
