"""Train a policy that sees pictures, fly it and show what it sees: `python -m adapt.vision --samples 1000 --seed 0`."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command, pretrain
from envs.errors import InputError

METHODS = {"apg": 1000, "ppo": 150_000, "mpc": 1000}  # steps of the robot that each may use unless told otherwise
EPISODES = {"mpc": 20}  # test episodes where planning takes too long for all
# Ways to plan on pictures that one would try first, and what comes of them: settings of `pixel_mpc.Config`.
ATTEMPTS = {"mpc, distance to the goal alone": {"rest": 0.0}, "mpc, nearest recorded step": {"model": "nearest"}}
RESULTS = ("metrics.json", "learning.png", "frames.png", "saliency.png", "balance.mp4", *pretrain.OUTPUTS)


@dataclass(frozen=True)
class Options:
    """Train a policy of the CartPole that sees pictures only, evaluate it, and show what it sees.

    Writes metrics.json, policy.safetensors, log.csv, training.pt (to resume from), learning.png, frames.png,
    saliency.png and balance.mp4. A sample is a step of the robot whose pictures are used for training.
    """

    samples: int | None = None
    """Steps of the robot that may be used (default: 1000; 150000 for ppo)."""
    method: str = "apg"
    """apg, ppo, or mpc: image dynamics learned from as many samples, and planning towards a goal picture; the two plans
    that one would try first are flown beside it."""
    seed: int = 0
    """Seed of everything that is drawn."""
    target: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Train in a changed robot or picture, such as track_friction=0.1 or brightness=0.7; may be repeated. With noise=1,
    the states that go with the pictures are measured by sensors that err: 1 mm, 0.02 m/s, 0.5 deg, 0.05 rad/s, times
    1."""
    camera: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Setting of the camera, such as height=64 or scale=40; may be repeated."""
    updates: int | None = None
    """Gradient steps (apg)."""
    episodes: int | None = None
    """Test episodes (default: 50; 20 for mpc)."""
    video: bool = True
    """Whether to write balance.mp4."""
    out: str | None = None
    """Folder for the results (default: runs/vision-METHOD-nSAMPLES-seedN)."""
    overwrite: bool = False
    """Replace what the folder holds."""
    resume: bool = False
    """Continue the run in --out where it stopped (apg, ppo)."""
    threads: int = 1
    """Threads of torch."""


def main(options):
    """Train, fly, print, write."""
    samples = check(options)
    command.set_threads(options.threads)
    folder = Path(options.out or f"runs/vision-{options.method}-n{samples}-seed{options.seed}")
    obtain = _planned if options.method == "mpc" else _trained
    actor, task, dynamics, info = obtain(options, samples, folder)
    result, spent = _flown(options, actor, task, dynamics)
    metrics = {"system": task.system.name, "method": options.method, "target": " ".join(options.target) or "source"}
    metrics |= {"metric": task.metric, "unit": task.unit, **result.summary, **steps_survived(task, result), **spent}
    metrics |= {"camera": asdict(task.camera), **info, **command.environment(options.seed, options.threads)}
    rows = [metrics]
    if options.method == "mpc":
        rows += metrics.setdefault("attempts", list(_attempts(options, samples, task, dynamics)))
    command.write_json(folder / "metrics.json", metrics)
    print(table(rows))
    _show(options, actor, task, dynamics, result, folder)
    print(f"results in {folder}/")


def check(options):
    """Refuse what can be told without loading anything; returns the samples."""
    if options.method not in METHODS:
        raise InputError(f"--method {options.method}: expected one of {', '.join(METHODS)}")
    if options.episodes is not None and options.episodes < 1:
        raise InputError(f"--episodes {options.episodes}: expected at least 1")
    if options.samples is not None and options.samples < 1:
        raise InputError(f"--samples {options.samples}: expected at least 1")
    if options.resume and options.method == "mpc":
        raise InputError("--resume: mpc has nothing to continue; leave it out")
    if options.updates is not None and options.method != "apg":
        raise InputError(f"--updates: {options.method} has no such setting; leave it out")
    command.check_seed(options.seed)
    return METHODS[options.method] if options.samples is None else options.samples


def _trained(options, samples, folder):
    """Train, then read what was kept: (actor, task, dynamics, how it came about)."""
    from envs.domains import parse_target
    from envs.registry import make_dynamics
    from policies.checkpoints import load_policy

    names = ("seed", "target", "camera", "updates", "overwrite", "resume", "threads")
    common = {name: getattr(options, name) for name in names}
    method = f"{options.method}-pixels"
    pretrain.main(pretrain.Options("cartpole", method, samples=samples, out=str(folder), **common))
    policy = load_policy(folder / "policy.safetensors", method=method)
    dynamics = make_dynamics(policy.task.system, parse_target(options.target, policy.task.system))
    return (
        policy.actor(options.seed),
        policy.task,
        dynamics,
        {"samples": policy.info["samples"], "training": policy.info},
    )


def _planned(options, samples, folder):
    """Learn image dynamics: (planner, task, dynamics, how it came about)."""
    from envs.domains import parse_target
    from envs.registry import make_dynamics, make_task

    command.output_folder(folder, options.overwrite, RESULTS)
    domain = parse_target(options.target, make_task("cartpole").system)
    task = domain.seen(command.filmed(make_task("cartpole"), options.camera))
    dynamics = make_dynamics(task.system, domain)
    actor, config = _planner(options, samples, task, dynamics)
    return actor, task, dynamics, {"samples": samples, "training": asdict(config)}


def _planner(options, samples, task, dynamics, **settings):
    """A planner on pictures, and its settings."""
    from functools import partial

    from tqdm import tqdm

    from policies import pixel_mpc

    config = replace(pixel_mpc.Config(), samples=samples, **settings)
    progress = partial(tqdm, desc="learning image dynamics", leave=False)
    model = pixel_mpc.fit(dynamics, task, config, options.seed, progress)
    return pixel_mpc.actor(model, task, config, options.seed), config


def _attempts(options, samples, task, dynamics):
    """What comes of the plans that one would try first, as rows of the table."""
    for name, settings in ATTEMPTS.items():
        actor, _ = _planner(options, samples, task, dynamics, **settings)
        result, spent = _flown(options, actor, task, dynamics)
        yield {"method": name, "samples": samples, **result.summary, **steps_survived(task, result), **spent}


def _flown(options, actor, task, dynamics):
    """The test episodes, and the time of an action."""
    from functools import partial

    from tqdm import tqdm

    from policies.evaluate import action_time, evaluate, test_episodes

    episodes = test_episodes(task, options.episodes or EPISODES.get(options.method))
    result = evaluate(actor, dynamics, task, episodes, partial(tqdm, desc="flying", unit="step", leave=False))
    return result, action_time(actor, dynamics, task, calls=30 if options.method in EPISODES else 300)


def steps_survived(task, result):
    """Mean number of control periods until an episode ended."""
    diverged = task.diverged(result.episodes, None, result.states)
    flown = (~diverged).float().cumprod(1).sum(1) - 1
    return {"steps": float(flown.mean())}


def table(results):
    """What was reached, as text."""
    from tabulate import tabulate

    rows = []
    for one in results:
        good = f"{one['mean']:.4f} ± {one['std']:.4f}" if one["success"] else "none stayed up"
        row = (one["method"], one["samples"], good, f"{one['success']:.2f}", f"{one['steps']:.0f}", one["n"])
        rows.append((*row, f"{one['median_ms']:.2f}"))
    header = ("method", "samples", f"{results[0]['metric']} [{results[0]['unit']}]", "full episodes", "steps", "N")
    return "\n" + tabulate(rows, (*header, "ms per action"), "simple", disable_numparse=True) + "\n"


def _show(options, actor, task, dynamics, result, folder):
    from adapt import vision_pictures

    row = vision_pictures.typical(result)
    stacks = vision_pictures.stacks(task, dynamics, result.states[row])
    vision_pictures.draw_frames(task, stacks, folder / "frames.png")
    if options.method != "mpc":
        vision_pictures.draw_learning(folder / "log.csv", task, folder / "learning.png")
        vision_pictures.draw_saliency(actor, stacks, folder / "saliency.png")
    if options.video:
        vision_pictures.film(task, dynamics, result, row, stacks, folder / "balance.mp4")


if __name__ == "__main__":
    command.run("adapt.vision", Options, main)
