"""Adaptation: collect transitions in the target, fit a residual, fine-tune the policy in `f + residual`, evaluate.

The target's equations are used for nothing but flying in it: the residual and the policy learn from transitions alone.
"""

import copy
import time
from dataclasses import dataclass, field, replace

import torch

from adapt import residual as residuals
from adapt.flying import collect
from adapt.prediction import prediction_error
from adapt.residual_dynamics import ResidualDynamics
from adapt.transitions import Transitions
from envs.dynamics import Dynamics
from envs.env import TrackingEnv
from envs.errors import InputError
from policies import apg
from policies.apg import FINETUNE
from policies.checkpoints import Policy
from policies.evaluate import Evaluation, evaluate, test_episodes
from policies.networks import as_actor

HELD_OUT = 1000  # transitions flown for the report alone, to measure the prediction error


@dataclass(frozen=True)
class Adaptation:
    """What `adapt` returns: the new policy, the residual it was tuned in, and the evidence."""

    policy: Policy
    residual: ResidualDynamics
    transitions: Transitions
    fit: residuals.FitReport
    evaluations: dict[str, Evaluation]  # source, zero_shot, few_shot and perhaps oracle
    prediction: dict[str, dict[str, float]]  # one-step errors of "model" and "model + residual"
    history: list[dict]  # metrics of each fine-tuning update
    seconds: dict[str, float] = field(default_factory=dict)
    oracle: Policy | None = None


def finetune(policy, dynamics, config=FINETUNE, seed=0, progress=None):
    """Continue the training of a policy in other dynamics; the given policy stays as it is.

    Args:
        dynamics: anything that is differentiable, such as a fitted residual.
        progress: wraps the iterable of updates, as `tqdm` does.

    Returns:
        the new `Policy` and the metrics of each update.
    """
    bank = policy.task.episodes(config.episodes, "train", seed).to(next(policy.network.parameters()).device)
    run = apg.begin(dynamics, policy.task, [bank], config, seed, policy.network)
    updates = apg.train(run, dynamics, policy.task, [bank], config)
    history = list(progress(updates) if progress else updates)
    if run.skipped == config.updates:
        raise InputError("fine-tuning: no update had a finite gradient; the residual may be of the wrong scale")
    info = {**policy.info, "finetuned_updates": run.update, "finetune_seed": seed}
    return Policy(run.network, policy.task, info), history


def learn(policy, target, samples, kind="acceleration", exploration=0.1, seed=0):
    """Fly a policy in a target and fit a residual to its source: (transitions, residual, report), as `adapt` does."""
    device = next(policy.network.parameters()).device
    transitions = _flown(as_actor(policy.network), target, policy.task, samples, exploration, seed, device)
    return transitions, *residuals.fit_residual(transitions, Dynamics(policy.task.system), kind, seed)


def adapt(
    policy,
    target=None,
    *,
    samples=1000,
    transitions=None,
    kind="acceleration",
    exploration=0.1,
    seed=0,
    config=FINETUNE,
    oracle=False,
    context=None,
    progress=None,
    stage=lambda name: None,
    keep=lambda name, result: None,
):
    """Adapt a policy to a target from few transitions.

    Args:
        policy: a `Policy`; its task's system is the source.
        target: dynamics to fly and to evaluate in. None where the target is known by its transitions only: then
            policies are evaluated in the model with the residual, which stands in for it.
        samples: transitions to fly in the target; ignored where `transitions` are given.
        transitions: recorded `Transitions` to learn from instead.
        kind: of the residual, "acceleration" or "state".
        exploration: standard deviation of noise on the actions flown for data.
        config: `APGConfig` of the fine-tuning.
        oracle: also fine-tune for as long in the true target, as a bound of what data could give.
        context: values of the residual's context while the policy is tuned and evaluated (default: the recorded mean).
        progress: wraps iterables of updates, as `tqdm` does.
        stage: called with the name of each stage as it begins.
        keep: called with "transitions", "residual" and "policy" and the result, as soon as each exists.

    Raises:
        InputError: when there is neither target nor transitions, or the transitions don't fit the policy's robot.
    """
    if target is None and transitions is None:
        raise InputError("adapt: needs a target to fly in, or recorded transitions")
    if target is None and oracle:
        raise InputError("--oracle: needs a target that can be flown in; a log has none")
    clock = Clock(stage)
    task, source = policy.task, Dynamics(policy.task.system)
    device = next(policy.network.parameters()).device
    tests = test_episodes(task).to(device)
    actor = as_actor(policy.network)
    clock.next("evaluate")
    evaluations = {"source": evaluate(actor, source, task, tests)}
    clock.next("collect")
    held_out = None
    if target is not None:
        if transitions is None:
            transitions = _flown(actor, target, task, samples, exploration, seed, device)
        unseen = task.episodes(20, "validation", seed).to(device)
        held_out = collect(actor, TrackingEnv(target, task, unseen, device=device), HELD_OUT)
    if transitions.context is not None:
        context = transitions.context.mean(0) if context is None else torch.as_tensor(context)
        if held_out is not None:
            seen = context.expand(len(held_out), -1)
            held_out = replace(held_out, context=seen, context_names=transitions.context_names)
    keep("transitions", transitions)
    clock.next("fit")
    residual, fit = residuals.fit_residual(transitions, source, kind, seed)
    keep("residual", residual)
    prediction = {"model": fit.before, "model + residual": fit.after}
    if held_out is not None:
        both = (("model", source), ("model + residual", residual))
        prediction = {name: prediction_error(dynamics, held_out) for name, dynamics in both}
    # A copy: what is returned stays on the CPU, where the transitions are.
    learned = copy.deepcopy(residual if context is None else residual.with_context(context)).to(device)
    clock.next("finetune")
    tuned, history = finetune(policy, learned, config, seed, progress)
    keep("policy", tuned)
    clock.next("evaluate")
    truth = target if target is not None else learned
    evaluations["zero_shot"] = evaluate(actor, truth, task, tests)
    evaluations["few_shot"] = evaluate(as_actor(tuned.network), truth, task, tests)
    best = None
    if oracle:
        clock.next("oracle")
        best, _ = finetune(policy, target, config, seed, progress)
        evaluations["oracle"] = evaluate(as_actor(best.network), target, task, tests)
    return Adaptation(tuned, residual, transitions, fit, evaluations, prediction, history, clock.stop(), best)


def _flown(actor, target, task, samples, exploration, seed, device):
    """Transitions of training episodes that the pretraining did not see."""
    episodes = task.episodes(max(20, 2 * samples // task.steps), "train", 1_000_000 + seed).to(device)
    generator = torch.Generator().manual_seed(seed)
    return collect(actor, TrackingEnv(target, task, episodes, device=device), samples, exploration, generator)


class Clock:
    """Seconds spent in each named stage; a stage that comes back goes on counting."""

    def __init__(self, stage):
        self.seconds, self.stage, self.name = {}, stage, None

    def next(self, name):
        """End the present stage and begin the named one."""
        self.stop()
        self.name, self.begun = name, time.perf_counter()
        self.stage(name)

    def stop(self):
        """End the present stage; returns {stage: seconds}."""
        if self.name:
            self.seconds[self.name] = self.seconds.get(self.name, 0.0) + time.perf_counter() - self.begun
        self.name = None
        return self.seconds
