"""A target that changes in mid-flight, as it is typed."""

import pytest
import torch

from adapt.online_targets import default_items, parse_schedule
from envs import make_dynamics, make_task
from envs.errors import InputError

TASK = make_task("quadrotor")


def next_state(dynamics):
    state = torch.zeros(1, 13)
    state[:, 3], state[:, 7] = 1.0, 2.0
    return dynamics(state, torch.full((1, 4), 0.1))


def test_what_has_begun_stays_and_what_comes_later_is_added():
    schedule = parse_schedule(["wind=3@40", "drag=0.3", "mass=x1.2@20"], 60, TASK)
    for time, target in (
        (0, "drag=0.3"),
        (19.95, "drag=0.3"),
        (20, "drag=0.3 mass=x1.2"),
        (59, "drag=0.3 mass=x1.2 wind=3"),
    ):
        assert torch.equal(next_state(schedule.at(time)), next_state(make_dynamics("quadrotor", target)))


def test_a_flight_without_a_target_at_the_start_begins_in_the_model():
    schedule = parse_schedule(["mass=x1.2@20"], 60, TASK)
    assert torch.equal(next_state(schedule.at(0)), next_state(make_dynamics("quadrotor")))
    assert [change.text for change in schedule.changes] == ["mass=x1.2"]


def test_changes_at_one_time_are_one_change():
    schedule = parse_schedule(["mass=x1.2@5", "wind=3@5.0"], 10, TASK)
    assert [(change.begins, change.text) for change in schedule.changes] == [(5.0, "mass=x1.2 wind=3")]


def test_a_wind_is_taken_back_by_its_opposite():
    schedule = parse_schedule(["wind=3@2", "wind=-3@4"], 10, TASK)
    assert torch.allclose(next_state(schedule.at(4)), next_state(make_dynamics("quadrotor")), atol=1e-6)


def test_without_targets_a_payload_comes_at_20_and_a_wind_at_40_of_60_seconds():
    assert default_items(60) == ("mass=x1.2@20", "wind=3@40")
    parse_schedule(default_items(7), 7, TASK)


@pytest.mark.parametrize(
    ("item", "said"),
    [
        ("mass=x1.2@soon", "'soon' is no time; expected seconds from 0 on, such as mass=x1.2@20"),
        ("mass=x1.2@-1", "'-1' is no time"),
        ("mass=x1.2@nan", "'nan' is no time"),
        ("mass=x1.2@inf", "'inf' is no time"),
        ("mass=x1.2@", "'' is no time"),
        ("mass=x1.2@60", "begins after the end of the flight; expected less than --seconds 60"),
        ("wings=2@20", "quadrotor has no 'wings'"),
        ("mass=x-1@20", "mass is -0.723"),
        ("mass@20", "expected NAME=VALUE"),
    ],
)
def test_what_makes_no_sense_is_said(item, said):
    with pytest.raises(InputError, match=r"^--target") as error:
        parse_schedule([item], 60, TASK)
    assert said in str(error.value)


def test_a_changed_picture_is_refused_where_the_policy_sees_the_state():
    with pytest.raises(InputError, match="changes the picture"):
        parse_schedule(["brightness=0.7@2"], 60, make_task("cartpole"))
