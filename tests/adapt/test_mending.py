"""What went wrong with recorded transitions is found and mended, and what is right stays as it is."""

import pytest
import torch

from adapt.flying import collect
from adapt.mending import mended, still_true
from adapt.transitions import joined
from envs import make_dynamics
from envs.dynamics import Dynamics
from policies.checkpoints import load_policy


def flown(target, n=150, seed=0, name="quadrotor"):
    policy = load_policy(name)
    env = make_dynamics(name, target), policy.task, policy.task.episodes(20, "train", 9 + seed)
    return collect(policy.actor(), env, n, 0.1, torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def data():
    return flown("drag=0.3", 250)


def same(one, two):
    return all(torch.equal(getattr(one, part), getattr(two, part)) for part in ("state", "action", "next_state"))


def test_what_is_in_order_stays_as_it_is(data):
    found, notes = mended(data)
    assert notes == []
    assert same(found, data)
    assert torch.equal(found.trajectory, data.trajectory)


def test_shuffled_flights_are_put_in_order_and_repeated_rows_are_left_out(data):
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    found, notes = mended(data.select(torch.cat((order, order[:40]))))
    assert [note.split(" were")[0] for note in notes] == ["40 of 290 transitions", "transitions"]
    for flight in data.trajectory.unique():
        assert same(found.select(found.trajectory == flight), data.select(data.trajectory == flight))


def test_flights_come_in_the_order_in_which_they_were_recorded(data):
    rows = torch.arange(len(data)).flip(0)
    found, _ = mended(data.select(rows))
    assert found.trajectory.unique_consecutive().tolist() == data.trajectory.unique_consecutive().flip(0).tolist()


def test_a_flight_that_is_given_twice_counts_once(data):
    found, notes = mended(joined((data, data)))
    assert same(found, data)
    assert notes == ["250 of 500 transitions were repeated rows, and left out"]


@pytest.mark.parametrize("seed", range(3))
def test_flights_whose_rows_are_mixed_come_in_the_order_of_their_numbers(data, seed):
    found, _ = mended(data.select(torch.randperm(len(data), generator=torch.Generator().manual_seed(seed))))
    assert same(found, data)


@pytest.mark.parametrize("places", ["ABACDE", "AAABCD", "ABBBCB", "ABABAC"])
def test_rows_in_order_stay_so_where_a_robot_comes_to_the_same_place_again(data, places):
    """Each action is another one, so that no row is repeated."""
    rows = data.select(slice(0, len(places) - 1))
    states = {place: data.state[number] for number, place in enumerate("ABCDE")}
    visits = torch.stack([states[place] for place in places])
    rows.state[:], rows.next_state[:] = visits[:-1], visits[1:]
    found, notes = mended(rows)
    assert same(found, rows)
    assert notes == []


def test_a_flight_in_a_circle_is_kept_whole():
    data = flown("", 12)
    ring = torch.cat((data.state[1:], data.state[:1]))
    circle = data.select(slice(None))
    circle.next_state[:] = ring
    found, notes = mended(circle)
    assert len(found) == 12
    assert notes == []


@pytest.mark.parametrize("noise", ["", " noise=1"])
@pytest.mark.parametrize(("before", "left"), [("drag=0.3", 300), ("mass=x1.3", 150), ("push=1", 150)])
def test_flight_from_before_a_change_is_left_out(noise, before, left):
    both = joined((flown(before + noise, seed=1), flown("drag=0.3" + noise, seed=2)))
    kept = still_true(both, Dynamics(load_policy("quadrotor").task.system))
    assert len(kept) == left
    assert torch.equal(kept.state, both.state[-left:])


def test_a_change_late_in_the_record_is_found():
    both = joined((flown("mass=x1.3", 400, seed=1), flown("drag=0.3", 100, seed=2)))
    kept = still_true(both, Dynamics(load_policy("quadrotor").task.system))
    assert len(kept) == 62  # of the 100: the newest eighth
    assert torch.equal(kept.state, both.state[-62:])


def test_little_flight_is_kept_whatever_it_says(data):
    few = joined((flown("mass=x1.3", 50, 1), flown("drag=0.3", 50, 2)))
    assert still_true(few, Dynamics(load_policy("quadrotor").task.system)) is few
