"""A training run on disk: validate, log, save so that it can be continued, stop where asked. Any trained method."""

import io
import time
from dataclasses import dataclass
from pathlib import Path

from adapt import command
from adapt.training_log import Log, score_of
from envs.errors import InputError
from policies import pick_method
from policies.files import whole


@dataclass(frozen=True)
class Job:
    """What is trained and what of it is kept.

    `identity` is what must not change where a run is continued, `info` goes into the checkpoint. With `keep_best` the
    policy that is kept is the best on validation, else the last: to choose would take flights that `--samples` doesn't
    count.
    """

    method: str
    task: object
    dynamics: object
    banks: list
    config: object
    folder: Path
    identity: dict
    info: dict
    keep_best: bool
    every: int
    stop_at: float | None = None
    compiled: object | None = None  # the same dynamics, quicker, to train in

    @property
    def trained_in(self):
        """The dynamics that the method trains in."""
        return self.compiled or self.dynamics


def train(run, job):
    """Train to the last update, or until the error is low enough."""
    from tqdm import tqdm

    task, config = job.task, job.config
    method = pick_method(job.method).module
    log = Log(job.folder, until=run.update)
    best = log.best()
    begin = time.perf_counter() - log.seconds()
    bar = tqdm(total=config.updates, initial=run.update, desc=f"training {task.system.name}", unit="update")
    try:
        for metrics in _until_interrupted(run, method.train(run, job.trained_in, task, job.banks, config), job):
            bar.update()
            if run.update % job.every and run.update != config.updates:
                continue
            actor = method.actor(run.network, task)
            result = validate(actor, job.dynamics, task, getattr(config, "validations", 100))
            bar.set_postfix_str(f"validation {result['mean']:.4f} {task.unit}, success {result['success']:.2f}")
            spent = time.perf_counter() - begin
            row = {**metrics, "seconds": spent, "error": result["mean"], "success": result["success"]}
            log.write(row)
            best = _keep(run, job, row, best)
            _save(run, job)
            if job.stop_at is not None and result["mean"] <= job.stop_at and result["success"] == 1:
                break
    finally:
        bar.close()
        log.close()
    if run.skipped:
        print(f"{run.skipped} updates were skipped because their gradient was not finite")
    result = f"validation error {best[1]:.4f} {task.unit}, success {-best[0]:.2f}"
    print(f"{job.folder}/policy.safetensors: {result}, {time.perf_counter() - begin:.0f} s")


def _until_interrupted(run, updates, job):
    """The updates of a run; Ctrl-C waits for the present one, so that the run that is saved can go on exactly."""
    with command.interrupts_noted() as interrupted:
        for metrics in updates:
            yield metrics
            if interrupted():
                _save(run, job)
                raise KeyboardInterrupt(f"continue with the same options, --resume and --out {job.folder}")


def validate(actor, dynamics, task, n=100):
    """Summary of `n` validation episodes."""
    from policies.evaluate import evaluate, test_episodes

    device = next(actor.parameters()).device
    return evaluate(actor, dynamics, task, test_episodes(task, n, "validation").to(device)).summary


def _keep(run, job, row, best):
    """Save the policy, if only the best counts then only one that succeeds more often, or as often and more accurately.

    Returns the score of what is kept.
    """
    from policies.checkpoints import save_policy

    score = score_of(row)
    if score >= best and job.keep_best:
        return best
    info = {"validation": score[1], "success": row["success"], "unit": job.task.unit, "update": row["update"]}
    info |= {"samples": row["samples"], "seconds": round(row["seconds"], 1), **job.info}
    save_policy(job.folder / "policy.safetensors", run.network, job.task, info, job.method)
    return score


def _save(run, job):
    import torch

    content = io.BytesIO()  # written by Python, whose errors name the file and the reason; torch's don't
    torch.save({**run.state_dict(), "identity": job.identity}, content)
    with whole(job.folder / "training.pt") as partial:
        partial.write_bytes(content.getvalue())


def restore(run, job):
    """Continue from training.pt, which must be of the same run and whole.

    Raises:
        InputError: when it isn't.
    """
    import torch

    path = job.folder / "training.pt"
    damaged = InputError(f"--resume: {path} is damaged or not of this command; start again without --resume")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        then = saved["identity"]
        changed = [key for key, value in job.identity.items() if then[key] != value]
    except Exception:  # torch raises many kinds; weights_only refuses whatever is more than tensors
        raise damaged from None
    if changed:
        raise InputError(f"--resume: {job.folder} was trained with another {', '.join(changed)}; give the same")
    try:
        run.load_state_dict(saved, job.banks, job.config, job.task)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError):  # a part is missing or other
        raise damaged from None
