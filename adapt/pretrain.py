"""Train a policy by any method, or go on with one: `python -m adapt.pretrain --system quadrotor --seed 0`."""

import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command
from adapt.training_log import Log, score_of
from envs.errors import InputError
from policies import pick_method
from policies.files import whole

OUTPUTS = ("policy.safetensors", "log.csv", "training.pt")
SETTINGS = ("updates", "samples", "batch", "width", "learning_rate", "curriculum", "exploration")
UNNAMED = ("out", "overwrite", "resume", "device", "threads")  # options that don't change what is trained


@dataclass(frozen=True)
class Options:
    """Train a policy in the nominal robot, by analytic policy gradient unless --method says otherwise.

    Writes policy.safetensors (the best on validation), log.csv, config.json and training.pt (to resume from).
    Settings that are not given take the values tuned for the system. With --policy the training of a policy goes on in
    a changed robot (--target) or in a model with a residual (--residual), and what is written is the last policy: to
    choose the best would take flights in the target that --samples doesn't count.
    """

    system: str = "quadrotor"
    """Robot: cartpole, quadrotor or fixed_wing."""
    method: str = "apg"
    """apg, ppo or pets."""
    policy: str | None = None
    """Checkpoint to go on with (default: start anew)."""
    residual: str | None = None
    """Train in the nominal robot completed by this residual, as adapt.fewshot writes it."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name such as crazyflie, or a TOML file."""
    target: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Train in a changed robot, such as drag=0.3 or mass=x1.2; may be repeated."""
    set: str | None = None
    """Family of training episodes (quadrotor: paper, fast)."""
    seed: int = 0
    """Seed of everything that is drawn."""
    preset: str | None = None
    """Settings to start from: a system's tuned ones (default) or "paper"."""
    updates: int | None = None
    """Gradient steps (apg)."""
    samples: int | None = None
    """Transitions that may be taken from the robot (ppo, pets)."""
    batch: int | None = None
    """Episodes flown side by side."""
    width: int | None = None
    """Neurons of every layer."""
    learning_rate: float | None = None
    """First learning rate."""
    curriculum: float | None = None
    """Share of the updates after which the curriculum ends; 0 switches it off."""
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
    compile: bool = False
    """Compile the dynamics (needs a C++ compiler; pays off in long runs)."""
    device: str = "cpu"
    """Where to train: cpu, cuda."""
    threads: int = 1
    """Threads of torch; small batches run fastest on one."""


def main(options):
    """Train, validate and save until the last update."""

    from envs import make_task
    from policies.apg import training_banks

    check(options)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    system, _ = command.pick_robot(options.system, options.vehicle)
    config = configuration(options, system)
    task = make_task(system, options.set)
    dynamics = _dynamics(options, system)
    network = _network(options, system)
    task.episodes(1, "train", options.seed)  # what can't be flown is told before anything is written
    folder = _folder(options, system)
    identity = _identity(options, task, config)
    banks = training_banks(task, config, options.seed, device)
    method = pick_method(options.method).module
    run = method.begin(dynamics, task, banks, config, options.seed, network and network.to(device))
    report = {
        "options": asdict(options),
        "config": asdict(config),
        **command.environment(options.seed, options.threads),
    }
    if options.resume:
        _restore(run, folder, identity, banks, config, task)
    command.write_json(folder / "config.json", report)
    _train(run, dynamics, task, banks, config, options, folder, identity)


def check(options):
    """Refuse what can be told without loading anything."""
    pick_method(options.method, trained=True)
    command.check_seed(options.seed)
    if options.every is not None and options.every < 1:
        raise InputError(f"--every {options.every}: expected at least 1")
    if options.residual and options.target:
        raise InputError("--residual: the robot is the model with the residual then; leave --target out")
    if options.policy and options.width is not None:
        raise InputError("--width: is that of the policy that --policy names; leave it out")
    if options.compile and options.method != "apg":
        raise InputError(
            f"--compile: is for apg, which differentiates the dynamics; {options.method} has no use for it"
        )


def configuration(options, system):
    """The tuned settings of a system, or of `--preset`, with what the command line changes."""
    method = pick_method(options.method, trained=True).module
    name = options.preset or system.name
    if name not in method.PRESETS and options.preset:
        raise InputError(f"--preset {name}: expected one of {', '.join(method.PRESETS)}")
    config = method.PRESETS.get(name, method.Config())
    if options.policy:
        config = method.finetuning(config)
    changes = {key: getattr(options, key) for key in SETTINGS if getattr(options, key) is not None}
    known = {item.name for item in fields(config)}
    for key in changes.keys() - known:
        raise InputError(f"--{key.replace('_', '-')}: {options.method} has no such setting; leave it out")
    return replace(config, **changes)


def _dynamics(options, system):
    """What the policy is trained in."""
    from envs import make_dynamics

    if not options.residual:
        return make_dynamics(system, options.target)
    from adapt.residual_kinds import load_residual

    return load_residual(options.residual, make_dynamics(system)).requires_grad_(False)


def _network(options, system):
    """The network to go on with, or None."""
    if not options.policy:
        return None
    from policies.checkpoints import load_policy

    return load_policy(options.policy, system, options.method).network


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
    start = {name: getattr(options, name) for name in ("method", "policy", "residual")}
    return {**robot, **start, "set": task.set, "seed": options.seed, **asdict(config)}


def _restore(run, folder, identity, banks, config, task):
    """Continue from training.pt, which must be of the same run and whole."""
    import torch

    path = folder / "training.pt"
    damaged = InputError(f"--resume: {path} is damaged or not of this command; start again without --resume")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        then = saved["identity"]
        changed = [key for key, value in identity.items() if then[key] != value]
    except Exception:  # torch raises many kinds; weights_only refuses whatever is more than tensors
        raise damaged from None
    if changed:
        raise InputError(f"--resume: {folder} was trained with another {', '.join(changed)}; give the same")
    try:
        run.load_state_dict(saved, banks, config, task)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError):  # a part is missing or other
        raise damaged from None


def _train(run, dynamics, task, banks, config, options, folder, identity):
    from tqdm import tqdm

    method = pick_method(options.method).module
    every = options.every or getattr(config, "every", -(-config.updates // 10))
    log = Log(folder, until=run.update)
    best = log.best()
    begin = time.perf_counter() - log.seconds()
    flown = compiled(dynamics) if options.compile else dynamics
    bar = tqdm(total=config.updates, initial=run.update, desc=f"training {task.system.name}", unit="update")
    try:
        for metrics in _until_interrupted(run, method.train(run, flown, task, banks, config), folder, identity):
            bar.update()
            if run.update % every and run.update != config.updates:
                continue
            result = validate(method.actor(run.network, task), dynamics, task, getattr(config, "validations", 100))
            bar.set_postfix_str(f"validation {result['mean']:.4f} {task.unit}, success {result['success']:.2f}")
            row = {
                **metrics,
                "seconds": time.perf_counter() - begin,
                "error": result["mean"],
                "success": result["success"],
            }
            log.write(row)
            best = _keep_best(run, task, options, folder, row, best)
            _save_training(run, folder, identity)
            if options.stop_at is not None and result["mean"] <= options.stop_at and result["success"] == 1:
                break
    finally:
        bar.close()
        log.close()
    if run.skipped:
        print(f"{run.skipped} updates were skipped because their gradient was not finite")
    result = f"validation error {best[1]:.4f} {task.unit}, success {-best[0]:.2f}"
    print(f"{folder}/policy.safetensors: {result}, {time.perf_counter() - begin:.0f} s")


def _until_interrupted(run, updates, folder, identity):
    """The updates of a run; Ctrl-C waits for the present one, so that the run that is saved can go on exactly."""
    with command.interrupts_noted() as interrupted:
        for metrics in updates:
            yield metrics
            if interrupted():
                _save_training(run, folder, identity)
                raise KeyboardInterrupt(f"continue with the same options, --resume and --out {folder}")


def validate(actor, dynamics, task, n=100):
    """Summary of `n` validation episodes."""
    from policies.evaluate import evaluate, test_episodes

    device = next(actor.parameters()).device
    return evaluate(actor, dynamics, task, test_episodes(task, n, "validation").to(device)).summary


def compiled(dynamics):
    """The dynamics compiled by torch, or as they are where that fails."""
    import torch

    step = torch.compile(lambda state, action: dynamics(state, action))
    try:
        sizes = len(dynamics.system.State._fields), len(dynamics.system.Action._fields)
        step(torch.ones(2, sizes[0]), torch.zeros(2, sizes[1]))
    except Exception as error:  # any failure of the compiler ends here: eager is always right
        print(f"--compile: not possible here ({type(error).__name__}), going on without")
        return dynamics
    return step


def _keep_best(run, task, options, folder, row, best):
    """Save the policy if it succeeds more often than the best so far, or as often and more accurately.

    One whose training went on in a target is saved in any case: the best so far has no meaning for it.
    """
    from policies.checkpoints import save_policy

    score = score_of(row)
    if score >= best and not options.policy:
        return best
    info = {"validation": score[1], "success": row["success"], "unit": task.unit, "update": row["update"]}
    info |= {"seed": options.seed, "method": options.method, "samples": row["samples"], "command": said(options)}
    place = "model + residual" if options.residual else " ".join(options.target) or "source"
    info |= {"trained_in": place, "finetuned": options.policy is not None, "seconds": round(row["seconds"], 1)}
    save_policy(folder / "policy.safetensors", run.network, task, info, options.method)
    return score


def said(options):
    """The command that makes the same policy again."""
    words = ["python -m adapt.pretrain"]
    for item in fields(options):
        value = getattr(options, item.name)
        if (value != item.default or item.name in ("system", "seed")) and item.name not in UNNAMED:
            flag = f"--{item.name.replace('_', '-')}"
            values = value if isinstance(value, tuple) else (value,)
            words += [flag] if value is True else [f"{flag} {part}" for part in values]
    return " ".join(words)


def _save_training(run, folder, identity):
    import io

    import torch

    content = io.BytesIO()  # written by Python, whose errors name the file and the reason; torch's don't
    torch.save({**run.state_dict(), "identity": identity}, content)
    with whole(folder / "training.pt") as partial:
        partial.write_bytes(content.getvalue())


if __name__ == "__main__":
    command.run("adapt.pretrain", Options, main)
