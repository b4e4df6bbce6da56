"""PETS: learn a probabilistic ensemble from flights, fly what is planned inside it, and learn from that again.

Chua, Calandra, McAllister and Levine (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
Dynamics Models". The first round flies random actions. Every transition taken from the environment counts towards the
budget; training in the ensemble is free. Where we differ: the flights of a round are flown side by side, bootstrap
samples are kept from round to round, and the normalisation is that of the first round.
"""

import copy
import math
from dataclasses import dataclass, field, replace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import step_mdp

from envs.env import TrackingEnv, measured
from envs.errors import InputError
from policies.cem import CEM, PlannerConfig
from policies.ensemble import Ensemble, EnsembleDynamics, FitConfig, fit, model_inputs, model_outputs

Network = Ensemble


@dataclass(frozen=True)
class Config:
    """Settings of a training run."""

    samples: int = 5000  # transitions taken from the environment, all rounds together
    rounds: int = 10
    members: int = 5  # networks in the ensemble
    width: int = 64
    layers: int = 2
    first_std: float = 0.3  # standard deviation of the first round's random actions about trim
    memory: float = 0.8  # [-] correlation of such an action with the one before it
    exploration: float = 0.02  # standard deviation of white noise on the planned actions of later rounds
    held_out: float = 0.1  # [-] share of the transitions that no member learns from
    episodes: int = 1000  # training episodes drawn
    every: int = 2  # rounds between validations
    validations: int = 20  # validation episodes flown each time
    fit: FitConfig = field(default_factory=FitConfig)
    planner: PlannerConfig | None = None  # None: the one that the network brings, or the default

    def __post_init__(self):
        if not self.samples >= 1:
            raise InputError(f"--samples {self.samples}: expected at least 1")
        for name in ("rounds", "members", "width", "layers", "episodes", "every", "validations"):
            if not getattr(self, name) >= 1:
                raise InputError(f"pets.Config.{name} {getattr(self, name)}: expected at least 1")
        for name in ("first_std", "exploration"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"pets.Config.{name} {getattr(self, name)}: expected 0 or more")
        for name in ("memory", "held_out"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"pets.Config.{name} {getattr(self, name)}: expected at least 0 and less than 1")

    @property
    def updates(self):
        """Rounds of flying and learning: never more than there are transitions to share out."""
        return min(self.rounds, self.samples)


PRESETS = {
    "cartpole": Config(
        samples=1500, rounds=3, width=32, every=1, planner=PlannerConfig(elites=8, warm_std=0.03, min_std=0.005)
    ),
    "quadrotor": Config(
        samples=6000, rounds=6, planner=PlannerConfig(horizon=8, elites=8, iterations=5, warm_std=0.15, min_std=0.005)
    ),
    "fixed_wing": Config(samples=2000, rounds=4, planner=PlannerConfig(elites=8, warm_std=0.15, min_std=0.005)),
}


def finetuning(config, system):
    """Settings to continue in a target what was trained with `config`: few transitions, all from planned flights."""
    return replace(config, samples=1000, rounds=4, every=1)


@dataclass
class Training:
    """Everything that a training run changes, so that it can be saved and continued.

    `flown` holds all transitions: `state` and `next_state` (N, n), `action` (N, m), and `counts` (N, E), how often the
    bootstrap sample of each member holds a row, -1 where it is held out.
    """

    network: Ensemble
    generator: torch.Generator
    flown: dict
    random_first: bool  # whether the first round flies random actions: not where a trained ensemble is continued
    update: int = 0
    samples: int = 0
    skipped: int = 0  # gradient steps left out because they were not finite
    failures: int = 0  # plans that fell back

    def state_dict(self):
        """Tensors and numbers only."""
        numbers = {name: getattr(self, name) for name in ("random_first", "update", "samples", "skipped", "failures")}
        return {
            "network": self.network.state_dict(),
            "generator": self.generator.get_state(),
            "flown": dict(self.flown),
            **numbers,
        }

    def load_state_dict(self, saved, banks, config, task):
        """Continue where `saved` left off, with what was flown until then."""
        self.network.load_state_dict(saved["network"])
        self.generator.set_state(saved["generator"])
        self.flown = {name: saved["flown"][name] for name in self.flown}
        for name in ("random_first", "update", "samples", "skipped", "failures"):
            setattr(self, name, saved[name])


def begin(dynamics, task, banks, config, seed, network=None):
    """A training run before its first round; without a network, a new one is drawn from the seed."""
    fresh = network is None
    if fresh:
        shape = {"members": config.members, "width": config.width, "layers": config.layers}
        planner = config.planner or PlannerConfig()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = Ensemble(Ensemble.Config(**Ensemble.contract(task), **shape, planner=planner))
    else:
        network = copy.deepcopy(network)
        network.config = replace(network.config, planner=config.planner or network.config.planner)
    network = network.to(banks[0].device)
    states, actions = len(task.system.State._fields), len(task.system.Action._fields)
    sizes = {"state": states, "action": actions, "next_state": states}
    flown = {name: torch.empty(0, size) for name, size in sizes.items()}
    flown["counts"] = torch.empty(0, network.config.members, dtype=torch.long)
    return Training(network, torch.Generator().manual_seed(seed), flown, fresh)


def train(run, dynamics, task, banks, config):
    """Advance a training run to its last round; yields a dict of metrics after each.

    Args:
        run: `Training`, changed in place.
        dynamics: what is flown. The ensemble never sees more of them than the transitions.
        banks: training episodes of each speed of the curriculum, slowest first; each round takes the next.

    Raises:
        InputError: no flight gives finite numbers.
    """
    while run.update < config.updates:
        budget = config.samples * (run.update + 1) // config.updates
        episodes = banks[min(run.update, len(banks) - 1)]
        seed = int(torch.randint(2**31, (), generator=run.generator))
        if run.update == 0 and run.random_first:
            fly_with, noise = random_actor(task, config, seed), 0.0
        else:
            fly_with, noise = actor(run.network, task, seed), config.exploration
        costs = []
        while run.samples < budget:
            rows, cost = fly(fly_with, dynamics, task, episodes, budget - run.samples, noise, run.generator)
            run.samples += len(cost)
            costs.append(cost)
            _remember(run, rows, config)
        failures = getattr(fly_with, "failures", 0)
        run.failures += failures
        likelihood = _learn(run, task.system, config)
        run.update += 1
        yield {
            "update": run.update,
            "samples": run.samples,
            "cost": float(torch.cat(costs).mean()),
            "nll": likelihood,
            "failures": failures,
            "skipped": run.skipped,
        }


@torch.no_grad()
def fly(policy, dynamics, task, episodes, budget, noise, generator):
    """Fly random episodes side by side, as many as the budget would last for, and each once at most to its end.

    The states are those that were measured, where sensors err.

    Returns:
        (state, action, next_state) of the transitions, (M, ...) each, the finite ones, and the cost of each transition
        taken, at most `budget` of them.
    """
    count = math.ceil(budget / task.steps)
    env = TrackingEnv(dynamics, task, episodes, batch_size=(count,), device=episodes.device)
    env.seed_noise(generator)
    chosen = torch.randint(len(episodes), (count, 1), generator=generator).to(episodes.device)
    now = env.reset(TensorDict({"episode": chosen}, batch_size=(count,), device=env.device))
    record, costs = [], []
    flying = torch.ones(count, dtype=torch.bool, device=env.device)
    while flying.any() and budget > 0:
        flying = flying & (flying.cumsum(0) <= budget)
        now = policy(now.set("done", ~flying.unsqueeze(-1)))
        exploring = noise * torch.randn(now["action"].shape, generator=generator).to(now["action"])
        now["action"] = (now["action"] + exploring).clamp(-1, 1)
        now = env.step(now)
        budget -= int(flying.sum())
        rows = tuple(part[flying].cpu() for part in (measured(now), now["action"], measured(now["next"])))
        finite = torch.cat(rows, -1).isfinite().all(-1)
        record.append(tuple(part[finite] for part in rows))
        costs.append(-now["next", "reward"][flying, 0].cpu())
        flying = flying & now["next", "state"].isfinite().all(-1) & ~now["next", "done"][:, 0]
        now = step_mdp(now)
    return tuple(torch.cat(parts) for parts in zip(*record, strict=True)), torch.cat(costs)


def _remember(run, rows, config):
    """Add transitions, each with its place in the bootstrap samples: Poisson counts, the online form of drawing rows
    with replacement (Oza and Russell 2001)."""
    count, members = len(rows[0]), run.network.config.members
    counts = torch.poisson(torch.ones(count, members), generator=run.generator).long()
    counts[torch.rand(count, generator=run.generator) < config.held_out] = -1
    for name, part in zip(("state", "action", "next_state", "counts"), (*rows, counts), strict=True):
        run.flown[name] = torch.cat((run.flown[name], part))


def _learn(run, system, config):
    """Fit the ensemble to all that was flown; the held-out negative log-likelihood."""
    if not len(run.flown["state"]):
        raise InputError("pets: no flight gave finite numbers; check the target")
    device = run.network.input_mean.device
    state, action, following, counts = (part.to(device) for part in run.flown.values())
    inputs, outputs = model_inputs(system, state, action), model_outputs(system, state, following)
    if run.update == 0 and run.random_first:
        run.network.normalise(inputs, outputs)
    likelihood, skipped = fit(run.network, inputs, outputs, counts, config.fit, run.generator)
    run.skipped += skipped
    return likelihood


def random_actor(task, config, seed):
    """Random actions about trim that change smoothly, an autoregressive process of the first order."""
    generator, fresh = torch.Generator().manual_seed(seed), math.sqrt(1 - config.memory**2)
    last = None

    def draw(state):
        nonlocal last
        trim = state.new_tensor(task.system.trim_action)
        drawn = torch.randn(*state.shape[:-1], len(trim), generator=generator).to(state)
        continued = last is not None and last.shape == drawn.shape
        last = config.memory * last + fresh * drawn if continued else drawn
        return (trim + config.first_std * last).clamp(-1, 1)

    return TensorDictModule(draw, in_keys=["state"], out_keys=["action"])


def actor(network, task, seed=0, **settings):
    """The planner that flies an ensemble: a TensorDict policy that reads `state` and `reference` and writes `action`.

    Args:
        seed: of the samples that it draws.
        settings: fields of `PlannerConfig` to change.
    """
    config = replace(network.config.planner, **settings)
    return CEM(EnsembleDynamics(network, task.system), task, config, seed)
