"""Adaptation: collect transitions in the target, fit a residual, fine-tune the policy in `f + residual`, evaluate.

The target's equations are used for nothing but flying in it: the residual and the policy learn from transitions alone.
"""

import copy
import math
import time
from dataclasses import dataclass, field, replace

import torch

from adapt import residual as residuals
from adapt.bootstrap import fit_ensemble
from adapt.flying import collect, film_transitions, filmed
from adapt.gate import UNCHANGED, Gate, Verdict
from adapt.labelling import check_labels
from adapt.mending import mended, still_true
from adapt.plants import flights_of
from adapt.prediction import prediction_error
from adapt.residual_dynamics import ResidualDynamics
from adapt.transitions import Transitions, check, joined
from adapt.trust_region import Best, same_weights
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.pixels import tracking_env
from policies import METHODS
from policies.checkpoints import Policy
from policies.compiled_dynamics import fastest
from policies.evaluate import Evaluation, evaluate, test_episodes

PICTURE_ROUNDS = 5
PARTS = 10  # that `until_known` divides the transitions into
KNOWN = 0.01  # [-] share of the model's error below which flight is known
FALLING = 0.9  # times the last part's share that the next one's must be at most for another flight to be worth it
APART = 1_000  # between the seeds of the training episodes of two rounds
VALIDATIONS = 4  # of the policy that is fine-tuned, in the fitted model
MEMBERS = 3  # fits to resampled flight that the gate asks
HELD_OUT = 1000  # transitions flown for the report alone, to measure the prediction error


@dataclass(frozen=True)
class Adaptation:
    """What `adapt` returns: the new policy, the residual it was tuned in, and the evidence."""

    policy: Policy  # the tuned one, or the old one where the gate kept it
    residual: ResidualDynamics
    transitions: Transitions
    fit: residuals.FitReport
    evaluations: dict[str, Evaluation]  # source, zero_shot, few_shot, perhaps refused (by the gate) and oracle
    prediction: dict[str, dict[str, float]]  # one-step errors of "model" and "model + residual"
    history: list[dict]  # metrics of each fine-tuning update
    seconds: dict[str, float] = field(default_factory=dict)
    oracle: Policy | None = None
    flights: dict | None = None  # what flying a plant was like, see `adapt.plants.Flights.report`
    verdict: Verdict | None = None  # of the gate; None without one


def finetuning(policy):
    """The settings that a policy is fine-tuned with unless others are asked for."""
    return usual_finetuning(policy.method, policy.task.system)


def usual_finetuning(method, system):
    """The same for what a method, by name, has trained for a system."""
    module = METHODS[method].module
    return module.finetuning(module.PRESETS.get(system.name, module.Config()))


def finetune(policy, dynamics, config=None, seed=0, progress=None, footage=None, judge=None, validations=0):
    """Continue the training of a policy in other dynamics; the given policy stays as it is.

    Args:
        dynamics: anything that is differentiable, such as a fitted residual. On the CPU they are compiled where they
            can be, see `policies.compiled_dynamics`.
        config: of the policy's method; None is `finetuning(policy)`.
        progress: wraps the iterable of updates and takes its length as `total`, as `tqdm` does.
        footage: for a policy that sees pictures: `Footage` of the target, from whose pictures it learns.
        judge: called with the network and the number of each update; returns what is added to its metrics.
        validations: how often the network flies validation episodes in the dynamics on the way. What flies best is
            returned, be it the policy as given; without any, what was trained last.

    Returns:
        the new `Policy` and the metrics of each update, with the `seconds` spent until then without judging.
    """
    method, config = METHODS[policy.method].module, config or finetuning(policy)
    device = next(policy.network.parameters()).device
    if device.type == "cpu":
        dynamics, _ = fastest(dynamics)
    bank = policy.task.episodes(config.episodes, "train", seed).to(device)
    filmed = {} if footage is None else {"footage": footage}
    run = method.begin(dynamics, policy.task, [bank], config, seed, policy.network, **filmed)
    best = Best(policy, dynamics, config.updates, validations) if validations else None
    updates = _judged(method.train(run, dynamics, policy.task, [bank], config), run, judge, best)
    history = list(progress(updates, total=config.updates) if progress else updates)
    if run.skipped == config.updates:
        raise InputError("fine-tuning: no update had a finite gradient; the residual may be of the wrong scale")
    if best:
        run.network.load_state_dict(best.weights)
    info = {**policy.info, "finetuned_updates": best.update if best else run.update, "finetune_seed": seed}
    return Policy(run.network, policy.task, info, policy.method), history


def _judged(updates, run, judge, best):
    """The metrics of each update with the time spent on training, the best noted, and what a judge says."""
    seconds, begun = 0.0, time.perf_counter()
    for metrics in updates:
        if best:
            best(run.network, metrics["update"])
        seconds += time.perf_counter() - begun
        said = judge(run.network, metrics["update"]) if judge else {}
        yield {**metrics, "seconds": seconds, **said}
        begun = time.perf_counter()


def learn(policy, target, samples, kind=residuals.AUTO, exploration=0.1, seed=0):
    """Fly a policy in a target and fit a residual to its source: (transitions, residual, report), as `adapt` does."""
    device = next(policy.network.parameters()).device
    transitions, _ = _flown(policy, target, policy.task, samples, exploration, seed, device)
    return transitions, *residuals.fit_residual(transitions, Dynamics(policy.task.system), kind, seed)


def adapt(
    policy,
    target=None,
    *,
    plant=None,
    samples=1000,
    transitions=None,
    kind=residuals.AUTO,
    exploration=0.1,
    rounds=None,
    until_known=False,
    seed=0,
    config=None,
    gate=True,
    oracle=False,
    episodes=None,
    watch=None,
    context=None,
    seen=None,
    progress=None,
    stage=lambda name: None,
    keep=lambda name, result: None,
):
    """Adapt a policy to a target from few transitions.

    Args:
        policy: a `Policy` that analytic policy gradients made; its task's system is the source.
        target: dynamics to fly and to evaluate in. None where the target is known by its transitions only: then
            policies are evaluated in the model with the residual, which stands in for it.
        plant: a `Plant` to fly and to evaluate in instead, or `Flights` of one: its equations are not needed.
        samples: transitions to fly in the target; ignored where `transitions` are given.
        transitions: recorded `Transitions` to learn from instead.
        kind: of the residual, one of `adapt.residual.KINDS` or "auto".
        exploration: standard deviation of noise on the actions flown for data.
        rounds: parts that the transitions are flown in, each by the policy tuned on those before (default: 1, or 5
            for a policy that sees pictures: it knows no states but those that it was filmed in).
        until_known: fly no more parts (10 at most unless `rounds` says otherwise) once the flight just flown was
            predicted about as well before it was learned from as the one before it; `samples` is the most then.
        config: of the fine-tuning, see `finetune`.
        gate: return the tuned policy only where it is surely better than the given one, see `adapt.gate`.
        oracle: also fine-tune for as long in the true target, as a bound of what data could give; with several rounds,
            from the policy of the last.
        episodes: test episodes that each policy is evaluated on (default: as many as the published tables use); fewer
            for a plant that is slow or wears out.
        watch: every so many updates of the fine-tuning the policy is flown over validation episodes in the target (or
            what stands in for it), and `error` and `success` are added to the history: to see it work, at the price of
            flights that `samples` doesn't count. Nothing is chosen by them.
        context: values of the residual's context while the policy is tuned and evaluated (default: the recorded mean).
        seen: the task as it is seen in the target (default: as the policy knows it); its camera may be another.
        progress: see `finetune`.
        stage: called with the name of each stage as it begins.
        keep: called with "transitions", "residual" and "policy" and the result, as soon as each exists.

    Raises:
        InputError: when there is neither target nor transitions, the transitions don't fit the policy's robot, their
            actions are swapped or shifted (`adapt.labelling`), or a plant has other states or another control period,
            or gives nothing to learn from.
    """
    if plant is not None:
        target = flights_of(plant, policy, target, oracle)
    if METHODS[policy.method].pixels and (target is None or transitions is not None):
        raise InputError("adapt: a policy that sees pictures learns from them, and has to fly in the target to get any")
    if target is None and transitions is None:
        raise InputError("adapt: needs a target to fly in, or recorded transitions")
    if target is None and oracle:
        raise InputError("--oracle: needs a target that can be flown in; a log has none")
    clock, recorded = Clock(stage), transitions is not None
    task, source = policy.task, Dynamics(policy.task.system)
    seen = seen or task
    device = next(policy.network.parameters()).device
    tests = test_episodes(task, episodes).to(device)
    actor, footage, begun = policy.actor(seed), None, policy
    clock.next("evaluate")
    evaluations = {"source": evaluate(actor, source, task, tests)}
    clock.next("collect")
    held_out, notes = None, []
    if target is not None:
        if transitions is None:
            most = PICTURE_ROUNDS if METHODS[policy.method].pixels else 1
            most = PARTS if until_known else most
            rounds = rounds or min(most, max(1, samples // residuals.MINIMUM))
            settings = {"kind": kind, "config": config or finetuning(policy), "until_known": until_known}
            settings |= {"progress": progress, "keep": keep}
            begun, transitions, footage = _collected(
                policy, target, seen, samples, rounds, exploration, seed, device, **settings
            )
            if until_known and len(transitions) < samples:
                notes.append(
                    f"stopped flying after {len(transitions)} of {samples} transitions: more would tell no more"
                )
        held_out = _held_out(actor, target, seen, len(tests), seed, device)
    keep("transitions", transitions)
    _check_flown(target, transitions)
    check(transitions, source.system, residuals.MINIMUM)
    transitions, mends = mended(transitions)
    if mends:
        keep("transitions", transitions)
    notes += [*mends, *check_labels(transitions, source)]
    clock.next("fit")
    residual, fit = residuals.fit_residual(transitions, source, kind, seed)
    # Only what was recorded may be of different days; what was flown just now is of one robot.
    if recorded and not fit.solved and len(newest := still_true(transitions, source, seed)) < len(transitions):
        notes.append(f"older flight contradicts newer: learned from the last {len(newest)} of {len(transitions)} alone")
        transitions = newest
        residual, fit = residuals.fit_residual(transitions, source, kind, seed)
    fit = replace(fit, warnings=(*notes, *fit.warnings))
    if transitions.context is not None:
        context = transitions.context.mean(0) if context is None else torch.as_tensor(context)
        if held_out is not None:
            constant = context.expand(len(held_out), -1)
            held_out = replace(held_out, context=constant, context_names=transitions.context_names)
    keep("residual", residual)
    prediction = {"model": fit.before, "model + residual": fit.after}
    if held_out is not None:
        both = (("model", source), ("model + residual", residual))
        prediction = {name: prediction_error(dynamics, held_out) for name, dynamics in both}
    # A copy: what is returned stays on the CPU, where the transitions are.
    seeing = context is not None and residual.config.context_names
    learned = copy.deepcopy(residual.with_context(context) if seeing else residual).to(device)
    truth = target if target is not None else learned
    judge = watch and Judge(policy, truth, seen, watch, (config or finetuning(policy)).updates)
    clock.next("finetune")
    validations = VALIDATIONS if gate and not METHODS[policy.method].pixels else 0
    tuned, history = finetune(begun, learned, config, seed, progress, footage, judge, validations)
    if judge:
        clock.move("finetune", "watch", judge.seconds)
    chosen, verdict = tuned, None
    if gate:
        clock.next("gate")
        chosen, verdict = policy, UNCHANGED
        if not same_weights(policy, tuned):
            models = {"the fit": learned} | _alternatives(policy, transitions, source, fit, context, seed, device)
            chosen, verdict = Gate(policy, models, seen, seed).choose(tuned)
    keep("policy", chosen)
    clock.next("evaluate")
    evaluations["zero_shot"] = evaluate(actor, truth, seen, tests)
    evaluations["few_shot"] = evaluations["zero_shot"]
    if chosen is not policy:
        evaluations["few_shot"] = evaluate(chosen.actor(seed), truth, seen, tests)
    if chosen is policy and verdict is not UNCHANGED and plant is None:  # no plant is risked for it
        evaluations["refused"] = evaluate(tuned.actor(seed), truth, seen, tests)
    best = None
    if oracle:
        clock.next("oracle")
        best, _ = finetune(begun, target, config, seed, progress, footage)
        evaluations["oracle"] = evaluate(best.actor(seed), target, seen, tests)
    flights = None if plant is None else target.report()
    spent = clock.stop()
    return Adaptation(
        chosen, residual, transitions, fit, evaluations, prediction, history, spent, best, flights, verdict
    )


def _alternatives(policy, transitions, source, fit, context, seed, device):
    """Models {name: dynamics} that the data allow beside the fit: of resampled flight, and of the next best kind."""
    if METHODS[policy.method].pixels:
        return {}  # flights of pictures take long
    members = fit_ensemble(transitions, source, fit.kind, MEMBERS, seed, tuple(fit.parameters))
    models = {f"resampled flight {i + 1}": member for i, member in enumerate(members)}
    if other := residuals.runner_up(fit):
        models[f"kind {other}"] = residuals.fit_residual(transitions, source, other, seed)[0]
    bound = {name: m.with_context(context) if m.config.context_names else m for name, m in models.items()}
    return {name: model.to(device) for name, model in bound.items()}


def _held_out(actor, target, task, episodes, seed, device):
    """Transitions of validation episodes, no more than the test episodes have; None of a plant that was lost."""
    unseen = task.episodes(20, "validation", seed).to(device)
    try:
        return collect(actor, tracking_env(target, task, unseen, device=device), min(HELD_OUT, episodes * task.steps))
    except InputError:
        if getattr(target, "lost", False):
            return None
        raise


def _collected(
    policy, target, task, samples, rounds, exploration, seed, device, *, kind, config, until_known, progress, keep
):
    """Fly, fit, tune, fly: the policy of the last round, all transitions, and all footage if it sees pictures.

    What was flown is kept before it is learned from, so that it outlives a fit that fails.
    """
    transitions = footage = residual = None
    source, last = Dynamics(policy.task.system), math.inf
    for number in range(rounds):
        share = samples * (number + 1) // rounds - samples * number // rounds
        try:
            part, film = _flown(policy, target, task, share, exploration, seed + APART * number, device)
        except InputError:
            if transitions is None or not getattr(target, "lost", False):
                raise
            break  # a plant was given up: what it flew before is kept
        transitions = part if transitions is None else joined((transitions, part))
        footage = film if footage is None else footage.joined(film)
        if until_known and residual is not None:
            left = _surprise(residual, source, part)
            if left < KNOWN or left > FALLING * last:
                break
            last = left
        if number + 1 == rounds or getattr(target, "lost", False):  # a plant may be given up in any part
            break
        keep("transitions", transitions)
        residual, _ = residuals.fit_residual(transitions, source, kind, seed)
        briefly = replace(config, updates=max(1, config.updates // 3))
        policy, _ = finetune(policy, residual.to(device), briefly, seed, progress, footage)
    return policy, transitions, footage


def _check_flown(target, transitions):
    """Refuse what a plant flew before it was given up where that is too little to learn from."""
    if getattr(target, "lost", False) and len(transitions) < residuals.MINIMUM:
        flown, why = f"{len(transitions)} transitions", target.faults[0]
        raise InputError(f"{target.name}: was given up after {flown} ({why}); at least {residuals.MINIMUM} are needed")


def _surprise(residual, source, part):
    """The share [-] of the model's acceleration error that a residual leaves of flight that it has not seen."""
    missed = [prediction_error(dynamics, part)["acceleration"] for dynamics in (residual.cpu(), source)]
    return missed[0] / max(missed[1], 1e-12)


def _flown(policy, target, task, samples, exploration, seed, device):
    """Transitions of training episodes that the pretraining did not see, and the footage if it sees pictures."""
    episodes = task.episodes(max(20, 2 * samples // task.steps), "train", 1_000_000 + seed).to(device)
    generator = torch.Generator().manual_seed(seed)
    if task.camera is None:
        env = tracking_env(target, task, episodes, device=device)
        return collect(policy.actor(seed), env, samples, exploration, generator), None
    footage = filmed(policy, target, task, episodes, samples, exploration, generator)
    return film_transitions(footage, task.system), footage


class Judge:
    """Flies a network over validation episodes every so many updates, and after the last; counts its `seconds`."""

    def __init__(self, policy, dynamics, task, every, last, episodes=50):
        self.policy, self.dynamics, self.task, self.every, self.last = policy, dynamics, task, every, last
        self.episodes, self.seconds = test_episodes(task, episodes, "validation"), 0.0

    def __call__(self, network, update):
        """`error` and `success`, or nothing after the updates between."""
        if update % self.every and update != self.last:
            return {}
        begun = time.perf_counter()
        device = next(network.parameters()).device
        actor = replace(self.policy, network=network).actor()
        summary = evaluate(actor, self.dynamics, self.task, self.episodes.to(device)).summary
        self.seconds += time.perf_counter() - begun
        return {"error": summary["mean"], "success": summary["success"]}


class Clock:
    """Seconds spent in each named stage; a stage that comes back goes on counting."""

    def __init__(self, stage):
        self.seconds, self.stage, self.name = {}, stage, None

    def next(self, name):
        """End the present stage and begin the named one."""
        self.stop()
        self.name, self.begun = name, time.perf_counter()
        self.stage(name)

    def move(self, stage, other, seconds):
        """Count a part of a stage, which ends, as another one."""
        self.stop()
        self.seconds[stage] -= seconds
        self.seconds[other] = self.seconds.get(other, 0.0) + seconds

    def stop(self):
        """End the present stage; returns {stage: seconds}."""
        if self.name:
            self.seconds[self.name] = self.seconds.get(self.name, 0.0) + time.perf_counter() - self.begun
        self.name = None
        return self.seconds
