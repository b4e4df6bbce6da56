"""Obtain a controller by the name of its method: load a trained one, or make a planner and the model it plans in."""

from dataclasses import dataclass, field, replace

from adapt import command
from envs.errors import InputError
from policies import METHODS, pick_method

SOLVER = "fatrop"  # that a planner uses unless another is asked for
SAMPLES = 1000  # transitions that the residual of a planner is fitted to unless another number is asked for


@dataclass(frozen=True)
class Controller:
    """A TensorDict policy that writes `action`, its task, how it came about, and the network of a trained one."""

    actor: object
    task: object
    info: dict = field(default_factory=dict)
    network: object | None = None


def check(options):
    """Refuse options that the method has no use for: silently ignored, they would make a result look like another.

    Raises:
        InputError: names the option.
    """
    method = pick_method(options.method)
    plans = METHODS[options.method].home == METHODS["mpc"].home
    unused = {
        "policy": not method.trained,
        "solver": not plans,
        "compile": not plans,
        "horizon": not plans,
        "residual": method.model != "residual",
        "samples": method.model != "residual",
    }
    for name, is_unused in unused.items():
        if is_unused and getattr(options, name) not in (None, False):
            users = [key for key, one in METHODS.items() if one.trained] if name == "policy" else _planners(name)
            raise InputError(f"--{name}: --method {options.method} has no use for it, only {', '.join(users)}")
    if options.samples is not None and options.residual is not None:
        raise InputError("--samples: the residual is given by --residual; leave one out")
    if options.samples is not None and options.samples < 1:
        raise InputError(f"--samples {options.samples}: expected at least 1")
    if not method.trained and options.device != "cpu":
        raise InputError(f"--device {options.device}: --method {options.method} solves on the cpu; leave it out")


def _planners(option):
    """The planners that an option is for."""
    planners = [name for name, method in METHODS.items() if not method.trained]
    return [
        name for name in planners if option in ("solver", "compile", "horizon") or METHODS[name].model == "residual"
    ]


def obtain(options, system, vehicle, target, device="cpu"):
    """The controller that the options of a command name.

    Args:
        options: with `method`, `policy`, `set`, `seed`, `solver`, `compile`, `horizon`, `residual`, `samples`.
        system: the nominal robot; `vehicle` is its description, or None.
        target: dynamics that it will fly in.

    Raises:
        InputError: what can't be loaded, doesn't fit the robot, or isn't to be had on this machine.
    """
    from envs.registry import make_task

    method = pick_method(options.method)
    if method.trained:
        policy = command.pick_policy(options.policy, system, vehicle, options.method)
        policy.network.to(device)
        task = replace(policy.task, set=options.set) if options.set else policy.task
        return Controller(policy.actor(options.seed), task, policy.info, policy.network)
    task = make_task(system, options.set, **({"horizon": options.horizon} if options.horizon is not None else {}))
    model, info = _model(method.model, options, system, vehicle, target)
    settings = {"compile": options.compile, "solver": options.solver or SOLVER}
    return Controller(method.module.actor(model, task, **settings), task, {"model": method.model, **settings, **info})


def _model(kind, options, system, vehicle, target):
    """The dynamics to plan in, and how they came about."""
    from envs.registry import make_dynamics

    if kind == "source":
        return make_dynamics(system), {}
    if kind == "target":
        return target, {}
    if options.residual is not None:
        from adapt.residual_kinds import load_residual

        return load_residual(options.residual, make_dynamics(system)), {"residual": options.residual}
    from adapt.adaptation import learn

    samples = options.samples or SAMPLES
    try:
        policy = command.pick_policy(None, system, vehicle)
    except InputError:
        advice = "give a residual.safetensors of adapt.fewshot by --residual"
        raise InputError(f"--method {options.method}: no policy ships that could fly for data; {advice}") from None
    _, residual, fit = learn(policy, target, samples, seed=options.seed)
    return residual, {"samples": samples, "fit": {"before": fit.before, "after": fit.after}}
