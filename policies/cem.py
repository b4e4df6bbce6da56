"""Planning by the cross-entropy method inside learned dynamics, for many robots at once.

Botev, Kroese, Rubinstein and L'Ecuyer (2013), "The cross-entropy method for optimization", with the momentum and the
trajectory sampling of Chua et al. (2018), and a warm start. Shapes below: B robots, N candidates, T the planning
horizon, E members of the ensemble, P particles of each, n states, m actions.
"""

import math
from dataclasses import dataclass

import torch
from torchrl.modules import CEMPlanner

from envs.env import TrackingEnv, measured
from envs.errors import InputError

ROWS = 5000  # particles that are advanced at once: more would not stay in the cache of a core


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of the planner."""

    horizon: int = 10  # control periods; not more than that of the task are planned
    candidates: int = 100
    elites: int = 10
    iterations: int = 3
    particles: int = 1  # for each member of the ensemble
    momentum: float = 0.1  # [-] share of the old mean and standard deviation that is kept
    cold_std: float = 0.5  # first standard deviation where there is no plan to start from
    warm_std: float = 0.2  # and where there is one
    min_std: float = 0.02

    def __post_init__(self):
        for name in ("horizon", "candidates", "elites", "iterations", "particles"):
            if getattr(self, name) < 1:
                raise InputError(f"PlannerConfig.{name} {getattr(self, name)}: expected at least 1")
        if self.elites > self.candidates:
            raise InputError(f"PlannerConfig.elites {self.elites}: expected at most the {self.candidates} candidates")
        if not 0 <= self.momentum < 1:
            raise InputError(f"PlannerConfig.momentum {self.momentum}: expected at least 0 and less than 1")
        for name in ("cold_std", "warm_std", "min_std"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"PlannerConfig.{name} {getattr(self, name)}: expected more than 0")


class CEM(CEMPlanner):
    """TorchRL's planner for batched environments, with warm start, momentum, a least standard deviation and particles.

    A TensorDict policy: reads `state`, or in its place `measured`, and `reference`, writes `action`. Where `episode`
    and `step` say that a row goes on from its last call, it starts from the rest of its last plan. Rows with `done` set
    get the trim action.

    A plan's cost is that of the task, averaged over all particles. Candidates of an iteration share their noise, so
    that they are compared on equal terms. One whose cost isn't finite is never an elite; where none is finite in any
    iteration, the rest of the last plan is flown (trim, where there is none) and the row counts as a failure.

    Args:
        dynamics: has `members`, `outputs` and `sample`, as `EnsembleDynamics` has.
        seed: of everything that is drawn.
    """

    def __init__(self, dynamics, task, config, seed=0):
        world = TrackingEnv(dynamics, task, task.episodes(1, "train", 0))
        horizon = min(config.horizon, task.horizon)
        super().__init__(world, horizon, config.iterations, config.candidates, config.elites)
        self.in_keys = ["state", "reference"]
        self.dynamics, self.task, self.config = dynamics, task, config
        self.generator = torch.Generator().manual_seed(seed)
        self.memory = None  # means (B, T, m), episode and step (B,) of the last call
        self.calls, self.failures = 0, 0

    @torch.no_grad()
    def planning(self, tensordict):
        """The first actions (*B, m) of the plans."""
        batch = tensordict.batch_size
        state, reference = (
            part.flatten(0, len(batch) - 1) if batch else part[None]
            for part in (measured(tensordict), tensordict["reference"])
        )
        mean, warm, place = self._start(tensordict, state)
        std = torch.where(warm, self.config.warm_std, self.config.cold_std).to(state)
        flying = self._flying(tensordict, len(state))
        self.calls += len(flying)
        size = max(1, ROWS // (self.dynamics.members * self.config.particles * self.config.candidates))
        for rows in flying.split(size):
            mean[rows], failed = self.optimise(state[rows], reference[rows], mean[rows], std[rows])
            self.failures += int(failed.sum())
        self.memory = (mean, *place) if place else None
        action = mean[:, 0].clone()
        resting = torch.ones(len(action), dtype=torch.bool, device=action.device)
        resting[flying] = False
        action[resting] = self._trim(action)
        return action.reshape(*batch, -1)

    def optimise(self, state, reference, mean, std):
        """Improve plans by sampling.

        Args:
            state: (B, n).
            reference: (B, H, r).
            mean: plans (B, T, m) to start from.
            std: (B,) standard deviation to start with.

        Returns:
            Plans (B, T, m), and which rows failed (B,), whose plan is the one that was given.
        """
        std = std[:, None, None].expand_as(mean)
        failed = torch.ones(len(mean), dtype=torch.bool, device=mean.device)
        keep = self.config.momentum
        for _ in range(self.optim_steps):
            plans = self._candidates(mean, std)
            cost, elite = self.cost(state, plans, reference).topk(self.top_k, dim=-1, largest=False)
            best = plans.gather(1, elite[..., None, None].expand(-1, -1, *mean.shape[1:]))
            weight = cost.isfinite()[..., None, None].to(mean)
            count = weight.sum(1)
            centre = (weight * best).sum(1) / count
            spread = ((weight * (best - centre[:, None]).square()).sum(1) / count).sqrt()
            good = count > 0
            mean = torch.where(good, keep * mean + (1 - keep) * centre, mean)
            std = torch.where(good, keep * std + (1 - keep) * spread, std).clamp(min=self.config.min_std)
            failed = failed & ~good[:, 0, 0]
        return mean, failed

    def _candidates(self, mean, std):
        """Plans (B, N, T, m) about the mean, which is the first of them."""
        shape = (len(mean), self.num_candidates, *mean.shape[1:])
        noise = torch.randn(shape, generator=self.generator).to(mean)
        noise[:, 0] = 0
        return torch.addcmul(mean[:, None], std[:, None], noise).clamp_(-1, 1)

    def cost(self, state, plans, reference):
        """Mean cost (B, N) of plans (B, N, T, m) from state (B, n), infinite where it isn't finite."""
        members, particles = self.dynamics.members, self.config.particles
        batch = (particles, *plans.shape[:2])
        x = state[:, None].expand(members, *batch, -1).flatten(1, -2)
        shape = (members, particles, len(plans), 1, self.dynamics.outputs)
        total = 0
        for k, action in enumerate(plans.unbind(-2)):
            noise = torch.randn(shape, generator=self.generator).to(x).expand(-1, -1, -1, batch[-1], -1).flatten(1, -2)
            x = self.dynamics.sample(x, action.expand(particles, -1, -1, -1).flatten(0, -2), noise)
            total = total + self.task.cost(x.unflatten(1, batch), action, reference[:, None, k])
        total = total.mean((0, 1))
        return torch.where(total.isfinite(), total, math.inf)

    def _start(self, tensordict, state):
        """Plans to start from, which of them are the rest of the last ones (B,), and episode and step (B,) if given."""
        rows = len(state)
        mean = self._trim(state).expand(rows, self.planning_horizon, -1).clone()
        warm = torch.zeros(rows, dtype=torch.bool, device=state.device)
        if not {"episode", "step"} <= set(tensordict.keys()):
            return mean, warm, None
        place = tuple(tensordict[key].reshape(-1) for key in ("episode", "step"))
        if self.memory is not None and len(self.memory[0]) == rows:
            last, episode, step = self.memory
            warm = (place[0] == episode) & (place[1] == step + 1)
            rest = torch.cat((last[:, 1:], last[:, -1:]), 1)
            mean = torch.where(warm[:, None, None], rest, mean)
        return mean, warm, place

    def _flying(self, tensordict, rows):
        done = tensordict.get("done", None)
        if done is None:
            return torch.arange(rows, device=tensordict.device)
        return (~done.reshape(-1)).nonzero()[:, 0]

    def _trim(self, like):
        return like.new_tensor(self.task.system.trim_action)
