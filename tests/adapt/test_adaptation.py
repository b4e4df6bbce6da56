"""Adaptation: the policy learns the target from transitions alone, and the one that was given stays as it is."""

import copy
from dataclasses import replace

import pytest
import torch

from adapt import finetuning, rounds
from adapt.adaptation import ELSEWHERE, adapt
from adapt.clock import Clock
from adapt.finetuning import finetune
from adapt.flying import collect
from adapt.residual import MINIMUM
from adapt.transitions import Transitions, joined
from envs import make_dynamics
from envs.dynamics import Dynamics
from envs.env import TrackingEnv
from envs.errors import InputError
from policies import apg
from policies.checkpoints import load_policy
from policies.evaluate import evaluate
from policies.networks import as_actor

QUICK = replace(apg.FINETUNE, updates=30, batch=64, episodes=100)
TARGET = "drag=1"


@pytest.fixture(scope="module")
def target():
    return make_dynamics("cartpole", TARGET)


@pytest.fixture(scope="module")
def adapted(rough_cartpole, target):
    """An adaptation with an oracle, what it kept and the stages it went through, and the weights it began with."""
    before = copy.deepcopy(rough_cartpole.network.state_dict())
    kept, stages = {}, []
    result = adapt(
        rough_cartpole,
        target,
        samples=200,
        config=QUICK,
        oracle=True,
        stage=stages.append,
        keep=lambda name, value: kept.setdefault(name, value),
    )
    return result, kept, stages, before


def mean(result, name):
    return result.evaluations[name].summary["mean"]


def test_few_transitions_are_enough_to_fly_the_target(adapted):
    result = adapted[0]
    assert mean(result, "few_shot") < 0.5 * mean(result, "zero_shot")
    assert mean(result, "zero_shot") > mean(result, "source")
    assert result.evaluations["few_shot"].summary["success"] == 1


def test_a_residual_that_explains_the_target_is_as_good_as_the_target_itself(adapted):
    result = adapted[0]
    assert mean(result, "few_shot") == pytest.approx(mean(result, "oracle"), rel=0.1)
    error = result.prediction["model + residual"]["acceleration"]
    assert error < 0.05 * result.prediction["model"]["acceleration"]


def test_the_given_policy_stays_as_it_is(adapted, rough_cartpole):
    result, _, _, before = adapted
    for name, value in rough_cartpole.network.state_dict().items():
        assert torch.equal(value, before[name])
    assert rough_cartpole.info == {"seed": 0}
    assert all(parameter.grad is None for parameter in result.residual.parameters())
    moved = [not torch.equal(value, before[name]) for name, value in result.policy.network.state_dict().items()]
    assert any(moved)
    for name in ("observation_mean", "observation_scale", "window_scale"):
        assert torch.equal(result.policy.network.state_dict()[name], before[name])


def test_what_is_finished_is_handed_out_at_once_and_in_order(adapted):
    result, kept, stages, _ = adapted
    assert list(kept) == ["transitions", "residual", "policy"]
    assert kept["transitions"] is result.transitions
    assert kept["residual"] is result.residual
    assert kept["policy"] is result.policy
    assert stages == ["evaluate", "collect", "fit", "finetune", "gate", "evaluate", "oracle"]
    assert set(result.seconds) == set(stages)
    assert all(seconds > 0 for seconds in result.seconds.values())


def test_the_report_tells_what_was_done(adapted):
    result = adapted[0]
    assert len(result.transitions) == 200
    assert [row["update"] for row in result.history] == list(range(1, 31))
    assert 0 < result.policy.info["finetuned_updates"] <= 30  # the best of those that were flown
    assert result.verdict.accepted
    assert result.policy.task == result.oracle.task
    assert {name: len(e.table) for name, e in result.evaluations.items()} == dict.fromkeys(
        ("source", "zero_shot", "few_shot", "oracle"), 50
    )


def test_the_target_is_flown_but_never_differentiated(rough_cartpole, target):
    """The residual and the policy must learn from transitions alone."""
    inside = []

    class Watched:
        system, dt = target.system, target.dt

        def __call__(self, state, action):
            inside.append(torch.is_grad_enabled() and (state.requires_grad or action.requires_grad))
            return target(state, action)

    adapt(rough_cartpole, Watched(), samples=30, config=replace(QUICK, updates=2))
    assert inside
    assert not any(inside)
    adapt(rough_cartpole, Watched(), samples=30, config=replace(QUICK, updates=2), oracle=True)
    assert any(inside)  # an oracle is allowed to


@pytest.mark.slow
def test_the_same_seed_adapts_the_same_way_and_another_does_not(rough_cartpole, target):
    few = {"samples": 30, "config": replace(QUICK, updates=3)}
    one, two, other = (adapt(rough_cartpole, target, seed=seed, **few) for seed in (0, 0, 1))
    assert torch.equal(one.transitions.state, two.transitions.state)
    first, second = ([{**row, "seconds": None} for row in result.history] for result in (one, two))
    assert first == second
    assert one.evaluations["few_shot"].table.equals(two.evaluations["few_shot"].table)
    assert not torch.equal(one.transitions.state, other.transitions.state)


@pytest.mark.slow
def test_where_nothing_differs_the_given_policy_is_kept(rough_cartpole):
    tuned = adapt(rough_cartpole, make_dynamics("cartpole"), samples=60, config=replace(QUICK, updates=1))
    assert tuned.policy is rough_cartpole
    assert not tuned.verdict.accepted
    assert tuned.verdict.reason == "fine-tuning found nothing that flies better in the fitted model"
    assert tuned.verdict.models == {}
    assert tuned.evaluations["few_shot"] is tuned.evaluations["zero_shot"]
    without = adapt(rough_cartpole, make_dynamics("cartpole"), samples=60, config=replace(QUICK, updates=1), gate=False)
    assert without.verdict is None
    assert without.policy is not rough_cartpole


def flown(policy, target, n):
    env = TrackingEnv(target, policy.task, policy.task.episodes(20, "train", 77))
    return collect(as_actor(policy.network), env, n, 0.1, torch.Generator().manual_seed(0))


@pytest.mark.slow
def test_recorded_transitions_are_used_as_they_are(rough_cartpole, target):
    recorded = flown(rough_cartpole, target, 150)
    result = adapt(rough_cartpole, target, transitions=recorded, samples=9, config=QUICK)
    assert result.transitions is recorded
    assert mean(result, "few_shot") < 0.5 * mean(result, "zero_shot")


def test_transitions_that_were_flown_elsewhere_are_noticed(rough_cartpole, target):
    recorded, config = flown(rough_cartpole, target, 100), replace(QUICK, updates=1)
    there, elsewhere = (
        adapt(rough_cartpole, dynamics, transitions=recorded, episodes=3, config=config, gate=False).fit.warnings
        for dynamics in (target, make_dynamics("cartpole"))
    )
    assert ELSEWHERE in elsewhere and ELSEWHERE not in there


@pytest.mark.slow
def test_without_a_target_the_residual_stands_in_for_it(rough_cartpole, target):
    recorded = flown(rough_cartpole, target, 150)
    result = adapt(rough_cartpole, None, transitions=recorded, config=QUICK)
    in_truth = adapt(rough_cartpole, target, transitions=recorded, config=QUICK)
    for name in ("source", "zero_shot", "few_shot"):  # the residual of a drag is all but exact
        assert mean(result, name) == pytest.approx(mean(in_truth, name), rel=0.05)
    assert result.prediction == {"model": result.fit.before, "model + residual": result.fit.after}
    assert "oracle" not in result.evaluations


def test_a_context_is_held_while_the_policy_is_tuned(rough_cartpole, target):
    recorded = flown(rough_cartpole, target, 150)
    voltage = torch.linspace(3, 4, 150).unsqueeze(-1)
    with_context = replace(recorded, context=voltage, context_names=("voltage",))
    quick = replace(QUICK, updates=2)
    result = adapt(rough_cartpole, None, transitions=with_context, context=voltage.mean(0), config=quick)
    assert result.evaluations["few_shot"].summary["n"] == 50
    by_default = adapt(rough_cartpole, None, transitions=with_context, config=quick)  # the recorded mean
    assert mean(by_default, "few_shot") == mean(result, "few_shot")


def test_recorded_transitions_with_a_context_can_be_tried_in_a_target(rough_cartpole, target):
    recorded = flown(rough_cartpole, target, 150)
    with_context = replace(recorded, context=torch.ones(150, 1), context_names=("voltage",))
    result = adapt(rough_cartpole, target, transitions=with_context, config=replace(QUICK, updates=2))
    assert result.prediction["model + residual"]["velocity"] < 0.1 * result.prediction["model"]["velocity"]


def test_a_target_may_be_text_and_must_be_of_the_same_robot(rough_cartpole, target):
    few = {"samples": 30, "config": replace(QUICK, updates=1), "kind": "linear", "gate": False, "episodes": 2}
    spoken, made = (adapt(rough_cartpole, which, **few) for which in (TARGET, target))
    assert torch.equal(spoken.transitions.next_state, made.transitions.next_state)
    with pytest.raises(InputError, match="the target is a quadrotor, the policy flies a cartpole"):
        adapt(rough_cartpole, make_dynamics("quadrotor"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "needs a target to fly in, or recorded transitions"),
        ({"transitions": "some", "oracle": True}, "--oracle: needs a target"),
    ],
)
def test_it_needs_something_to_learn_from(rough_cartpole, options, words):
    with pytest.raises(InputError, match=words):
        adapt(rough_cartpole, **options)


def test_an_unknown_kind_and_too_few_transitions_are_refused(rough_cartpole, target):
    with pytest.raises(InputError, match="--residual jerk: expected one of auto, parameters"):
        adapt(rough_cartpole, target, samples=30, kind="jerk")
    with pytest.raises(InputError, match=f"5 transitions, at least {MINIMUM} are needed"):
        adapt(rough_cartpole, target, samples=5)


def test_transitions_of_another_robot_are_refused(rough_cartpole, target):
    recorded = replace(flown(rough_cartpole, target, 20), system="fixed_wing")
    with pytest.raises(InputError, match="recorded on fixed_wing, expected cartpole"):
        adapt(rough_cartpole, target, transitions=recorded)


def test_a_model_without_finite_gradients_is_refused(rough_cartpole, target):
    def lost(state, action):
        return target(state, action) * torch.nan

    with pytest.raises(InputError, match="no update had a finite gradient"):
        finetune(rough_cartpole, lost, replace(QUICK, updates=3))


def test_finetuning_trains_on_training_episodes_only(rough_cartpole, target, monkeypatch):
    asked, task = [], rough_cartpole.task
    draw = type(task).episodes
    monkeypatch.setattr(
        type(task), "episodes", lambda self, n, split, *a, **k: asked.append(split) or draw(self, n, split, *a, **k)
    )
    finetune(rough_cartpole, target, replace(QUICK, updates=2))
    assert set(asked) == {"train"}


def test_progress_wraps_the_updates(rough_cartpole, target):
    seen = []

    def watched(updates, total):
        for metrics in updates:
            seen.append(metrics["update"])
            yield metrics

    _, history = finetune(rough_cartpole, target, replace(QUICK, updates=3), progress=watched)
    assert seen == [1, 2, 3] == [row["update"] for row in history]


def test_the_tuning_has_no_curriculum(rough_quadrotor):
    last = rough_quadrotor.task.thresholds[1]
    assert [apg.stage(apg.FINETUNE, rough_quadrotor.task, 1, update) for update in (1, 2, 199)] == [(last, 0)] * 3


def test_a_stage_that_comes_back_goes_on_counting():
    clock = Clock(lambda name: None)
    clock.seconds = {"fly": 100.0}
    clock.next("fly")
    clock.next("fit")
    seconds = clock.stop()
    assert 100 < seconds["fly"] < 101
    assert 0 <= seconds["fit"] < 1
    assert clock.stop() == seconds


@pytest.mark.slow
def test_a_quadrotor_learns_a_drag_from_ten_seconds_of_flight(rough_quadrotor):
    target = make_dynamics("quadrotor", "drag=0.6")
    settings = {"config": replace(QUICK, updates=100), "oracle": True, "gate": False}  # a rough policy still crashes
    result = adapt(rough_quadrotor, target, samples=100, **settings)
    assert isinstance(result.transitions, Transitions)
    assert mean(result, "few_shot") < 0.7 * mean(result, "zero_shot")
    assert mean(result, "few_shot") < 1.25 * mean(result, "oracle")


def test_in_rounds_each_part_is_flown_by_the_policy_tuned_on_those_before(rough_cartpole, target, monkeypatch):
    flown = []
    whole = rounds.fly

    def noted(policy, *rest):
        flown.append(policy)
        return whole(policy, *rest)

    monkeypatch.setattr(rounds, "fly", noted)
    result = adapt(rough_cartpole, target, samples=100, rounds=3, config=replace(QUICK, updates=3))
    assert flown[0] is rough_cartpole
    assert len({id(policy) for policy in flown}) == 3
    assert len(result.transitions) == 100
    assert len(result.history) == 3


def test_a_pole_that_is_tuned_where_nothing_differs_is_held_as_still_as_before():
    policy = load_policy("cartpole")
    source, tests = Dynamics(policy.task.system), policy.task.episodes(30, "validation", 0)
    tuned, _ = finetune(policy, source)
    before, after = (evaluate(p.actor(), source, policy.task, tests).summary["mean"] for p in (policy, tuned))
    assert after < 1.05 * before


def test_to_watch_flies_validation_episodes_in_the_target(rough_cartpole, target):
    judge = finetuning.Judge(rough_cartpole, target, rough_cartpole.task, every=5, last=11, episodes=4)
    assert judge(rough_cartpole.network, 4) == {} and judge.seconds == 0
    assert set(judge(rough_cartpole.network, 11)) == {"error", "success"} and judge.seconds > 0
    unseen = rough_cartpole.task.episodes(4, "validation", 0)
    found = finetuning.evaluate(as_actor(rough_cartpole.network), target, rough_cartpole.task, unseen).summary
    assert judge(rough_cartpole.network, 10) == {"error": found["mean"], "success": found["success"]}


def test_no_more_is_flown_once_it_is_known(rough_cartpole, target):
    few = {"samples": 400, "config": replace(QUICK, updates=3), "gate": False, "until_known": True}
    assert len(adapt(rough_cartpole, target, **few).transitions) == 80  # a drag is known after the first tenth


def test_stale_flight_is_not_learned_from(rough_cartpole, target):
    old = flown(rough_cartpole, make_dynamics("cartpole", "cart_mass=x2"), 120)
    mixed = joined((old, flown(rough_cartpole, target, 120)))
    result = adapt(rough_cartpole, target, transitions=mixed, config=replace(QUICK, updates=3))
    assert len(result.transitions) == 120
    assert "older flight contradicts newer" in result.fit.warnings[0]
    assert result.fit.parameters["drag"][0] == pytest.approx(1.0, rel=1e-3)
