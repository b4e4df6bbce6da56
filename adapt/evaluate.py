"""Fly a controller of any method over the test episodes: `python -m adapt.evaluate --system quadrotor --method mpc`."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated

import tyro

from adapt import command, controllers
from adapt.setting import with_plant
from envs.errors import InputError
from policies import METHODS, pick_method


@dataclass(frozen=True)
class Options:
    """Evaluate a controller in closed loop over test episodes: metric, success, time per action and failures."""

    system: str | None = None
    """Robot: cartpole, quadrotor or fixed_wing (default: what --vehicle or --plant is, else quadrotor)."""
    method: str = "apg"
    """apg, ppo or pets (trained; from pictures: apg-pixels, ppo-pixels), or a planner: mpc in the nominal model,
    mpc-residual in that completed by a residual learned in the target, mpc-target in the true target."""
    policy: str | None = None
    """Checkpoint of a trained method (default: the one that ships for the robot)."""
    target: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What is different, such as drag=0.3 or mass=x1.2, or noise=1 for sensors that err: 1 mm, 0.02 m/s, 0.5 deg, 0.05
    rad/s, times 1; may be repeated (default: nothing, the source)."""
    plant: str | None = None
    """Simulator or hardware to fly in instead: rotorpy, drone-models, jsbsim, mujoco (extra `simulators`), or
    MODULE:FACTORY of your own, see adapt/plants.py. Times per action are those of flights in the model."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name, crazyflie (a quadrotor) or j3cub (a fixed wing), or a TOML file."""
    set: str | None = None
    """Family of episodes (quadrotor: paper, fast, circle, lemniscate, line, hover, or a CSV of waypoints)."""
    split: str = "test"
    """Split that the episodes are drawn from: test, validation or train."""
    episodes: int | None = None
    """Number of episodes (default: 50; fixed_wing: 30)."""
    seed: int = 0
    """Seed of the episodes, and of whatever else is drawn."""
    residual: str | None = None
    """Residual of mpc-residual, as adapt.fewshot writes it (default: fit one)."""
    samples: int | None = None
    """Transitions that mpc-residual fits its residual to (default: 1000)."""
    solver: str | None = None
    """Solver of a planner: fatrop (default), rti (one Gauss-Newton iteration) or ipopt."""
    compile: bool = False
    """Compile the solver of a planner to machine code (needs a C compiler; kept for the next time)."""
    horizon: int | None = None
    """Control periods that a planner looks ahead (default: those of the task)."""
    episodes_horizon: int | None = None
    """Horizon that the episodes are drawn for, as random paths differ with it (default: that of the controller). Give
    the longest to fly controllers of several horizons on the same paths."""
    gradient: bool = False
    """Also measure norm and variance of the analytic policy gradient over validation episodes (apg)."""
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
    from adapt.report import broken_flights
    from envs.registry import make_dynamics
    from policies.evaluate import action_time, evaluate, test_episodes

    options = with_plant(options)
    out = check(options)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    system, vehicle = command.pick_robot(options.system, options.vehicle)
    domain, dynamics = _target(options, system)
    controller = controllers.obtain(options, system, vehicle, dynamics, device)
    task, actor = domain.seen(controller.task), controller.actor
    drawn = replace(task, horizon=_episodes_horizon(options, task))
    episodes = test_episodes(drawn, options.episodes, options.split, options.seed).to(device)
    result = evaluate(actor, dynamics, task, episodes, _progress(options))
    counts = {name: getattr(actor, name) for name in ("calls", "failures") if hasattr(actor, name)}
    spent = action_time(actor.to("cpu"), make_dynamics(system) if options.plant else dynamics, task)
    gradient = _gradient(controller.network, dynamics, task) if options.gradient else {}
    plant = {"plant": dynamics.report()} if options.plant else {}
    flown = f"{options.system} {task.set} {options.plant or ' '.join(options.target) or 'source'}"
    print(f"{flown}, {options.method}: {task.metric} {result}")
    print(f"time per action: median {spent['median_ms']:.3f} ms, 99th percentile {spent['p99_ms']:.3f} ms, one thread")
    if counts:
        print(f"failed plans: {counts['failures']} of {counts['calls']}, each replaced by the one before")
    for line in broken_flights(plant.get("plant")):
        print(line)
    if gradient:
        print(f"gradient: norm {gradient['gradient_norm']:.3g}, variance {gradient['gradient_variance']:.3g}")
    if out:
        content = {"options": asdict(options), "method": options.method, "set": task.set, "horizon": task.horizon}
        content |= {"metric": task.metric, "unit": task.unit, **result.summary, **spent, **counts, **gradient, **plant}
        content |= {"policy_info": controller.info, "table": result.table.to_dict("list")}
        command.write_json(out, content | command.environment(options.seed, options.threads))
        print(f"results in {out}")


def check(options):
    """Refuse what can be told without loading anything; returns the file for the results."""
    from envs.references import SPLITS

    controllers.check(options)
    if options.split not in SPLITS:
        raise InputError(f"--split {options.split}: expected one of {', '.join(SPLITS)}")
    if options.episodes is not None and options.episodes < 1:
        raise InputError(f"--episodes {options.episodes}: expected at least 1")
    if options.gradient and options.method != "apg":
        raise InputError(f"--gradient: is that of apg, {options.method} has none; leave it out")
    if options.plant:
        _check_plant(options)
    command.check_seed(options.seed)
    return command.output_file("--out", options.out, options.overwrite, "metrics.json")


def _check_plant(options):
    method = METHODS[options.method]
    reasons = {
        "--target": (options.target, "a plant is a target"),
        "--gradient": (options.gradient, "a plant has no equations to differentiate"),
        f"--method {options.method}": (
            method.model == "target" or method.pixels,
            "a plant gives neither equations nor pictures",
        ),
    }
    for name, (given, reason) in reasons.items():
        if given:
            raise InputError(f"--plant and {name}: {reason}; leave one out")


def _target(options, system):
    """How what is flown in differs, and its dynamics."""
    from envs.domains import Domain, parse_target
    from envs.registry import make_dynamics

    if options.plant:
        from adapt.plants import make_flights

        return Domain(), make_flights(options.plant, system)
    domain = parse_target(options.target, system)
    return domain, make_dynamics(system, domain)


def _episodes_horizon(options, task):
    """The horizon to draw episodes for, at least that of the controller: its references must not end before it does."""
    horizon = task.horizon if options.episodes_horizon is None else options.episodes_horizon
    if horizon < task.horizon:
        raise InputError(
            f"--episodes-horizon {horizon}: expected at least {task.horizon}, the horizon of the controller"
        )
    return horizon


def _gradient(network, dynamics, task):
    from policies.gradients import gradient_statistics

    found = gradient_statistics(network.to("cpu"), dynamics, task, task.episodes(200, "validation", 0))
    return {f"gradient_{name}": value for name, value in found.items()}


def _progress(options):
    """A bar, where it takes minutes: over the flights of a plant, the steps of methods that plan online."""
    if not (options.plant or pick_method(options.method).plans):
        return None
    from functools import partial

    from tqdm import tqdm

    return partial(tqdm, desc="flying", unit="flight" if options.plant else "step", leave=False)


if __name__ == "__main__":
    command.run("adapt.evaluate", Options, main)
