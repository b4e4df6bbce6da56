"""The one closed-loop evaluation that every policy of every method goes through."""

import time
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from envs.drawing import draw
from envs.dynamics import sensed
from envs.pixels import tracking_env

WARM_UP = 20  # calls that are not timed: the first ones set things up
TEST_EPISODES = {"cartpole": 50, "quadrotor": 50, "fixed_wing": 30}  # as many as the published tables use


@dataclass(frozen=True)
class Evaluation:
    """Result of flying N episodes: a table with one row each, and the true states (N, steps + 1, n).

    Behind the end of an episode, states repeat the last one; actions there led to nothing, or are zero.
    """

    table: pd.DataFrame  # columns episode, error, success
    metric: str
    unit: str
    states: torch.Tensor
    actions: torch.Tensor  # (N, steps, m)
    episodes: torch.Tensor

    @property
    def summary(self):
        """`mean` and `std` of the metric over the successful episodes, share of `success`, `n` episodes."""
        good = self.table.error[self.table.success]
        return {
            "mean": float(good.mean()) if len(good) else float("nan"),
            "std": float(good.std(ddof=0)) if len(good) else float("nan"),
            "success": float(self.table.success.mean()),
            "n": len(self.table),
        }

    def __str__(self):
        s = self.summary
        return f"{s['mean']:.4f} ± {s['std']:.4f} {self.unit}, success {s['success']:.2f}, N = {s['n']}"


def evaluate(actor, dynamics, task, episodes, progress=None):
    """Fly every row of `episodes` once from its start with a TensorDict policy; deterministic.

    States behind the end of an episode repeat the last one. The policy is still called on such a row while others fly,
    with `done` set, so that a planner can leave it out; when all have ended, so does the evaluation. Dynamics that are
    `one_at_a_time`, as a plant is, fly the episodes one after another. Where sensors err, a policy sees what they say,
    with the same noise for every policy that flies these episodes, and is scored by where it truly was.

    Args:
        progress: wraps the iterable of steps, or of flights one at a time, as `tqdm` does.
    """
    if getattr(dynamics, "one_at_a_time", False):
        rows = range(len(episodes))
        flights = [_flown(actor, dynamics, task, episodes[i : i + 1]) for i in (progress(rows) if progress else rows)]
        states, actions = (torch.cat(parts) for parts in zip(*flights, strict=True))
    else:
        states, actions = _flown(actor, dynamics, task, episodes, progress)
    error, success = task.score(episodes, states)
    table = {"episode": range(len(episodes)), "error": error.cpu().numpy(), "success": success.cpu().numpy()}
    return Evaluation(pd.DataFrame(table), task.metric, task.unit, states, actions, episodes)


def _flown(actor, dynamics, task, episodes, progress=None):
    """States (N, steps + 1, n) and actions (N, steps, m) of episodes flown side by side."""
    env = tracking_env(dynamics, task, episodes, batch_size=(len(episodes),), device=episodes.device)
    rows = torch.arange(len(episodes), device=episodes.device).unsqueeze(-1)
    now = env.reset(TensorDict({"episode": rows}, batch_size=env.batch_size), set_state=True)
    states, actions, done = [now["state"]], [], torch.zeros_like(now["done"])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in progress(range(task.steps)) if progress else range(task.steps):
            following = env.step(actor(now))
            states.append(torch.where(done, states[-1], following["next", "state"]))
            actions.append(following["action"])
            done = done | following["next", "done"]
            now = step_mdp(following).set("done", done)
            if done.all():
                break
    missing = task.steps - len(actions)
    states = torch.stack(states + missing * states[-1:], 1)
    actions += missing * [torch.zeros_like(actions[-1])]
    return states, torch.stack(actions, 1)


def test_episodes(task, n=None, split="test", seed=0):
    """The episodes that results are reported on: drawn from a split that nothing is trained or tuned on."""
    return task.episodes(n or TEST_EPISODES.get(task.system.name, 50), split, seed)


def action_time(actor, dynamics, task, calls=300):
    """Median and 99th percentile [ms] of one action in flight: batch 1, one thread, observation included.

    Validation episodes are flown in `dynamics`, because a planner is quicker where it can start from its last plan. The
    first calls aren't timed.
    """
    flown = FlightForTiming(dynamics, task)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    seconds = []
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for _ in range(WARM_UP + calls):
                begin = time.perf_counter()
                answer = actor(flown.seen())
                seconds.append(time.perf_counter() - begin)
                flown.advance(answer)
    finally:
        torch.set_num_threads(threads)
    seconds = seconds[WARM_UP:]
    return {"median_ms": 1e3 * float(np.median(seconds)), "p99_ms": 1e3 * float(np.quantile(seconds, 0.99))}


class FlightForTiming:
    """One validation episode after another at batch 1, without what an environment computes beside the observation."""

    def __init__(self, dynamics, task, episodes=20):
        self.dynamics, self.task = dynamics, task
        self.episodes, self.generator = task.episodes(episodes, "validation", 0), torch.Generator().manual_seed(0)
        self._begin(0)

    def _begin(self, episode):
        self.episode, self.step = torch.tensor([episode % len(self.episodes)]), torch.zeros(1, dtype=torch.long)
        self.state = self.task.start(self.episodes[self.episode], self.step)
        self.pictures, self.memory = None, {}

    def seen(self):
        """What a policy reads, computed now."""
        task, state = self.task, self.measured()
        reference = task.reference(self.episodes[self.episode], self.step, state)
        seen = {"observation": task.observe(state), "window": task.window(state, reference), "reference": reference}
        place = {"state": state, "episode": self.episode.unsqueeze(-1), "step": self.step.unsqueeze(-1)}
        if task.camera is not None:
            seen["pixels"] = self._stacked()
        return TensorDict({**seen, **place, **self.memory}, batch_size=(1,))

    def measured(self):
        """What sensors say of the present state."""
        noise = getattr(self.dynamics, "noise", ())
        return sensed(self.dynamics.system, self.state, noise, self.generator) if noise else self.state

    def _stacked(self):
        """The last pictures; the present one is drawn now."""
        camera = self.task.camera
        picture = draw(camera, self.dynamics.system, self.state)
        older = self.pictures[:, :-3] if self.pictures is not None else picture.repeat(1, camera.frames - 1, 1, 1)
        self.pictures = torch.cat((picture, older), 1)
        return self.pictures

    def advance(self, answer):
        """One control period with the `action` of a policy's answer; the next episode where this one has ended."""
        self.memory = dict(answer.get("next", {}))  # what a recurrent policy remembers
        self.state, self.step = self.dynamics(self.state, answer["action"]), self.step + 1
        place = self.episodes[self.episode], self.step, self.state
        ended = (self.step >= self.task.steps) | self.task.diverged(*place) | self.task.arrived(*place)
        if bool(ended):
            self._begin(int(self.episode) + 1)
