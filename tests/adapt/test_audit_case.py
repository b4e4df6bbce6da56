"""A case of the audit: how records are spoilt, how old and new are compared, what becomes of failures."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pandas as pd
import pytest
import torch

from adapt import audit_case
from adapt.audit_case import case, duplicated, flipped, late, not_finite, ratio, spoilt, swapped
from adapt.audit_targets import draw
from envs.errors import InputError
from envs.registry import make_dynamics
from policies.checkpoints import load_policy


def flights(errors, success=None):
    return pd.DataFrame({"error": errors, "success": success or [True] * len(errors)})


def drawn(spoilt="", target="drag=0.3", **changes):
    plain = {"spoilt": spoilt, "target": target, "transitions": 60, "columns": (), "share": 0.0, "other": ""}
    return replace(draw("quadrotor", 0, 0), **(plain | changes))


@pytest.fixture(scope="module")
def policy():
    return load_policy("quadrotor")


@pytest.fixture(scope="module")
def clean(policy):
    """The record of `drawn` before it is spoilt."""
    return audit_case._flown(policy, "quadrotor", "drag=0.3", 60, drawn().chance, _generator())


def _generator():
    return torch.Generator().manual_seed(drawn().chance)


# --- comparison -------------------------------------------------------------------------------------------------------


def test_the_ratio_is_that_of_the_mean_errors():
    assert ratio(flights([1.0, 3.0]), flights([1.0, 1.0])) == pytest.approx(0.5)


def test_only_flights_that_both_fly_are_compared():
    old = flights([1.0, 9.0, 1.0], [True, False, True])
    new = flights([2.0, 50.0, 2.0])
    assert ratio(old, new) == pytest.approx(2.0)


def test_a_flight_more_that_fails_is_worse_than_any_error():
    assert ratio(flights([1.0, 1.0]), flights([0.1, 0.1], [True, False])) == math.inf


def test_where_both_fail_all_nothing_has_changed():
    assert ratio(flights([1.0], [False]), flights([5.0], [False])) == 1.0


def test_where_only_the_new_one_flies_there_is_no_error_left():
    assert ratio(flights([1.0], [False]), flights([5.0], [True])) == 0.0


# --- spoilt records ---------------------------------------------------------------------------------------------------


def test_swapped_and_flipped_actions_are_those_that_were_named():
    action = torch.tensor([[1.0, 2.0, 3.0]])
    assert swapped(action, (0, 2)).tolist() == [[3.0, 2.0, 1.0]]
    assert flipped(action, (1,)).tolist() == [[1.0, -2.0, 3.0]]
    assert action.tolist() == [[1.0, 2.0, 3.0]], "what was flown stays as it is"


def test_late_actions_are_those_of_the_row_before_within_a_flight():
    action, trajectory = torch.arange(5.0)[:, None], torch.tensor([0, 0, 0, 1, 1])
    assert late(action, trajectory)[:, 0].tolist() == [0.0, 0.0, 1.0, 3.0, 3.0]


def test_duplicated_rows_stand_beside_each_other():
    rows = duplicated(1000, 0.3, _generator()).tolist()
    assert rows == sorted(rows) and set(rows) == set(range(1000))
    assert 1250 < len(rows) < 1350 and max(map(rows.count, set(rows))) == 2


def test_a_shuffled_record_has_the_same_rows_in_another_order(policy, clean):
    found = spoilt(policy, drawn("shuffled"))
    assert not torch.equal(found.state, clean.state)
    assert sorted(map(tuple, found.state.tolist())) == sorted(map(tuple, clean.state.tolist()))


@pytest.mark.parametrize("way", ["swapped", "flipped", "late"])
def test_a_mislabelled_record_lies_about_the_actions_alone(policy, clean, way):
    found = spoilt(policy, drawn(way, columns=(0, 2)[: 2 if way == "swapped" else 1]))
    assert torch.equal(found.state, clean.state) and torch.equal(found.next_state, clean.next_state)
    assert not torch.equal(found.action, clean.action)


def test_a_share_of_a_stale_record_was_flown_in_another_target(policy):
    found = spoilt(policy, drawn("stale", share=0.25, other="mass=x1.5", target="drag=0.3"))
    assert len(found) == 60
    for part, target in ((slice(0, 15), "mass=x1.5"), (slice(15, None), "drag=0.3")):
        rows = found.select(part)
        followed = make_dynamics("quadrotor", target)(rows.state, rows.action)
        assert float((followed - rows.next_state).abs().max()) < 1e-5
    assert not set(found.trajectory[:15].tolist()) & set(found.trajectory[15:].tolist())


def test_the_smallest_record_can_be_stale(policy):
    assert len(spoilt(policy, drawn("stale", share=0.01, other="mass=x1.5", transitions=10))) == 10


# --- rows -------------------------------------------------------------------------------------------------------------


def adaptation(policy, refused=False, share=1.0):
    """What `adapt` returns, with errors 4 before, 2 after the gate and 1 after what it refused."""

    def flown(error):
        table, summary = flights([error, error]), {"mean": error, "success": 1.0}
        return SimpleNamespace(table=table, summary=summary, unit="m")

    evaluations = {"source": flown(0.5), "zero_shot": flown(4.0), "few_shot": flown(2.0)}
    verdict = SimpleNamespace(accepted=True, confidence=0.99, reason="better", gain=0.7, share=share, distance=0.1)
    fit = SimpleNamespace(kind="parameters", parameters={"drag": (0.3, 0.01)})
    return SimpleNamespace(
        evaluations=evaluations | ({"refused": flown(1.0)} if refused else {}),
        verdict=verdict,
        fit=fit,
        policy=policy,
        residual=torch.nn.Linear(1, 1),
        seconds={"fit": 1.0, "finetune": 2.0, "gate": 3.0},
    )


def with_adapt(monkeypatch, answer):
    def adapt(*arguments, **settings):
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(audit_case, "adapt", adapt)
    return case("quadrotor", 0, 0, episodes=2)


def test_without_a_refusal_the_gate_made_no_difference(policy, monkeypatch):
    row = with_adapt(monkeypatch, adaptation(policy))
    assert (row["ratio"], row["ratio_ungated"]) == (0.5, 0.5)
    assert (row["zero_shot_error"], row["gated_error"], row["ungated_error"]) == (4.0, 2.0, 2.0)
    assert row["crash"] == row["refused_data"] == ""


def test_what_the_gate_refused_counts_as_ungated(policy, monkeypatch):
    row = with_adapt(monkeypatch, adaptation(policy, refused=True, share=0.5))
    assert (row["ratio"], row["ratio_ungated"]) == (0.5, 0.25)


def test_data_that_are_refused_leave_the_old_policy(monkeypatch):
    row = with_adapt(monkeypatch, InputError("transitions: too short"))
    assert row["refused_data"] == "transitions: too short" and row["crash"] == ""
    assert row["ratio"] == row["ratio_ungated"] == 1.0 and not row["accepted"]
    assert row["gated_error"] == row["zero_shot_error"] > 0


def test_any_other_error_is_a_crash_and_is_told_with_its_place(monkeypatch):
    row = with_adapt(monkeypatch, ZeroDivisionError("nothing to divide by"))
    assert "ZeroDivisionError: nothing to divide by" in row["crash"] and "audit_case.py" in row["crash"]
    assert "\n" not in row["crash"] and row["target"] == draw("quadrotor", 0, 0).target


def test_a_policy_that_is_not_finite_is_a_crash(policy, monkeypatch):
    found = adaptation(policy)
    broken = load_policy("quadrotor")
    next(iter(broken.network.parameters())).data[0] = math.nan
    found.policy = broken
    assert "policy" in not_finite(found)
    assert "policy" in with_adapt(monkeypatch, found)["crash"]
    assert not_finite(adaptation(policy)) == ""
