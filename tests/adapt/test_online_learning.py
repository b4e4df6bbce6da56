"""One lesson: fit to the newest flight, fine-tune, ask the gate."""

from dataclasses import replace

import pytest
import torch

from adapt.flying import collect
from adapt.online_learning import Job, Settings, described, learn, task_of, tune
from adapt.residual import fit_residual
from envs import make_dynamics, make_system
from envs.dynamics import Dynamics
from envs.errors import InputError
from policies.checkpoints import load_policy
from policies.evaluate import evaluate
from policies.evaluate import test_episodes as draw_tests

BRIEF = Settings(updates=30, episodes=50, tests=8, periods=40)


@pytest.fixture(scope="module")
def policy():
    return load_policy("quadrotor", make_system("quadrotor"), "apg")


@pytest.fixture(scope="module")
def window(policy):
    """Flies so many transitions in a target."""

    def fly(target, count=40):
        env = make_dynamics("quadrotor", target), policy.task, draw_tests(policy.task, 5)
        return collect(policy.actor(), env, count)

    return fly


@pytest.fixture(scope="module")
def job(policy):
    def make(transitions, residual=None, stale=False, number=0):
        return Job(policy, residual, stale, transitions, number)

    return make


def test_a_payload_is_found_and_the_new_policy_carries_it_better(policy, window, job):
    lesson = learn(job(window("mass=x1.2", 10)), BRIEF)
    assert lesson.fitted and lesson.verdict.accepted
    assert lesson.found == "mass 0.868"
    heavy, tests = make_dynamics("quadrotor", "mass=x1.2"), draw_tests(policy.task, 10)
    errors = [evaluate(one.actor(), heavy, policy.task, tests).summary["mean"] for one in (policy, lesson.policy)]
    assert errors[1] < 0.3 * errors[0]


def test_the_same_job_gives_the_same_lesson(window, job):
    one, same = (
        learn(job(window("mass=x1.2", 10)), replace(BRIEF, updates=10)).policy.network.state_dict() for _ in range(2)
    )
    assert all(torch.equal(one[name], same[name]) for name in one)


def test_nothing_is_tuned_where_the_model_explains_what_is_flown(window, job):
    lesson = learn(job(window("")), BRIEF)
    assert (lesson.policy, lesson.fitted, lesson.residual, lesson.verdict) == (None, False, None, None)
    assert lesson.reason == "the model explains what is flown"


def test_a_residual_that_still_explains_what_is_flown_is_kept(policy, window, job):
    residual, _ = fit_residual(window("mass=x1.2", 20), Dynamics(policy.task.system), "parameters")
    lesson = learn(job(window("mass=x1.2"), residual), BRIEF)
    assert not lesson.fitted and lesson.residual is residual and lesson.verdict is not None


def test_a_change_that_the_data_do_not_explain_yet_is_no_reason_to_tune(policy, window, job):
    residual, _ = fit_residual(window("mass=x1.2", 20), Dynamics(policy.task.system), "parameters")
    lesson = learn(job(window("mass=x1.2"), residual, stale=True), BRIEF)
    assert lesson.policy is None and lesson.residual is residual
    assert lesson.reason == "the target has changed, these data don't say how"


def test_a_change_back_is_found(policy, window, job):
    residual, _ = fit_residual(window("mass=x1.2", 20), Dynamics(policy.task.system), "parameters")
    lesson = learn(job(window(""), residual, stale=True), BRIEF)
    assert lesson.fitted and lesson.found == "nothing"


def test_a_policy_that_got_no_better_is_not_taken(policy, window, job):
    good = learn(job(window("mass=x1.2")), replace(BRIEF, updates=100)).policy
    lesson = learn(replace(job(window("mass=x1.2")), flying=good), replace(BRIEF, updates=1))
    assert lesson.policy is None and not lesson.verdict.accepted


def test_data_that_nothing_can_be_fitted_to_end_in_a_reason(window, job):
    lesson = learn(job(window("mass=x1.2", 5)), BRIEF)
    assert lesson.policy is None
    assert lesson.reason.startswith("nothing fitted: transitions: 5 transitions")


def test_a_lesson_that_fails_ends_in_a_reason_and_keeps_the_residual(policy, window, job, monkeypatch):
    residual, _ = fit_residual(window("mass=x1.2", 20), Dynamics(policy.task.system), "parameters")

    def fails(*_):
        raise InputError("it diverged")

    monkeypatch.setattr("adapt.online_learning.tune", fails)
    lesson = learn(job(window("mass=x1.2"), residual), BRIEF)
    assert (lesson.policy, lesson.residual, lesson.reason) == (None, residual, "failed: it diverged")


def test_what_costs_nothing_is_to_hold_the_robot_that_was_found(policy, window):
    residual, _ = fit_residual(window("mass=x1.2"), Dynamics(policy.task.system), "parameters")
    assert task_of(policy.task, residual).system.trim_action.thrust == pytest.approx(1.2 * 9.81 / 7.5 - 9.81 / 7.5)
    assert (
        task_of(policy.task, fit_residual(window("mass=x1.2"), Dynamics(policy.task.system), "linear")[0])
        is policy.task
    )


def test_tuning_averages_the_weights_of_the_last_updates(policy):
    dynamics = make_dynamics("quadrotor", "mass=x1.2")
    settings = replace(BRIEF, updates=2, averaged=1.0)
    both = tune(policy, dynamics, dynamics, settings, 0).network.state_dict()
    last = tune(policy, dynamics, dynamics, replace(settings, averaged=0.5), 0).network.state_dict()
    first = tune(policy, dynamics, dynamics, replace(settings, updates=1), 0).network.state_dict()
    before = policy.network.state_dict()
    name = next(name for name in both if not torch.equal(both[name], before[name]))
    assert not torch.equal(last[name], both[name])
    assert torch.allclose(both[name] - before[name], 0.5 * (first[name] + last[name]) - before[name], atol=2e-3)


def test_the_policy_that_is_tuned_stays_as_it_is(policy):
    before = {name: value.clone() for name, value in policy.network.state_dict().items()}
    tune(policy, make_dynamics("quadrotor"), None, replace(BRIEF, updates=2), 0)
    assert all(torch.equal(before[name], value) for name, value in policy.network.state_dict().items())


def test_an_aircraft_that_is_judged_where_it_arrives_gets_that_far():
    wing = load_policy("fixed_wing", make_system("fixed_wing"), "apg")
    windy, tests = make_dynamics("fixed_wing", "wind=1"), draw_tests(wing.task, 10)
    transitions = collect(wing.actor(), (windy, wing.task, tests), 80)
    lesson = learn(Job(wing, None, False, transitions, 0), Settings())
    assert lesson.verdict.models["the fit"]["old_success"] > 0, lesson.reason
    errors = [evaluate(one.actor(), windy, wing.task, tests).summary["mean"] for one in (wing, lesson.policy)]
    assert lesson.verdict.accepted and errors[1] < 0.2 * errors[0]


def test_what_was_found_is_told_in_words(policy, window):
    assert described(Dynamics(policy.task.system)) == "nothing"
    linear, _ = fit_residual(window("drag=0.3"), Dynamics(policy.task.system), "linear")
    assert described(linear) == "kind acceleration"


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match=r"--updates 0: expected at least 1"):
        Settings(updates=0)
