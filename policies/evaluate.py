"""The one closed-loop evaluation that every policy of every method goes through."""

import time
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from envs.env import TrackingEnv

WARM_UP = 20  # calls that are not timed: the first ones set things up
TEST_EPISODES = {"cartpole": 50, "quadrotor": 50, "fixed_wing": 30}  # as many as the published tables use


@dataclass(frozen=True)
class Evaluation:
    """Result of flying N episodes: a table with one row each, and the flown states (N, steps + 1, n)."""

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


def evaluate(actor, dynamics, task, episodes):
    """Fly every row of `episodes` once from its start with a TensorDict policy; deterministic.

    States behind the end of an episode repeat the last one.
    """
    env = TrackingEnv(dynamics, task, episodes, batch_size=(len(episodes),), device=episodes.device)
    rows = torch.arange(len(episodes), device=episodes.device).unsqueeze(-1)
    now = env.reset(TensorDict({"episode": rows}, batch_size=env.batch_size))
    states, actions, done = [now["state"]], [], torch.zeros_like(now["done"])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(task.steps):
            following = env.step(actor(now))
            states.append(torch.where(done, states[-1], following["next", "state"]))
            actions.append(following["action"])
            done = done | following["next", "done"]
            now = step_mdp(following)
    states = torch.stack(states, 1)
    error, success = task.score(episodes, states)
    table = {"episode": range(len(episodes)), "error": error.cpu().numpy(), "success": success.cpu().numpy()}
    return Evaluation(pd.DataFrame(table), task.metric, task.unit, states, torch.stack(actions, 1), episodes)


def test_episodes(task, n=None, split="test", seed=0):
    """The episodes that results are reported on: drawn from a split that nothing is trained or tuned on."""
    return task.episodes(n or TEST_EPISODES.get(task.system.name, 50), split, seed)


def action_time(actor, task, calls=300):
    """Median and 99th percentile [ms] of one action at batch 1 on one thread, observation included, after a warm-up."""
    episodes, step = task.episodes(1, "validation", 0), torch.zeros(1, dtype=torch.long)
    state = task.start(episodes, step)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    seconds = []
    with torch.no_grad():
        for _ in range(WARM_UP + calls):
            begin = time.perf_counter()
            reference = task.reference(episodes, step, state)
            seen = {"observation": task.observe(state), "window": task.window(state, reference), "state": state}
            actor(TensorDict(seen, batch_size=(1,)))
            seconds.append(time.perf_counter() - begin)
    torch.set_num_threads(threads)
    seconds = seconds[WARM_UP:]
    return {"median_ms": 1e3 * float(np.median(seconds)), "p99_ms": 1e3 * float(np.quantile(seconds, 0.99))}
