"""One robot that flies on and on."""

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from adapt.online_flight import ContinuousFlight
from adapt.online_targets import parse_schedule
from envs import make_dynamics, make_system, make_task
from policies import apg
from policies.checkpoints import Policy, load_policy

WING = make_system("fixed_wing")
NAMES = (list(WING.State._fields), [f"action_{name}" for name in WING.Action._fields])


def flown(policy, items=(), periods=30, actor=None, **settings):
    flight = ContinuousFlight(policy.task, parse_schedule(items, 1e3, policy.task), periods, **settings)
    actor, rows = actor or policy.actor(), []
    while not flight.over:
        rows.append(flight.advance(actor))
    return flight, rows


def constant(value):
    """A policy that always gives the same action."""
    return TensorDictModule(lambda o: torch.full((len(o), 4), value), ["observation"], ["action"])


def test_the_clock_runs_without_a_break_and_every_period_has_its_error(rough_quadrotor):
    table = flown(rough_quadrotor)[0].table()
    assert np.allclose(table.time, 0.1 * np.arange(30))
    assert list(table.columns[:3]) == ["time", "leg", "px"]
    assert table.error.notna().all()
    assert table.error[0] == pytest.approx(0, abs=1e-5), "it starts on the reference"


def test_the_error_is_the_distance_to_the_reference_at_that_time(rough_quadrotor):
    flight, _ = flown(rough_quadrotor)
    table = flight.table()
    where = torch.tensor(table[["px", "py", "pz"]].to_numpy())
    assert np.allclose((where - flight.episode[0, :30, :3]).norm(dim=-1), table.error, atol=1e-5)


def test_a_path_is_as_long_as_the_flight(rough_quadrotor):
    flight, _ = flown(rough_quadrotor, periods=150)
    assert flight.table().leg.unique().tolist() == [0]
    assert rough_quadrotor.task.steps == 100


def test_the_same_seed_is_the_same_flight_and_another_seed_another(rough_quadrotor):
    one, same, other = (flown(rough_quadrotor, seed=s, exploration=0.1)[0].table() for s in (0, 0, 1))
    assert one.equals(same)
    assert not np.allclose(one.px, other.px)


def test_a_change_acts_from_its_time_on(rough_quadrotor):
    with_push, without = (flown(rough_quadrotor, items)[0].table() for items in (["push=2@1.5"], []))
    assert with_push[:16].equals(without[:16])  # the row of 1.5 s tells the state that the push begins with
    assert with_push.vx[16] - without.vx[16] == pytest.approx(0.2, abs=0.01)


def test_exploration_moves_the_action_and_is_the_same_in_whatever_is_flown(rough_quadrotor):
    quiet, noisy, other = (
        flown(rough_quadrotor, exploration=deviation, actor=constant(value))[0].table()
        for deviation, value in ((0.0, 0.1), (0.05, 0.1), (0.05, 0.2))
    )
    assert (quiet.action_thrust == quiet.action_thrust[0]).all()
    assert noisy.action_thrust.std() == pytest.approx(0.05, rel=0.4)
    assert np.allclose(noisy.action_thrust - 0.1, other.action_thrust - 0.2, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 7, 2**63 - 1])
def test_exploration_and_sensors_draw_different_numbers(rough_quadrotor, seed):
    flight = ContinuousFlight(rough_quadrotor.task, parse_schedule([], 1e3, rough_quadrotor.task), 1, seed=seed)
    one, other = (torch.randn(20, generator=generator) for generator in (flight.noise, flight.sensors))
    assert not torch.isclose(one, other).any()


def test_transitions_are_what_was_measured_and_the_table_what_was_true(rough_quadrotor):
    flight, rows = flown(rough_quadrotor, ["noise=1"], periods=10)
    state, action, following, leg = rows[3]
    assert torch.equal(following, rows[4][0])
    assert (state.numpy()[7] - flight.table().vx[3]) != 0
    assert torch.allclose(state[:3], torch.tensor(flight.table().loc[3, ["px", "py", "pz"]].tolist()), atol=0.01)
    assert action.shape == (4,) and leg == 0


def test_a_lost_robot_is_put_on_the_next_reference(rough_quadrotor):
    flight, rows = flown(rough_quadrotor, actor=constant(-1.0))
    table = flight.table()
    assert flight.losses == table.leg.max() > 0
    assert sum(row is None for row in rows) == flight.losses, "what was lost is no data"
    assert (table.groupby("leg").error.first() < 1e-5).all()
    assert [leg["success"] for leg in flight.legs[:-1]] == [False] * flight.losses


def test_where_a_reference_ends_the_robot_is_put_on_the_next(rough_quadrotor, monkeypatch):
    monkeypatch.setattr("adapt.online_flight.LONGEST", 1.0)
    flight, rows = flown(rough_quadrotor, periods=25)
    assert flight.table().leg.tolist() == [0] * 10 + [1] * 10 + [2] * 5
    assert flight.losses == 0 and [row[3] for row in rows] == flight.table().leg.tolist()


def test_an_aircraft_that_arrives_flies_on_to_the_next_point_from_where_it_is():
    policy = load_policy("fixed_wing", make_system("fixed_wing"), "apg")
    flight, _ = flown(policy, periods=200)
    table = flight.table()
    assert table.leg.max() == 2 and flight.losses == 0
    first = table.index[table.leg == 1][0]
    state, action = (torch.tensor(table.loc[first - 1][names].to_numpy(float)).float()[None] for names in NAMES)
    onward = make_dynamics("fixed_wing")(state, action)[0]
    assert onward[0] >= 50, "it has passed the point"
    onward[:3] = 0
    assert np.allclose(table.loc[first][NAMES[0]].to_numpy(float), onward, atol=1e-5)
    assert all(leg["success"] and leg["error"] < 0.1 for leg in flight.legs[:2])


def test_a_recurrent_policy_keeps_its_memory():
    task = make_task("quadrotor")
    config = apg.APGConfig(updates=1, batch=4, episodes=4, width=8, mode="recurrent")
    run = apg.begin(make_dynamics("quadrotor"), task, apg.training_banks(task, config, 0), config, 0)
    policy, remembered = Policy(run.network, task, {}), []
    flight = ContinuousFlight(task, parse_schedule([], 1e3, task), 5)
    while not flight.over:
        flight.advance(policy.actor())
        remembered.append(flight.memory["hidden"])
    assert all(memory.abs().max() > 0 for memory in remembered)
    assert not torch.equal(remembered[0], remembered[1])
