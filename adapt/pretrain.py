"""Train a policy by any method, or go on with one: `python -m adapt.pretrain --system quadrotor --seed 0`."""

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command, training
from envs.errors import InputError
from policies import pick_method

OUTPUTS = ("policy.safetensors", "log.csv", "training.pt")
SETTINGS = ("mode", "updates", "samples", "batch", "width", "learning_rate", "curriculum", "ramps", "exploration")
UNNAMED = ("out", "overwrite", "resume", "device", "threads")  # options that don't change what is trained


@dataclass(frozen=True)
class Options:
    """Train a policy in the nominal robot, by analytic policy gradient unless --method says otherwise.

    Writes policy.safetensors (the best on validation), log.csv, config.json and training.pt (to resume from).
    Settings that are not given take the values tuned for the system. With --policy the training of a policy goes on in
    a changed robot (--target) or in a model with a residual (--residual). What is written then, and where the policy
    sees pictures, is the last policy: to choose the best would take flights that --samples doesn't count.
    """

    system: str | None = None
    """Robot: cartpole, quadrotor or fixed_wing (default: what --vehicle is, else quadrotor)."""
    method: str = "apg"
    """apg, ppo or pets; from pictures: apg-pixels or ppo-pixels."""
    policy: str | None = None
    """Checkpoint to go on with (default: start anew)."""
    residual: str | None = None
    """Train in the nominal robot completed by this residual, as adapt.fewshot writes it."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name, crazyflie (a quadrotor) or j3cub (a fixed wing), or a TOML file."""
    target: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Train in a changed robot, such as drag=0.3 or mass=x1.2; may be repeated. With noise=1, sensors that err by 1 mm,
    0.02 m/s, 0.5 deg, 0.05 rad/s, times 1, ppo and pets learn from what was measured; apg from exact states, and only
    its validation flights are noisy."""
    camera: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Setting of the camera that a policy from pictures sees through, such as height=64; may be repeated."""
    set: str | None = None
    """Family of training episodes (quadrotor: paper, fast)."""
    horizon: int | None = None
    """Control periods ahead that a policy sees of the reference, plans or is trained on (default: 10)."""
    mode: str | None = None
    """How actions follow one another in training (apg): concurrent (default), autoregressive or recurrent (LSTM)."""
    seed: int = 0
    """Seed of everything that is drawn."""
    preset: str | None = None
    """Settings to start from: a system's tuned ones (default) or "paper"."""
    updates: int | None = None
    """Gradient steps (apg)."""
    samples: int | None = None
    """Transitions that may be taken from the robot (ppo, pets, apg-pixels)."""
    batch: int | None = None
    """Episodes flown side by side."""
    width: int | None = None
    """Neurons of every layer."""
    learning_rate: float | None = None
    """First learning rate."""
    curriculum: float | None = None
    """Share of the updates after which the curriculum ends; 0 switches it off."""
    ramps: str | None = None
    """What the curriculum raises (apg): both (default), or the threshold of divergence or the speed alone."""
    exploration: float | None = None
    """Standard deviation of noise on the flown actions."""
    every: int | None = None
    """Updates between validations (apg: 500, others: a tenth of the run)."""
    stop_at: float | None = None
    """Stop as soon as the validation error is below this, all episodes succeeding."""
    out: str | None = None
    """Folder for the results (default: runs/pretrain-SYSTEM-seedN)."""
    overwrite: bool = False
    """Replace what the folder holds."""
    resume: bool = False
    """Continue the run in --out where it stopped."""
    eager: bool = False
    """Differentiate the dynamics by torch (apg) even where a C compiler could make them ten times faster."""
    device: str = "cpu"
    """Where to train: cpu, cuda."""
    threads: int = 1
    """Threads of torch; small batches run fastest on one."""


def main(options):
    """Train, validate and save until the last update."""

    from policies.apg import training_banks

    options = command.with_robot(options)
    check(options)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    system, _ = command.pick_robot(options.system, options.vehicle)
    config = configuration(options, system)
    policy = _policy(options, system)
    config = _as_policy(config, policy)
    task, dynamics = _setting(options, system, policy)
    task.episodes(1, "train", options.seed)  # what can't be flown is told before anything is written
    if options.method == "apg" and getattr(dynamics, "noise", ()):
        print("trains on exact states: sensors err in the validation flights alone")
    folder = _folder(options, system)
    banks = training_banks(task, config, options.seed, device)
    job = training.Job(
        options.method,
        task,
        dynamics,
        banks,
        config,
        folder,
        _identity(options, task, config),
        _info(options),
        keep_best=not (options.policy or pick_method(options.method).pixels),
        every=options.every or getattr(config, "every", -(-config.updates // 10)),
        stop_at=options.stop_at,
        compiled=_compiled(options, dynamics, device),
    )
    network = policy and policy.network.to(device)
    run = pick_method(options.method).module.begin(job.trained_in, task, banks, config, options.seed, network)
    if options.resume:
        training.restore(run, job)
    said = {"options": asdict(options), "config": asdict(config)}
    command.write_json(folder / "config.json", said | command.environment(options.seed, options.threads))
    training.train(run, job)


def check(options):
    """Refuse what can be told without loading anything."""
    pick_method(options.method, trained=True)
    command.check_seed(options.seed)
    if options.every is not None and options.every < 1:
        raise InputError(f"--every {options.every}: expected at least 1")
    if options.residual and options.target:
        raise InputError("--residual: the robot is the model with the residual then; leave --target out")
    if options.horizon is not None and options.horizon < 1:
        raise InputError(f"--horizon {options.horizon}: expected at least 1")
    for name in ("width", "mode", "horizon"):
        if options.policy and getattr(options, name) is not None:
            raise InputError(f"--{name}: is that of the policy that --policy names; leave it out")
    if options.camera and (options.policy or not pick_method(options.method).pixels):
        reason = "the policy brings its own" if options.policy else f"{options.method} sees the state"
        raise InputError(f"--camera: {reason}; leave it out")


def configuration(options, system):
    """The tuned settings of a system, or of `--preset`, with what the command line changes."""
    method = pick_method(options.method, trained=True).module
    name = options.preset or system.name
    if name not in method.PRESETS and options.preset:
        raise InputError(f"--preset {name}: expected one of {', '.join(method.PRESETS)}")
    config = method.PRESETS.get(name, method.Config())
    if options.policy:
        config = method.finetuning(config, system)
    changes = {key: getattr(options, key) for key in SETTINGS if getattr(options, key) is not None}
    known = {item.name for item in fields(config)}
    for key in changes.keys() - known:
        raise InputError(f"--{key.replace('_', '-')}: {options.method} has no such setting; leave it out")
    return replace(config, **changes)


def _policy(options, system):
    """The policy to go on with, or None."""
    if not options.policy:
        return None
    from policies.checkpoints import load_policy

    return load_policy(options.policy, system, options.method)


def _as_policy(config, policy):
    """The settings with the mode of the policy to go on with, so that what is written tells what was done."""
    mode = policy and getattr(policy.network.config, "mode", None)
    return replace(config, mode=mode) if mode else config


def _setting(options, system, policy):
    """What is asked of the robot, and what the policy is trained in."""
    from envs import make_dynamics, make_task, parse_target

    domain = parse_target(options.target, system)
    horizon = policy.task.horizon if policy else options.horizon
    task = make_task(system, options.set, **({} if horizon is None else {"horizon": horizon}))
    if pick_method(options.method).pixels:
        task = replace(task, camera=policy.task.camera) if policy else command.filmed(task, options.camera)
    task = domain.seen(task)
    if not options.residual:
        return task, make_dynamics(system, domain)
    from adapt.residual_kinds import load_residual

    return task, load_residual(options.residual, make_dynamics(system)).requires_grad_(False)


def _compiled(options, dynamics, device):
    """The dynamics in machine code, where that is of use and possible."""
    if options.eager or not (options.method.startswith("apg") and device.type == "cpu"):
        return None
    from policies.compiled_dynamics import fastest

    quick, reason = fastest(dynamics)
    if reason:
        print(f"trains without compiled dynamics, some ten times slower: {reason}")
    return None if reason else quick


def _folder(options, system):
    name = (options.vehicle and Path(options.vehicle).stem) or system.name
    name = name if options.method == "apg" else f"{options.method}-{name}"
    kind = "finetune" if options.policy else "pretrain"
    path = Path(options.out or f"runs/{kind}-{name}-seed{options.seed}")
    if options.resume:
        if not (path / "training.pt").is_file():
            raise InputError(f"--resume: {path} holds no training.pt to continue from")
        return path
    return command.output_folder(path, options.overwrite, OUTPUTS)


def _identity(options, task, config):
    """What must not change where a run is continued."""
    robot = {"system": task.system.name, "vehicle": repr(task.system), "target": " ".join(options.target)}
    robot |= {"camera": repr(task.camera)} if task.camera else {}
    start = {name: getattr(options, name) for name in ("method", "policy", "residual")}
    return {**robot, **start, "set": task.set, "horizon": task.horizon, "seed": options.seed, **asdict(config)}


def _info(options):
    """How a policy comes about, for its checkpoint."""
    place = "model + residual" if options.residual else " ".join(options.target) or "source"
    how = {"seed": options.seed, "method": options.method, "command": said(options)}
    return {**how, "trained_in": place, "finetuned": options.policy is not None}


def said(options):
    """The command that makes the same policy again."""
    words = ["python -m adapt.pretrain"]
    for item in fields(options):
        value = getattr(options, item.name)
        if (value != item.default or item.name in ("system", "seed")) and item.name not in UNNAMED:
            words += command.flags(item.name, value)
    return " ".join(words)


if __name__ == "__main__":
    command.run("adapt.pretrain", Options, main)
