"""What the options of `adapt.fewshot` name: the robot, the target, the policy, recorded transitions."""

from dataclasses import dataclass, replace
from pathlib import Path

from adapt import command
from adapt.plant_table import SIMULATORS

DEFAULT_TARGET = ("drag=0.3",)


@dataclass(frozen=True)
class Setting:
    """The robot as modelled and, unless only logs tell of it, the target: how it differs, and its dynamics."""

    system: object
    vehicle: object | None
    domain: object | None = None
    target: object | None = None
    plant: object | None = None


def with_plant(options):
    """The options with the robot that a simulator is of, unless they name another one, and see `with_robot`."""
    if options.plant in SIMULATORS and options.vehicle is None:
        simulator = SIMULATORS[options.plant]
        own = options.system in (None, simulator.system)
        options = replace(
            options, system=options.system or simulator.system, vehicle=simulator.vehicle if own else None
        )
    return command.with_robot(options)


def pick_setting(options):
    """The `Setting` that options name.

    Raises:
        InputError: a robot, target or plant that is unknown or can't be made.
    """
    from envs.domains import parse_target
    from envs.registry import make_dynamics

    system, vehicle = command.pick_robot(options.system, options.vehicle)
    if options.plant:
        from adapt.plants import make_flights

        return Setting(system, vehicle, plant=make_flights(options.plant, system))
    if recorded_only(options):
        return Setting(system, vehicle)
    domain = parse_target(options.target or DEFAULT_TARGET, system)
    return Setting(system, vehicle, domain, make_dynamics(system, domain))


def starting_policy(options, setting):
    """The policy to begin with, on the task that the options name."""
    method = "apg-pixels" if options.pixels else "apg"
    policy = command.pick_policy(options.policy, setting.system, setting.vehicle, method)
    if options.set is not None:
        policy = replace(policy, task=replace(policy.task, set=options.set))
    if setting.domain is not None:
        setting.domain.seen(policy.task)  # a changed picture means nothing to a policy that sees the state
    policy.task.episodes(1, "train", 0)  # waypoints that can't be read or flown are told before anything is written
    return policy


def transitions_of(options, setting):
    """Transitions to learn from and to validate on, where the options name some."""
    if options.transitions:
        from adapt.residual import MINIMUM
        from adapt.transitions import Transitions

        return Transitions.load(options.transitions, setting.system, MINIMUM), None
    if not options.log:
        return None, None
    recorded, validation = (_flights(paths, options, setting) for paths in (options.log, options.validate))
    if validation is not None:
        from adapt.prediction import prediction_report
        from envs.dynamics import Dynamics

        prediction_report(Dynamics(setting.system), validation)  # flights that are too short are told before the work
    return recorded, validation


def _flights(paths, options, setting):
    from adapt.logs import flight_transitions, read_flight

    if not paths:
        return None
    logs = [read_flight(path, setting.vehicle, options.mapping) for path in paths]
    for log in logs:
        print(log.report)
    return flight_transitions(logs)


def default_folder(options):
    """Where results go unless `--out` says so."""
    robot = Path(options.vehicle).stem if options.vehicle else options.system
    text = "-".join((robot, *(["pixels"] if options.pixels else []), *target_text(options).split()))
    if not recorded_only(options):
        text += f"-{Path(options.transitions).stem}" if options.transitions else f"-n{options.samples}"
    return f"runs/fewshot-{command.file_name(text)}-seed{options.seed}"


def recorded_only(options):
    """Whether the target is known by its recorded transitions alone, so that nothing can be flown in it."""
    return bool(options.log or (options.transitions and not options.target and not options.plant))


def target_text(options):
    """The target in words."""
    if options.plant:
        return options.plant
    if recorded_only(options):
        first, *more = options.log or (options.transitions,)
        return Path(first).name + (f" and {len(more)} more" if more else "")
    return " ".join(options.target or DEFAULT_TARGET)
