"""Actions whose columns, signs or times are wrong are refused, whatever differs in the target; right ones are not."""

import contextlib
from dataclasses import replace

import pytest
import torch

from adapt import labelling
from adapt.flying import collect
from adapt.labelling import check_labels
from adapt.transitions import joined
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.registry import make_dynamics
from policies.checkpoints import load_policy

TARGETS = {
    "quadrotor": ("", "drag=0.5", "mass=x1.5 push=1,0,0", "noise=1"),
    "fixed_wing": ("", "quadratic_drag=0.2", "thrust_loss=0.4"),
    "cartpole": ("", "track_friction=0.2", "force_limit=x0.6"),
}


def flown(system, target="", samples=200, seeds=(0, 1)):
    """Transitions of the shipped policy, in two flights, and the source."""
    policy, dynamics = load_policy(system), make_dynamics(system, target)
    parts = []
    for seed in seeds:
        episodes, generator = policy.task.episodes(20, "train", seed), torch.Generator().manual_seed(seed)
        flight = (dynamics, policy.task, episodes)
        parts.append(collect(policy.actor(seed), flight, samples // 2, 0.1, generator))
    return joined(parts), Dynamics(policy.task.system)


@pytest.mark.parametrize(("system", "target"), [(name, target) for name, all_ in TARGETS.items() for target in all_])
def test_what_was_recorded_rightly_is_taken(system, target):
    assert check_labels(*flown(system, target)) == []


def test_the_standard_error_of_a_gain_is_how_far_it_scatters(monkeypatch):
    """Errors of the same size under both labels: the gain is 0 but for chance."""
    generator = torch.Generator().manual_seed(0)
    monkeypatch.setattr(labelling, "_squares", lambda base, data: torch.randn(50, 4, generator=generator).square())
    gains, doubts = torch.tensor([labelling._gain(None, None, None) for _ in range(400)]).T
    assert float(gains.std()) == pytest.approx(float(doubts.mean()), rel=0.15)
    assert gains.mean().abs() < 3 * gains.std() / 400**0.5


@pytest.mark.parametrize(("doubt", "refused"), [(0.04, True), (0.08, False)])
def test_a_gain_that_may_be_chance_refuses_nothing(monkeypatch, doubt, refused):
    data, source = flown("cartpole", samples=20)
    monkeypatch.setattr(labelling, "_gain", lambda base, recorded, other: (0.3, doubt))
    with pytest.raises(InputError) if refused else contextlib.nullcontext():
        check_labels(data, source)


@pytest.mark.parametrize("samples", [10, 200])
def test_swapped_actions_are_named(samples):
    data, source = flown("quadrotor", "drag=0.3", samples)
    with pytest.raises(InputError, match="with p_des and r_des swapped"):
        check_labels(replace(data, action=data.action[:, [0, 3, 2, 1]]), source)


@pytest.mark.parametrize(("system", "column", "name"), [("cartpole", 0, "force"), ("fixed_wing", 1, "elevator")])
def test_a_turned_sign_is_named(system, column, name):
    data, source = flown(system)
    turned = data.action.clone()
    turned[:, column] *= -1
    with pytest.raises(InputError, match=f"with the sign of {name} turned"):
        check_labels(replace(data, action=turned), source)


def shifted(data, shift):
    """The first flight with the actions of other periods."""
    inner = slice(1, 99)
    return replace(data.select(inner), action=data.action.roll(shift, 0)[inner])


def test_actions_recorded_a_period_late_are_told():
    data, source = flown("quadrotor", "drag=0.3")
    with pytest.raises(InputError, match="with each action one control period earlier"):
        check_labels(shifted(data, 1), source)


def test_a_robot_that_acts_a_period_late_is_no_error_but_noted():
    data, source = flown("quadrotor", "drag=0.3")
    (note,) = check_labels(shifted(data, -1), source)
    assert "the robot acts late" in note


def test_a_shift_is_sought_within_flights_only():
    """Where nothing says what came before, nothing says that it was recorded at another time."""
    data, source = flown("quadrotor", "drag=0.3")
    inner = slice(1, 99)
    apart = replace(data.select(inner), action=data.action.roll(1, 0)[inner], trajectory=torch.arange(98))
    check_labels(apart, source)
