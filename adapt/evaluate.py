"""Fly a policy over the test episodes: `python -m adapt.evaluate --system quadrotor --target drag=0.3`."""

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError


@dataclass(frozen=True)
class Options:
    """Evaluate a policy in closed loop over test episodes and print the metric, success and time per action."""

    system: str = "quadrotor"
    """Robot: cartpole, quadrotor or fixed_wing."""
    policy: str | None = None
    """Checkpoint (default: the one that ships for the robot)."""
    target: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What is different, such as drag=0.3 or mass=x1.2; may be repeated (default: nothing, the source)."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name such as crazyflie, or a TOML file."""
    set: str | None = None
    """Family of episodes (quadrotor: paper, fast, circle, lemniscate, line, hover, or a CSV of waypoints)."""
    split: str = "test"
    """Split that the episodes are drawn from: test, validation or train."""
    episodes: int | None = None
    """Number of episodes (default: 50; fixed_wing: 30)."""
    seed: int = 0
    """Seed of the episodes."""
    out: str | None = None
    """File for the results as JSON."""
    overwrite: bool = False
    """Replace the file."""
    device: str = "cpu"
    """Where to compute: cpu, cuda."""
    threads: int = 1
    """Threads of torch."""


def main(options):
    """Evaluate, print, and write JSON if asked for."""
    from envs.references import SPLITS
    from envs.registry import make_dynamics, make_task
    from policies.evaluate import action_time, evaluate, test_episodes
    from policies.networks import as_actor

    if options.split not in SPLITS:
        raise InputError(f"--split {options.split}: expected one of {', '.join(SPLITS)}")
    if options.episodes is not None and options.episodes < 1:
        raise InputError(f"--episodes {options.episodes}: expected at least 1")
    out = command.output_file("--out", options.out, options.overwrite, "metrics.json")
    command.check_seed(options.seed)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    system, vehicle = command.pick_robot(options.system, options.vehicle)
    policy = command.pick_policy(options.policy, system, vehicle)
    task = policy.task
    if options.set:
        task = make_task(system, options.set, horizon=task.horizon)
    dynamics = make_dynamics(system, options.target)
    episodes = test_episodes(task, options.episodes, options.split, options.seed).to(device)
    result = evaluate(as_actor(policy.network.to(device)), dynamics, task, episodes)
    spent = action_time(as_actor(policy.network.cpu()), task)
    print(f"{options.system} {task.set} {' '.join(options.target) or 'source'}: {task.metric} {result}")
    print(f"time per action: median {spent['median_ms']:.3f} ms, 99th percentile {spent['p99_ms']:.3f} ms, one thread")
    if out:
        content = {
            "options": asdict(options),
            "set": task.set,
            "metric": task.metric,
            "unit": task.unit,
            **result.summary,
            **spent,
        }
        content |= {
            "policy_info": policy.info,
            "table": result.table.to_dict("list"),
            **command.environment(options.seed, options.threads),
        }
        command.write_json(out, content)
        print(f"results in {out}")


if __name__ == "__main__":
    command.run("adapt.evaluate", Options, main)
