"""Stretches of flight cover what was recorded, end at gaps, and measure how far a prediction strays."""

import pytest
import torch

from adapt import collect
from adapt.stretches import cut, difference, displaced
from envs import make_dynamics
from envs.dynamics import Dynamics
from policies.checkpoints import load_policy


def flown(n, name="cartpole"):
    policy = load_policy(name)
    task = policy.task
    return collect(policy.actor(), (make_dynamics(name), task, task.episodes(20, "train", 9)), n)


def test_flights_are_cut_into_stretches_that_cover_them():
    data = flown(64)
    cuts = cut(data, 10)
    assert cuts.measured.shape == (7, 11, 4) and cuts.action.shape == (7, 10, 1)  # six, and one that overlaps
    for row in data.state:
        assert (cuts.measured == row).all(-1).any()
    assert set(cuts.trajectory.tolist()) == set(data.trajectory.tolist())


def test_stretches_tell_how_often_a_transition_stands_in_them():
    assert cut(flown(60), 10).repeated == 1
    assert cut(flown(64), 10).repeated == pytest.approx(70 / 64)


@pytest.mark.parametrize(("flights", "length", "count"), [((9,) * 20 + (10,), 9, 22), ((50, 4, 3), 10, 5)])
def test_the_length_is_that_which_tells_most_in_all(flights, length, count):
    """One longer flight doesn't throw all others away, nor do scraps cut a long one into small pieces."""
    data = flown(sum(flights))
    data.trajectory[:] = torch.arange(len(flights)).repeat_interleave(torch.tensor(flights))
    assert cut(data, 10).action.shape[:2] == (count, length)


def test_a_gap_ends_a_stretch_and_short_flights_have_none():
    data = flown(30)
    cuts = cut(data.select(torch.tensor([i for i in range(30) if i != 12])), 10)
    dynamics = make_dynamics("cartpole")
    torch.testing.assert_close(dynamics(cuts.measured[:, :-1], cuts.action), cuts.measured[:, 1:])
    with pytest.raises(ValueError, match="flights of 1 transitions without a gap, expected 3"):
        cut(data.select(torch.arange(0, 30, 2)), 10)


def test_no_stretch_joins_two_flights():
    data = flown(260)  # 250 of one and 10 of another
    assert len(data.trajectory.unique()) == 2
    assert cut(data, 10).measured.shape[0] == 26


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_the_true_dynamics_miss_nothing_and_a_push_grows_with_the_square_of_time(name):
    cuts = cut(flown(40, name), 8)
    source, pushed = Dynamics(load_policy(name).task.system), make_dynamics(name, "push=0.1")
    start = cuts.measured[:, 0]
    assert cuts.missed(source.system, cuts.predicted(source, start)).abs().max() < 2e-4  # float32
    if name == "quadrotor":
        way = cuts.missed(source.system, cuts.predicted(pushed, start))[..., :3].norm(dim=-1).mean(0)
        dt = source.dt
        assert way[4] == pytest.approx(0.5 * 0.1 * (4 * dt) ** 2, rel=0.05)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_a_displacement_is_what_the_difference_finds(name):
    system = load_policy(name).task.system
    states = flown(5, name).state.double()
    count = difference(system, states, states).shape[-1]
    deltas = 0.1 * torch.randn(5, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(
        difference(system, states, displaced(system, states, deltas)), deltas, rtol=1e-5, atol=1e-6
    )
