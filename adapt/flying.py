"""Fly a policy in a target to record transitions."""

import copy
import math
from dataclasses import replace

import torch

from adapt.transitions import LARGEST, Transitions
from envs.errors import InputError


def collect(policy, env, n, exploration=0.0, generator=None):
    """Fly a policy in a target until `n` transitions are recorded; no gradient.

    Whole trajectories count one after another, the last one as far as it is needed: 1000 are ten flights of 100 steps,
    30 are the beginning of one. What follows the end of an episode isn't used, nor what no robot can do (numbers
    beyond all bounds). A target that is `one_at_a_time`, as a plant is, flies the same episodes with the same noise one
    after another; if it is lost, fewer are recorded. Where a target's sensors err, the states are those that were
    measured, which the policy saw.

    Args:
        policy: TensorDict module that reads `observation` and `window` and writes `action`.
        env: `TrackingEnv` of the target, or the (dynamics, task, episodes) to make one of. Its episodes are flown in
            random order, each again only after all others.
        exploration: standard deviation of Gaussian noise on the actions, which stay in [-1, 1].
        generator: draws episodes and noise, that of the measured states too; None is a fresh one with seed 0.

    Raises:
        InputError: `n` below 1, negative exploration, or a policy whose flights aren't finite.
    """
    if n < 1:
        raise InputError(f"collect: {n} transitions asked for, expected at least 1")
    if not 0 <= exploration < math.inf:
        raise InputError(f"collect: exploration is {exploration:g}, expected at least 0")
    if isinstance(env, tuple):
        from envs.pixels import tracking_env

        env = tracking_env(*env)
    generator = generator or torch.Generator().manual_seed(0)
    env.seed_noise(generator)
    flights, missing, queue = [], n, []
    while missing > 0 and not getattr(env.dynamics, "lost", False):
        count = math.ceil(missing / env.task.steps)
        while len(queue) < count:
            queue.extend(torch.randperm(len(env.episodes), generator=generator).tolist())
        size = (count, len(env.dynamics.system.Action._fields))
        noise = Noise(size, exploration, generator)
        flown = _fly(policy, env, queue[:count], min(missing, env.task.steps), noise)
        queue = queue[count:]
        if not any(len(state) for state, _, _ in flown) and not hasattr(env.dynamics, "lost"):
            raise InputError(
                "collect: every flight failed at once; the policy or the target gives numbers that aren't finite"
            )
        for flight in flown:
            flights.append(tuple(part[:missing] for part in flight))
            missing -= len(flights[-1][0])
    if not any(len(state) for state, _, _ in flights):
        first = next(iter(env.dynamics.report()["faults"]), "it was given up before")
        raise InputError(f"{env.dynamics.name}: no flight got past its first step ({first}); nothing to learn from")
    return _joined([flight for flight in flights if len(flight[0])], env.dynamics.system)


class Noise:
    """Exploration noise of flights: drawn step by step for all, so that each gets the same in whatever order they fly.

    Args:
        size: (flights, entries of an action).
        deviation: its standard deviation.
    """

    def __init__(self, size, deviation, generator):
        self.size, self.deviation, self.generator, self.drawn = size, deviation, generator, []

    def __call__(self, step, flights):
        """The noise (k, m) of k flights at a step."""
        while len(self.drawn) <= step:
            self.drawn.append(self.deviation * torch.randn(self.size, generator=self.generator))
        return self.drawn[step][flights]


def _fly(policy, env, episodes, steps, noise):
    """Fly episodes: for each, (state, action, next_state) up to its end."""
    rows = list(range(len(episodes)))
    together = [[row] for row in rows] if getattr(env.dynamics, "one_at_a_time", False) else [rows]
    return [flight for some in together for flight in _fly_together(policy, env, episodes, steps, noise, some)]


@torch.no_grad()
def _fly_together(policy, env, episodes, steps, noise, flights):
    """The same for some of the flights, side by side."""
    from tensordict import TensorDict
    from torchrl.envs.utils import step_mdp

    from envs.env import measured

    episodes = [episodes[flight] for flight in flights]
    start = TensorDict({"episode": torch.tensor(episodes).unsqueeze(-1)}, batch_size=len(episodes), device=env.device)
    now, record = env.reset(start, set_state=True), []
    flying = torch.ones(len(episodes), dtype=torch.bool)
    for step in range(steps):
        now = policy(now)
        now["action"] = (now["action"] + noise(step, flights).to(now["action"])).clamp(-1, 1)
        now = env.step(now)
        rows = tuple(part.cpu() for part in (measured(now), now["action"], measured(now["next"])))
        flying = flying & (torch.cat(rows, -1).abs() < LARGEST).all(-1)  # nor nan
        record.append((*rows, flying))
        flying = flying & ~now["next", "done"].squeeze(-1).cpu()
        if not flying.any():
            break
        now = step_mdp(now)
    *parts, valid = (torch.stack(series, 1) for series in zip(*record, strict=True))
    return [tuple(part[i][valid[i]] for part in parts) for i in range(len(episodes))]


def filmed(policy, target, task, episodes, n, exploration=0.0, generator=None, flights=10):
    """Fly a policy that sees pictures in a target: `Footage` of `n` steps.

    After a tenth of them it gets used to the brightness of the target: flights of one that is dazzled, and falls at
    once, teach little.

    Args:
        policy: `Policy`, which stays as it is.
        task: as it is seen in the target; it has a camera.
        flights: how many robots fly side by side; one that falls begins again, so few long flights give way to many.
    """
    from envs.pixels import tracking_env
    from policies.footage import STRAY, Footage, film

    generator = generator or torch.Generator().manual_seed(0)
    seed = int(torch.randint(2**31, (), generator=generator))
    size = min(flights, n)
    env = tracking_env(target, task, episodes, (size,), episodes.device, seed, threshold=STRAY * task.thresholds[1])
    footage, now = Footage.empty(task, episodes.device), env.reset()
    flown = replace(policy, network=copy.deepcopy(policy.network))
    steps = -(-n // size)
    for part in (-(-steps // 10), steps - -(-steps // 10)):
        now = film(footage, env, flown.actor(), now, part, exploration, generator)
        flown.network.encoder.expose(footage.frames)
    return footage.first(n)


def film_transitions(footage, system):
    """The transitions of footage, one flight after another."""
    order = footage.flight.argsort(stable=True).cpu()
    parts = [part.cpu()[order] for part in (footage.state, footage.action, footage.next_state, footage.flight)]
    return Transitions(*parts, system.dt, system.name, system.State._fields, system.Action._fields)


def _joined(flights, system):
    state, action, next_state = (torch.cat(parts) for parts in zip(*flights, strict=True))
    trajectory = torch.cat([torch.full((len(flight[0]),), i, dtype=torch.int64) for i, flight in enumerate(flights)])
    names = (system.State._fields, system.Action._fields)
    return Transitions(state, action, next_state, trajectory, system.dt, system.name, *names)
