"""Train a policy in the nominal robot: `python -m adapt.pretrain --system quadrotor --seed 0`."""

import csv
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError
from policies.files import whole

OUTPUTS = ("policy.safetensors", "log.csv", "training.pt")
LOG = ("update", "seconds", "cost", "gradient_norm", "threshold", "stage", "resets", "skipped", "error", "success")


@dataclass(frozen=True)
class Options:
    """Train a policy by analytic policy gradient in the nominal robot.

    Writes policy.safetensors (the best on validation), log.csv, config.json and training.pt (to resume from).
    Settings that are not given take the values tuned for the system.
    """

    system: str = "quadrotor"
    """Robot: cartpole, quadrotor or fixed_wing."""
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
    """Gradient steps."""
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
    every: int = 500
    """Updates between validations."""
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

    from envs import make_dynamics, make_task
    from policies import apg

    command.check_seed(options.seed)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    if options.every < 1:
        raise InputError(f"--every {options.every}: expected at least 1")
    system, _ = command.pick_robot(options.system, options.vehicle)
    config = configuration(options, system)
    task = make_task(system, options.set)
    dynamics = make_dynamics(system, options.target)
    task.episodes(1, "train", options.seed)  # what can't be flown is told before anything is written
    folder = _folder(options, system)
    identity = _identity(options, task, config)
    banks = apg.training_banks(task, config, options.seed, device)
    run = apg.begin(dynamics, task, banks, config, options.seed)
    report = {
        "options": asdict(options),
        "config": asdict(config),
        **command.environment(options.seed, options.threads),
    }
    if options.resume:
        _restore(run, folder, identity, banks, config, task)
    command.write_json(folder / "config.json", report)
    _train(run, dynamics, task, banks, config, options, folder, identity)


def configuration(options, system):
    """The tuned settings of a system, or of `--preset`, with what the command line changes."""
    from policies import apg

    name = options.preset or system.name
    if name not in apg.PRESETS and options.preset:
        raise InputError(f"--preset {name}: expected one of {', '.join(apg.PRESETS)}")
    names = ("updates", "batch", "width", "learning_rate", "curriculum", "exploration")
    changes = {key: getattr(options, key) for key in names if getattr(options, key) is not None}
    return replace(apg.PRESETS.get(name, apg.APGConfig()), **changes)


def _folder(options, system):
    name = (options.vehicle and Path(options.vehicle).stem) or system.name
    path = Path(options.out or f"runs/pretrain-{name}-seed{options.seed}")
    if options.resume:
        if not (path / "training.pt").is_file():
            raise InputError(f"--resume: {path} holds no training.pt to continue from")
        return path
    return command.output_folder(path, options.overwrite, OUTPUTS)


def _identity(options, task, config):
    """What must not change where a run is continued."""
    robot = {"system": task.system.name, "vehicle": repr(task.system), "target": " ".join(options.target)}
    return {**robot, "set": task.set, "seed": options.seed, **asdict(config)}


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

    from policies import apg

    log = Log(folder, until=run.update)
    best = log.best()
    begin = time.perf_counter() - log.seconds()
    flown = compiled(dynamics) if options.compile else dynamics
    bar = tqdm(total=config.updates, initial=run.update, desc=f"training {task.system.name}", unit="update")
    try:
        for metrics in _until_interrupted(run, apg.train(run, flown, task, banks, config), folder, identity):
            bar.update()
            if run.update % options.every and run.update != config.updates:
                continue
            result = validate(run.network, dynamics, task)
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


def validate(network, dynamics, task, n=100):
    """Summary of `n` validation episodes."""
    from policies.evaluate import evaluate, test_episodes
    from policies.networks import as_actor

    device = next(network.parameters()).device
    return evaluate(as_actor(network), dynamics, task, test_episodes(task, n, "validation").to(device)).summary


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
    """Save the policy if it succeeds more often than the best so far, or as often and more accurately."""
    from policies.checkpoints import save_policy

    score = _score(row)
    if score >= best:
        return best
    info = {"validation": score[1], "success": row["success"], "unit": task.unit, "update": row["update"]}
    info |= {"seed": options.seed, "method": "apg", "seconds": round(row["seconds"], 1)}
    save_policy(folder / "policy.safetensors", run.network, task, info)
    return score


def _score(row):
    """(minus success, error) of a row: the smaller, the better. Without any success there is no error."""
    error = float(row["error"])
    return -float(row["success"]), error if error == error else float("inf")


def _save_training(run, folder, identity):
    import io

    import torch

    content = io.BytesIO()  # written by Python, whose errors name the file and the reason; torch's don't
    torch.save({**run.state_dict(), "identity": identity}, content)
    with whole(folder / "training.pt") as partial:
        partial.write_bytes(content.getvalue())


class Log:
    """log.csv, and TensorBoard where it is installed."""

    def __init__(self, folder, until):
        path = folder / "log.csv"
        rows = list(csv.DictReader(path.read_text().splitlines())) if path.is_file() else []
        self.rows = [row for row in rows if int(row["update"]) <= until]  # the rest will be done again
        self.path, self.board = path, _tensorboard(folder)

    def write(self, row):
        """Add a row; the file on disk is always whole."""
        self.rows.append({key: row[key] for key in LOG})
        with whole(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, LOG)
            writer.writeheader()
            writer.writerows(self.rows)
        for key in LOG[2:]:
            if self.board:
                self.board.add_scalar(key, row[key], row["update"])

    def best(self):
        """Best (minus success, error) so far."""
        return min((_score(row) for row in self.rows), default=(1.0, float("inf")))

    def seconds(self):
        """Time spent before this run was resumed."""
        return float(self.rows[-1]["seconds"]) if self.rows else 0.0

    def close(self):
        """Flush TensorBoard."""
        if self.board:
            self.board.close()


def _tensorboard(folder):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"))


if __name__ == "__main__":
    command.run("adapt.pretrain", Options, main)
