"""One lesson of a policy that learns while it flies: fit to the newest flight, fine-tune, ask the gate.

A lesson is a function of its `Job` alone, so that it may run in another process.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch.optim.swa_utils import AveragedModel

from adapt.bootstrap import fit_ensemble
from adapt.finetuning import finetuning
from adapt.gate import Gate, Verdict
from adapt.online_window import likelihood
from adapt.residual import fit_residual
from adapt.residual_dynamics import ResidualDynamics
from adapt.sensor_noise import sensor_noise
from adapt.transitions import Transitions
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.system import Task
from policies import METHODS
from policies.checkpoints import Policy
from policies.compiled_dynamics import fastest

BETTER = 5.0  # [-] logarithm of the likelihood ratio that a new fit must have over the present one


@dataclass(frozen=True)
class Settings:
    """How much a lesson may cost."""

    kind: str = "parameters"  # of the residual
    updates: int = 150  # of the fine-tuning
    batch: int = 64  # episodes flown side by side in it
    learning_rate: float = 1e-3
    final_rate: float = 1.0  # [-] last learning rate as a share of the first: weights are averaged instead
    averaged: float = 0.5  # [-] last share of the updates whose weights are averaged (Polyak and Juditsky 1992)
    exploration: float = 0.05  # [-] in the fine-tuning
    episodes: int = 200  # training episodes drawn
    members: int = 1  # fits to resampled flight that the gate asks beside the fit
    tests: int = 16  # validation episodes that the gate flies in each
    periods: int = 50  # that each of them is flown, see `shortened`
    seed: int = 0

    def __post_init__(self):
        if self.updates < 1:
            raise InputError(f"--updates {self.updates}: expected at least 1")


@dataclass(frozen=True)
class Job:
    """What a lesson begins with."""

    flying: Policy  # that is to be bettered
    residual: ResidualDynamics | None  # that the model is thought to lack; None is nothing
    stale: bool  # it was fitted before the target changed
    window: Transitions
    number: int  # of the lesson


@dataclass(frozen=True)
class Lesson:
    """What came of it."""

    residual: ResidualDynamics | None  # to go on with
    fitted: bool  # it is a new one
    policy: Policy | None  # to fly from now on; None where the present one stays
    reason: str
    found: str = ""  # what the model lacks, in words
    verdict: Verdict | None = None


def learn(job, settings):
    """The `Lesson` of a job; one that can't be carried out has its reason, and the present policy flies on."""
    torch.set_num_threads(1)
    try:
        return _learn(job, settings)
    except InputError as error:
        return Lesson(job.residual, False, None, f"failed: {error}")


def _learn(job, settings):
    source = Dynamics(job.flying.task.system)
    try:
        residual, report = fit_residual(job.window, source, settings.kind, settings.seed)
    except InputError as error:
        return Lesson(job.residual, False, None, f"nothing fitted: {error}")
    present = job.residual or source
    fitted = likelihood(residual, job.window) > likelihood(present, job.window) + BETTER
    if not fitted and job.stale:
        return Lesson(job.residual, False, None, "the target has changed, these data don't say how", described(present))
    if not fitted and job.residual is None:
        return Lesson(None, False, None, "the model explains what is flown")
    residual = residual if fitted else job.residual
    dynamics, _ = fastest(residual)
    tuned = tune(job.flying, dynamics, residual, settings, settings.seed + job.number)
    members = fit_ensemble(
        job.window, source, report.kind, settings.members, settings.seed + job.number, tuple(report.parameters)
    )
    models = {"the fit": dynamics} | {f"resampled flight {i + 1}": member for i, member in enumerate(members)}
    task = shortened(job.flying.task, settings.periods)
    noise = sensor_noise(residual, job.window)
    chosen, verdict = Gate(job.flying, models, task, settings.seed, settings.tests, noise).choose(tuned)
    new = None if chosen is job.flying else chosen
    return Lesson(residual, fitted, new, verdict.reason, described(residual), verdict)


def tune(policy, dynamics, residual, settings, seed):
    """Continue the training of a policy in dynamics.

    Training episodes are drawn once and kept. The action that costs nothing is that which holds the robot as it was
    found to be: with the model's own a payload is carried too low. What is returned is the mean of the weights over the
    last updates, which is more exact than the last, at a learning rate that stays high.

    Args:
        residual: that the dynamics were made of, perhaps compiled.
    """
    names = ("updates", "batch", "learning_rate", "final_rate", "exploration", "episodes")
    config = replace(finetuning(policy), **{name: getattr(settings, name) for name in names})
    method, task = METHODS[policy.method].module, task_of(policy.task, residual)
    bank = training_episodes(policy.task, config.episodes)
    run = method.begin(dynamics, task, [bank], config, seed, policy.network)
    mean = AveragedModel(run.network)
    for _ in method.train(run, dynamics, task, [bank], config):
        if run.update > (1 - settings.averaged) * config.updates:
            mean.update_parameters(run.network)
    updates = policy.info.get("finetuned_updates", 0) + run.update
    return replace(policy, network=mean.module, info={**policy.info, "finetuned_updates": updates})


def task_of(task, residual):
    """The task of the robot with its refitted parameters, if they are what was learned."""
    changed = getattr(residual, "changed", None)
    return task if changed is None else replace(task, system=changed.system)


def shortened(task, periods):
    """The task with brief episodes; whole ones where what counts is how the robot arrives at their end."""
    ends_early = type(task).arrived is not Task.arrived
    return task if ends_early else replace(task, steps=min(periods, task.steps))


@lru_cache(maxsize=1)
def training_episodes(task, count):
    """Training episodes; drawing them takes as long as a fit."""
    return task.episodes(count, "train", 0)


def described(residual):
    """What a residual found, in words."""
    if not isinstance(residual, ResidualDynamics):
        return "nothing"
    if residual.config.kind != "parameters":
        return f"kind {residual.config.kind}"
    values = zip(residual.config.parameters, residual.values.tolist(), strict=True)
    return ", ".join(f"{name} {value:.3g}" for name, value in values) or "nothing"
