"""The table of robots, and how to make dynamics, tasks and environments of them by name."""

from dataclasses import fields

from envs.cartpole import Balance, CartPole
from envs.domains import Domain, parse_target
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.fixed_wing import FixedWing, Waypoint
from envs.quadrotor import Quadrotor, Tracking

SYSTEMS = {"cartpole": (CartPole, Balance), "quadrotor": (Quadrotor, Tracking), "fixed_wing": (FixedWing, Waypoint)}


def make_system(system):
    """A system by name with its default parameters; an instance is passed through.

    Raises:
        InputError: when the name is unknown.
    """
    if not isinstance(system, str):
        return system
    if system not in SYSTEMS:
        raise InputError(f"--system {system}: expected one of {', '.join(SYSTEMS)}")
    return SYSTEMS[system][0]()


def make_dynamics(system, target="", integrator="rk4", substeps=1):
    """Dynamics of a system (name or instance) in a target domain (`Domain`, or text such as "drag=0.3 mass=x1.2")."""
    system = make_system(system)
    domain = target if isinstance(target, Domain) else parse_target(target, system)
    return Dynamics(domain.apply(system), domain.forces(), integrator, substeps, domain.deviations(system))


def make_task(system, set=None, **options):
    """The task of a system (name or instance); `set` names the family of episodes."""
    system = make_system(system)
    task = SYSTEMS[system.name][1]
    known = {field.name for field in fields(task)}
    if unknown := options.keys() - known:
        raise InputError(f"task of {system.name}: no option {', '.join(sorted(unknown))}; expected some of {known}")
    return task(system=system, set=set or task.sets[0], **options)


def make_env(system, target="", task=None, batch_size=(), device="cpu", seed=0, split="train", episodes=1000):
    """A TorchRL environment of a system in a target domain, with `pixels` where the task has a camera.

    Args:
        system: name or instance.
        target: `Domain` or text; empty is the source.
        task: a `Task`, the name of a set of episodes, or None for the default.
        split: the split that the `episodes` are drawn from; with `seed` it fixes them.
    """
    from envs.pixels import tracking_env

    system = make_system(system)
    if task is None or isinstance(task, str):
        task = make_task(system, task)
    domain = target if isinstance(target, Domain) else parse_target(target, system)
    task = domain.seen(task)
    dynamics = make_dynamics(system, domain)
    return tracking_env(dynamics, task, task.episodes(episodes, split, seed), batch_size, device, seed)
