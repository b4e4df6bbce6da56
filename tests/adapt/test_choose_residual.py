"""The kind of residual is chosen by the flight that it predicts, the simplest of equals."""

from dataclasses import replace

import pytest
import torch

from adapt import collect
from adapt.choose_residual import HeldOut, Tried, choose, simplest
from adapt.prediction import prediction_error
from adapt.residual import MENU, fit_residual
from adapt.stretches import displaced
from envs import make_dynamics
from envs.errors import InputError
from policies.checkpoints import load_policy

TARGET = "drag=0.3"


@pytest.fixture(scope="module")
def data():
    policy = load_policy("quadrotor")
    task = policy.task
    return collect(policy.actor(), (make_dynamics("quadrotor", TARGET), task, task.episodes(20, "train", 9)), 250, 0.1)


def tried(kind, *shares):
    return Tried(kind, torch.tensor(shares))


def test_the_model_leaves_everything_and_the_truth_nothing(data):
    base, truth = make_dynamics("quadrotor"), make_dynamics("quadrotor", TARGET)
    half = make_dynamics("quadrotor", "drag=0.15")
    held = HeldOut(base, data.double())
    everything, nothing, a_quarter = (held.share(held.missed(one)) for one in (base, truth, half))
    # states that a drag doesn't change, attitude and rates, count nothing and leave a half
    assert everything == pytest.approx(0.5)
    assert nothing < 1e-6
    assert a_quarter == pytest.approx(everything / 4, rel=0.2)  # over a second, it grows a little slower


def test_what_predicts_the_next_measurement_by_filtering_noise_is_no_better_than_the_truth(data):
    """Under noise a yaw rate seems to decay faster than it does: a gain that isn't there predicts it."""
    seen, base = measured(data.double()), make_dynamics("quadrotor")
    filtering, truth = (make_dynamics("quadrotor", target) for target in (f"{TARGET} rate_gain_z=8", TARGET))
    assert prediction_error(filtering, seen)["rates"] < prediction_error(truth, seen)["rates"]
    held = HeldOut(base, seen)
    scale = held.missed(truth).square().mean((0, 1)).sqrt()
    filtered, true = (held.unexplained(held.missed(one), scale)[:, 11].mean() for one in (filtering, truth))
    assert filtered > true


def test_another_beginning_explains_what_it_leads_to_and_no_push(data):
    base, pushed = make_dynamics("quadrotor", TARGET), make_dynamics("quadrotor", f"{TARGET} push=0.5")
    held = HeldOut(base, data.double())
    shift = 1e-3 * torch.randn(12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    begun_elsewhere, unit = held.of_start @ shift, torch.ones(12, dtype=torch.float64)
    assert held.unexplained(begun_elsewhere, unit).max() < 1e-12
    assert held.unexplained(held.missed(pushed), unit)[:, 6].min() > 1e-6


def measured(data):
    """The same with errors of 1 mm, 0.5 deg, 0.02 m/s, 0.05 rad/s; a state is measured once."""
    deviations = torch.tensor([0.001] * 3 + [0.0087] * 3 + [0.02] * 3 + [0.05] * 3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    errors = deviations * torch.randn(len(data) + 1, 12, generator=generator, dtype=torch.float64)
    system = make_dynamics("quadrotor").system
    states = [
        displaced(system, part, error) for part, error in ((data.state, errors[:-1]), (data.next_state, errors[1:]))
    ]
    return replace(data, state=states[0], next_state=states[1])


def test_of_equals_the_simplest_is_taken():
    assert simplest([tried("a", 0.5, 0.6, 0.4), tried("b", 0.49, 0.6, 0.4)]) == "a"


def test_a_kind_that_is_surely_better_is_taken():
    assert simplest([tried("a", 0.5, 0.6, 0.4), tried("b", 0.1, 0.2, 0.1), tried("c", 0.1, 0.19, 0.1)]) == "b"


def test_a_doubtful_gain_is_not_worth_a_more_complex_kind():
    assert simplest([tried("a", 0.5, 0.5, 0.5, 0.5), tried("b", 0.1, 0.9, 0.1, 0.8)]) == "a"


def test_what_could_not_be_fitted_is_left_out_and_where_nothing_could_that_is_said():
    failed = Tried("a", None, "too few")
    assert simplest([failed, tried("b", 0.5)]) == "b"


def test_where_no_kind_can_be_fitted_that_is_said(data):
    def fit(part, kind):
        raise InputError("too few")

    with pytest.raises(InputError, match="no kind of residual can be fitted; a: too few"):
        choose(data.double(), make_dynamics("quadrotor"), ("a", "b"), fit)


def test_nothing_more_complex_is_tried_once_nothing_is_left(data):
    asked = []

    def fit(part, kind):
        asked.append((kind, len(part)))
        return make_dynamics("quadrotor", {"poor": "drag=0.1", "perfect": TARGET, "never": TARGET}[kind])

    found, kind, solved = choose(data.double(), make_dynamics("quadrotor"), ("poor", "perfect", "never"), fit)
    assert kind == "perfect"
    assert solved
    assert [one.kind for one in found] == ["poor", "perfect"]
    assert {name for name, _ in asked} == {"poor", "perfect"}
    assert all(count < 250 for _, count in asked)  # never on what it is judged by


def test_a_kind_that_there_are_too_few_transitions_for_is_dropped(data):
    def fit(part, kind):
        if kind == "hungry":
            raise InputError("too few transitions")
        return make_dynamics("quadrotor", "drag=0.1")

    found, kind, solved = choose(data.double(), make_dynamics("quadrotor"), ("hungry", "modest"), fit)
    assert not solved
    assert kind == "modest" and found[0].why == "too few transitions"


def test_auto_finds_a_drag_and_says_what_it_tried(data):
    _, report = fit_residual(data, make_dynamics("quadrotor"), "auto")
    assert report.kind == "parameters" and report.parameters["drag"][0] == pytest.approx(0.3, rel=1e-5)
    assert [one.kind for one in report.tried] == ["parameters"]
    assert report.solved


@pytest.mark.parametrize("kind", MENU)
def test_every_kind_of_the_menu_predicts_better_than_the_model(data, kind):
    _, report = fit_residual(data, make_dynamics("quadrotor"), kind)
    share = {"state": 1.0, "network": 0.6, "features": 0.6}.get(kind, 1e-3)
    assert report.after["acceleration"] < share * report.before["acceleration"]
    assert report.kind == kind
