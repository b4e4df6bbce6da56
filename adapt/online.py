"""Learn while flying: `python -m adapt.online --target mass=x1.2@20 --target wind=3@40 --seconds 60`.

One robot flies on and on in a target that changes in mid-flight. Every second or two a residual is refitted to the
newest flight and the policy fine-tuned in the corrected model, in another process, while the robot flies on; the policy
is swapped where the gate is sure that the new one is better.
"""

from concurrent.futures import BrokenExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError

OUTPUTS = ("config.json", "metrics.json", "flight.csv", "swaps.csv", "policy.safetensors", "online.png")
Repeatable = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


@dataclass(frozen=True)
class Options:
    """Fly continuously in a target that changes in mid-flight, and learn from the flight while it goes on.

    Time is simulated: a lesson that begins at t is over at t + LATENCY on any machine, so the same seed gives the same
    flight; how long lessons really took is told beside it. Writes metrics.json, config.json, flight.csv (time, state,
    action, error), swaps.csv (each lesson, and what the gate said), policy.safetensors (the last) and online.png.
    """

    system: str | None = None
    """Robot: cartpole, quadrotor or fixed_wing (default: what --vehicle is, else quadrotor)."""
    target: Repeatable = ()
    """What is different, and from when on: NAME=VALUE@SECONDS such as wind=3@40; without @ from the start. What has
    begun stays. May be repeated (default: mass=x1.2 after a third of the flight and wind=3 after two thirds)."""
    seconds: float = 60.0
    """Simulated length of the flight."""
    every: float = 0.5
    """Seconds between lessons; none begins before the last is over."""
    latency: float = 1.5
    """Simulated seconds that a lesson takes. It really takes 1 to 1.5 s of processor time for cartpole and quadrotor,
    2 s and more for fixed_wing; on a busy machine far longer."""
    window: float = 4.0
    """Seconds of the newest flight that is learned from; what is older than a change of the target is never used."""
    residual: str = "parameters"
    """Kind of residual: parameters, linear, features, network, linear+network, state, or auto, which takes several
    times as long where no parameter explains the data."""
    updates: int = 150
    """Gradient steps of each lesson."""
    exploration: float = 0.0
    """Standard deviation of noise on the flown actions, which span -1 to 1."""
    policy: str | None = None
    """Checkpoint to start from (default: the one that ships for the robot)."""
    set: str | None = None
    """Family of references (quadrotor: paper, fast, circle, lemniscate, line, hover, or a CSV of waypoints)."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name, crazyflie (a quadrotor) or j3cub (a fixed wing), or a TOML file."""
    seed: int = 0
    """Seed of everything that is drawn."""
    out: str | None = None
    """Folder for the results (default: runs/online-SYSTEM-TARGETS-SECONDSs-seedN)."""
    overwrite: bool = False
    """Replace what the folder holds."""


def main(options):
    """Check the options, fly and learn, fly without learning, print, write."""
    options = command.with_robot(options)
    _check(options)
    command.check_seed(options.seed)
    command.set_threads(1)
    policy, schedule, periods = _setting(options)
    settings, timing = _lessons(options, policy.task.system)
    folder = command.output_folder(options.out or _default_folder(options), options.overwrite, OUTPUTS)
    command.write_json(folder / "config.json", {"options": asdict(options), **command.environment(options.seed, 1)})

    from adapt.online_flight import ContinuousFlight
    from adapt.online_loop import KILLED

    begin = partial(ContinuousFlight, policy.task, periods=periods, exploration=options.exploration, seed=options.seed)
    with command.interrupts_noted() as interrupted:
        flight = begin(schedule)
        learner, failure = _fly(options, flight, policy, settings, timing, interrupted)
        complete = not failure and not interrupted()
        flights = {"adapted": flight} | (_compared(begin, schedule, policy, interrupted) if complete else {})
        _write(options, folder, flights, schedule, learner)
        flown = f"what was flown, {flight.time:.4g} s, is in {folder}"
        if failure and not isinstance(failure, BrokenExecutor):
            raise failure
        if interrupted():
            raise KeyboardInterrupt(flown)
        if failure:
            raise InputError(f"{KILLED}; {flown}")
    files = "metrics.json, flight.csv, swaps.csv, policy.safetensors, online.png"
    print(f"results in {folder}/: {files}")


def _check(options):
    if not 0 < options.seconds < float("inf"):
        raise InputError(f"--seconds {options.seconds:g}: expected more than 0")
    if not 0 <= options.exploration <= 1:
        raise InputError(f"--exploration {options.exploration:g}: expected between 0 and 1")


def _setting(options):
    """The policy on its task, the schedule of the target, and the length of the flight in control periods."""
    from dataclasses import replace

    from adapt.online_targets import default_items, parse_schedule

    system, vehicle = command.pick_robot(options.system, options.vehicle)
    policy = command.pick_policy(options.policy, system, vehicle)
    if options.set is not None:
        policy = replace(policy, task=replace(policy.task, set=options.set))
    periods = round(options.seconds / system.dt)
    if periods < 1:
        raise InputError(f"--seconds {options.seconds:g}: less than a control period, {system.dt:g} s")
    items = options.target or default_items(options.seconds)
    return policy, parse_schedule(items, options.seconds, policy.task), periods


def _lessons(options, system):
    """What a lesson may cost, and when lessons are given."""
    from adapt.online_learning import Settings
    from adapt.online_loop import Timing
    from adapt.residual import AUTO, KINDS

    if options.residual not in (AUTO, *KINDS):
        raise InputError(f"--residual {options.residual}: expected one of {', '.join((AUTO, *KINDS))}")
    settings = Settings(kind=options.residual, updates=options.updates, seed=options.seed)
    timing = Timing(options.every, options.latency, options.window)
    timing.check(system)
    return settings, timing


def _default_folder(options):
    from pathlib import Path

    robot = Path(options.vehicle).stem if options.vehicle else options.system
    text = command.file_name("-".join((robot, *options.target)), also="@")
    return f"runs/online-{text}-{options.seconds:g}s-seed{options.seed}"


def _fly(options, flight, policy, settings, timing, interrupted):
    """Fly and learn, with a bar of simulated seconds; the learner, and what ended the flight early or None."""
    from tqdm import tqdm

    from adapt import online_loop

    def told(lesson):
        seen = f"{lesson['due']:.4g} s: swapped; found {lesson['found']}; {lesson['reason']}"
        tqdm.write(f"{seen} (the lesson took {lesson['seconds']:.1f} s)")

    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s flown [{elapsed}<{remaining}]"
    with online_loop.background(policy, settings) as executor:
        learner = online_loop.Learner(policy, executor, settings, timing)
        period = policy.task.system.dt  # whole periods are counted, whose sum is never off
        with tqdm(total=flight.periods, unit_scale=period, desc="flying", bar_format=form) as bar:
            try:
                online_loop.fly(flight, policy, learner, interrupted, bar.update, told)
            except Exception as error:  # whatever a lesson ends in, what was flown is to be written
                return learner, error
    return learner, None


def _compared(begin, schedule, policy, interrupted):
    """The same flight without learning; if something changes in mid-flight, one in which nothing does, too."""
    from adapt.online_loop import fly
    from adapt.online_targets import Schedule

    flights = {"unadapted": begin(schedule)}
    if schedule.changes:
        flights["undisturbed"] = begin(Schedule(schedule.phases[:1]))
    for flight in flights.values():
        fly(flight, policy, stopped=interrupted)
    return {} if interrupted() else flights


def _write(options, folder, flights, schedule, learner):
    import pandas as pd

    from adapt import online_report
    from policies.checkpoints import save_policy
    from policies.files import whole

    tables = {name: flight.table() for name, flight in flights.items()}
    last, task = learner.policy, learner.policy.task
    for name, table in (("flight", tables["adapted"]), ("swaps", pd.DataFrame(learner.lessons))):
        with whole(folder / f"{name}.csv") as partial:
            table.to_csv(partial, index=False)
    save_policy(folder / "policy.safetensors", last.network, task, last.info, last.method)
    if not len(tables["adapted"]):
        return
    metrics = {
        "system": options.vehicle or task.system.name,
        "set": task.set,
        "target": [{"begins": phase.begins, "what": phase.text} for phase in schedule.phases],
        "seconds": flights["adapted"].time,
        "seed": options.seed,
        "trace": task.trace_name,
        "unit": task.trace_unit,
        "flights": {
            name: {"error": float(tables[name].error.mean()), "lost": flight.losses, "references": flight.legs}
            for name, flight in flights.items()
        },
        "changes": online_report.around(schedule, tables, task.system.dt),
        "learning": online_report.timing(learner.lessons, options.latency),
    }
    command.write_json(folder / "metrics.json", metrics)
    online_report.draw(tables, schedule, learner.lessons, task, folder / "online.png")
    print(online_report.text(metrics))


if __name__ == "__main__":
    command.run("adapt.online", Options, main)
