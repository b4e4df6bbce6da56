"""The newest transitions, and where the target changed."""

from functools import cache

import pytest
import torch

from adapt.online_flight import ContinuousFlight
from adapt.online_targets import parse_schedule
from adapt.online_window import Window, change_point, likelihood
from envs import make_dynamics, make_system
from policies.checkpoints import load_policy


@cache
def policy():
    return load_policy("quadrotor", make_system("quadrotor"), "apg")


def window_of(items, seconds, flown=6.0):
    """What a window of so many seconds holds after a flight."""
    flight = ContinuousFlight(policy().task, parse_schedule(items, 1e3, policy().task), round(flown / 0.1))
    window, actor = Window(policy().task.system, seconds), policy().actor()
    while not flight.over:
        time = flight.time
        window.add(time, flight.advance(actor))
    return window


def test_the_window_holds_the_newest_seconds():
    window = window_of([], 2.0)
    assert len(window) == 20
    assert [row[0] for row in window.rows[:: len(window) - 1]] == pytest.approx([4.0, 5.9])
    transitions = window.transitions()
    assert torch.equal(transitions.next_state[:-1], transitions.state[1:])


def test_what_was_lost_is_left_out():
    window = Window(make_system("quadrotor"), 1.0)
    window.add(0.0, None)
    assert len(window) == 0


@pytest.mark.parametrize("noise", [[], ["noise=1"]])
def test_a_payload_is_noticed_and_what_is_older_is_forgotten(noise):
    window = window_of(["mass=x1.2@5", *noise], 4.0)
    assert window.forget(make_dynamics("quadrotor")) == pytest.approx(5.0, abs=0.11 if noise else 1e-6)
    assert len(window) == pytest.approx(10, abs=1)
    assert window.forget(make_dynamics("quadrotor")) is None


@pytest.mark.parametrize("noise", [[], ["noise=1"]])
def test_nothing_is_forgotten_where_nothing_changed(noise):
    for items in ([], ["mass=x1.2"]):
        window = window_of([*items, *noise], 4.0)
        assert window.forget(make_dynamics("quadrotor")) is None
        assert len(window) == 40


def test_too_few_new_transitions_tell_of_no_change_yet():
    assert window_of(["mass=x1.2@5.7"], 4.0).forget(make_dynamics("quadrotor")) is None


def test_errors_that_become_smaller_are_no_change():
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn(40, 3, generator=generator)
    errors[20:] *= 0.1
    assert change_point(errors) is None
    assert change_point(errors.flip(0)) == 20


def test_white_errors_hardly_ever_pass_for_a_change():
    generator = torch.Generator().manual_seed(0)
    assert sum(change_point(torch.randn(40, 6, generator=generator)) is not None for _ in range(200)) <= 4


def test_the_dynamics_that_were_flown_are_the_likeliest():
    transitions = window_of(["mass=x1.2", "noise=1"], 4.0).transitions()
    said = {text: likelihood(make_dynamics("quadrotor", text), transitions) for text in ("mass=x1.2", "", "mass=x1.4")}
    assert max(said, key=said.get) == "mass=x1.2"
