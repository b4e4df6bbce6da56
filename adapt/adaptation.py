"""Adaptation: collect transitions in the target, fit a residual, fine-tune the policy in `f + residual`, evaluate.

The target's equations are used for nothing but flying in it: the residual and the policy learn from transitions alone.
"""

import copy
from dataclasses import dataclass, field, replace

import torch

from adapt import residual as residuals
from adapt.bootstrap import fit_ensemble
from adapt.clock import Clock
from adapt.finetuning import Judge, finetune, finetuning
from adapt.gate import Gate, Verdict, nothing_found
from adapt.labelling import check_labels
from adapt.mending import mended, still_true
from adapt.plants import flights_of
from adapt.plausible import check_units
from adapt.prediction import prediction_error
from adapt.residual_dynamics import ResidualDynamics
from adapt.rounds import check_flown, fly, fly_in_rounds, held_out
from adapt.sensor_noise import sensor_noise
from adapt.transitions import Transitions, check
from adapt.trust_region import same_weights
from envs.domains import parse_target
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.registry import make_dynamics
from policies import METHODS
from policies.checkpoints import Policy
from policies.evaluate import Evaluation, evaluate, test_episodes

PICTURE_ROUNDS = 5
PARTS = 10  # that `until_known` divides the transitions into
ELSEWHERE = "the residual predicts flight in the target worse than the model alone; were the transitions flown there?"
VALIDATIONS = 4  # of the policy that is fine-tuned, in the fitted model
WORSE, LITTLE = 1.5, 0.01  # [-] times, [m/s^2, rad/s^2] beyond which a residual misleads
MEMBERS = 3  # fits to resampled flight that the gate asks


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


def learn(policy, target, samples, kind=residuals.AUTO, exploration=0.1, seed=0):
    """Fly a policy in a target and fit a residual to its source: (transitions, residual, report), as `adapt` does."""
    transitions, _ = fly(policy, target, policy.task, samples, exploration, seed)
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
        target: dynamics to fly and to evaluate in, or how they differ, such as "drag=0.3 mass=x1.2". None where the
            target is known by its transitions only: then policies are evaluated in the model with the residual, which
            stands in for it.
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
    if isinstance(target, str):
        domain = parse_target(target, policy.task.system)
        target, seen = make_dynamics(policy.task.system, domain), seen or domain.seen(policy.task)
    if plant is not None:
        target = flights_of(plant, policy, target, oracle)
    _check(policy, target, transitions, oracle)
    task, source, pixels = policy.task, Dynamics(policy.task.system), METHODS[policy.method].pixels
    seen, config = seen or task, config or finetuning(policy)
    device = next(policy.network.parameters()).device
    tests = test_episodes(task, episodes).to(device)
    clock, recorded, begun, footage = Clock(stage), transitions is not None, policy, None
    clock.next("evaluate")
    evaluations = {"source": evaluate(policy.actor(seed), source, task, tests)}
    clock.next("collect")
    if not recorded:
        most = PICTURE_ROUNDS if pixels else PARTS if until_known else 1
        rounds = rounds or min(most, max(1, samples // residuals.MINIMUM))
        how = {"exploration": exploration, "seed": seed, "kind": kind, "config": config, "until_known": until_known}
        begun, transitions, footage = fly_in_rounds(
            policy, target, seen, samples, rounds, **how, progress=progress, keep=keep
        )
    unseen = None if target is None else held_out(policy, target, seen, len(tests), seed)
    keep("transitions", transitions)
    check_flown(target, transitions)
    notes = []
    if until_known and not recorded and len(transitions) < samples and not getattr(target, "lost", False):
        notes.append(f"stopped flying after {len(transitions)} of {samples} transitions: more would tell no more")
    transitions = _mended(transitions, source, notes, keep)
    clock.next("fit")
    transitions, residual, fit = _fitted(transitions, source, kind, seed, recorded, notes)
    keep("residual", residual)
    if transitions.context is not None:
        context = transitions.context.mean(0) if context is None else torch.as_tensor(context)
    prediction = _prediction(source, residual, fit, unseen, context, transitions.context_names)
    if recorded and _misleads(prediction):
        fit = replace(fit, warnings=(*fit.warnings, ELSEWHERE))
    # A copy: what is returned stays on the CPU, where the transitions are.
    held = _bound(residual, context)
    learned = copy.deepcopy(held).to(device)
    truth = target if target is not None else learned
    clock.next("finetune")
    judge = watch and Judge(policy, truth, seen, watch, config.updates)
    validations = VALIDATIONS if gate and not pixels else 0
    noise = sensor_noise(held, transitions) if validations else ()
    tuned, history = finetune(begun, learned, config, seed, progress, footage, judge, validations, noise)
    if judge:
        clock.move("finetune", "watch", judge.seconds)
    chosen, verdict, changed = tuned, None, not same_weights(policy, tuned)
    if gate:
        clock.next("gate")
        chosen, verdict = policy, nothing_found(noise)
        if changed:
            models = {"the fit": learned} | _alternatives(policy, transitions, source, fit, context, seed, device)
            chosen, verdict = Gate(policy, models, seen, seed, noise=noise).choose(tuned)
    keep("policy", chosen)
    clock.next("evaluate")
    flown = {"zero_shot": policy, "few_shot": chosen}
    if chosen is policy and changed and plant is None:  # no plant is risked for it
        flown["refused"] = tuned
    evaluations |= _evaluated(flown, truth, seen, tests, seed)
    best = None
    if oracle:
        clock.next("oracle")
        best, _ = finetune(begun, target, config, seed, progress, footage)
        evaluations |= _evaluated({"oracle": best}, target, seen, tests, seed)
    flights = None if plant is None else target.report()
    spent = clock.stop()
    return Adaptation(
        chosen, residual, transitions, fit, evaluations, prediction, history, spent, best, flights, verdict
    )


def _check(policy, target, transitions, oracle):
    """Refuse what can't be adapted with."""
    if METHODS[policy.method].pixels and (target is None or transitions is not None):
        raise InputError("adapt: a policy that sees pictures learns from them, and has to fly in the target to get any")
    if target is not None and target.system.name != policy.task.system.name:
        raise InputError(f"adapt: the target is a {target.system.name}, the policy flies a {policy.task.system.name}")
    if target is None and transitions is None:
        raise InputError("adapt: needs a target to fly in, or recorded transitions")
    if target is None and oracle:
        raise InputError("--oracle: needs a target that can be flown in; a log has none")


def _mended(transitions, source, notes, keep):
    """The transitions that can be learned from; what was done to them, and what is odd, is added to the notes."""
    check(transitions, source.system, residuals.MINIMUM)
    transitions, mends = mended(transitions)
    if mends:
        keep("transitions", transitions)
    notes += [*mends, *check_units(transitions, source.system), *check_labels(transitions, source)]
    return transitions


def _fitted(transitions, source, kind, seed, recorded, notes):
    """What was learned from, the residual and its report, with the notes.

    Only what was recorded may be of different days; what was flown just now is of one robot.
    """
    residual, fit = residuals.fit_residual(transitions, source, kind, seed)
    if recorded and not fit.solved and len(newest := still_true(transitions, source, seed)) < len(transitions):
        kept = f"the last {len(newest)} of {len(transitions)} alone, as they were given"
        notes.append(f"older flight contradicts newer: learned from {kept}")
        transitions = newest
        residual, fit = residuals.fit_residual(transitions, source, kind, seed)
    return transitions, residual, replace(fit, warnings=(*notes, *fit.warnings))


def _prediction(source, residual, fit, unseen, context, names):
    """One-step errors of model and residual on unseen transitions; where there are none, those that the fit held out.

    Args:
        context: in which the unseen transitions were flown, by its names; there are none where none was recorded.
    """
    if unseen is None:
        return {"model": fit.before, "model + residual": fit.after}
    if names:
        unseen = replace(unseen, context=context.expand(len(unseen), -1), context_names=names)
    both = {"model": source, "model + residual": residual}
    return {name: prediction_error(dynamics, unseen) for name, dynamics in both.items()}


def _misleads(prediction):
    """Whether the residual predicts accelerations clearly worse than the model alone."""
    before, after = prediction["model"], prediction["model + residual"]
    return any(after[what] > WORSE * before[what] + LITTLE for what in before if what.endswith("acceleration"))


def _bound(residual, context):
    """A residual in the context that it is used in, where it asks for one."""
    return residual.with_context(context) if context is not None and residual.config.context_names else residual


def _evaluated(policies, dynamics, task, tests, seed):
    """The evaluations of policies by name; what two names have in common is flown once."""
    flown = {}
    for policy in policies.values():
        if id(policy) not in flown:
            flown[id(policy)] = evaluate(policy.actor(seed), dynamics, task, tests)
    return {name: flown[id(policy)] for name, policy in policies.items()}


def _alternatives(policy, transitions, source, fit, context, seed, device):
    """Models {name: dynamics} that the data allow beside the fit: of resampled flight, and of the next best kind."""
    if METHODS[policy.method].pixels:
        return {}  # flights of pictures take long
    members = fit_ensemble(transitions, source, fit.kind, MEMBERS, seed, tuple(fit.parameters))
    models = {f"resampled flight {i + 1}": member for i, member in enumerate(members)}
    if other := residuals.runner_up(fit):
        models[f"kind {other}"] = residuals.fit_residual(transitions, source, other, seed)[0]
    return {name: _bound(model, context).to(device) for name, model in models.items()}
