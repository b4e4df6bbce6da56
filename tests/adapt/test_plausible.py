"""A record in wrong units or axes is refused, by what it says itself; a right one never."""

from dataclasses import replace

import pytest
import torch

from adapt.adaptation import fly
from adapt.plausible import check_units
from envs import SYSTEMS, make_dynamics
from envs.errors import InputError
from policies.checkpoints import load_policy


def flown(name, target="drag=0.3", n=100):
    policy = load_policy(name)
    return fly(policy, make_dynamics(name, target), policy.task, n, 0.1, 0)[0], policy.task.system


def scaled(data, names, factor):
    """The record with some states in another unit."""
    factors = torch.tensor([factor if name in names else 1.0 for name in data.state_names])
    return replace(data, state=data.state * factors, next_state=data.next_state * factors)


@pytest.mark.parametrize("target", ["drag=0.3", "drag=0.3 mass=x1.3 noise=1.5", "push=0.5"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_flight_of_a_changed_robot_through_sensors_is_in_our_units(name, target):
    assert check_units(*flown(name, target)) == []


def test_a_hover_that_is_all_noise_is_in_our_units():
    """Nothing moves but what the sensors say, by velocities that it never had."""
    data, system = flown("quadrotor", "noise=1.5")
    still = system.State(0.0, 0.0, 0.0, 1.0, *[0.0] * 9)
    generator = torch.Generator().manual_seed(0)

    def seen():
        error = torch.randn(100, 13, generator=generator) * torch.tensor([0.002] * 3 + [0] * 4 + [0.03] * 3 + [0.1] * 3)
        return torch.tensor(still) + error

    check_units(replace(data, state=seen(), next_state=seen()), system)


@pytest.mark.parametrize(
    ("names", "factor", "words"),
    [
        (("px", "py", "pz"), 1000.0, "position changes .* times as fast as velocity says"),
        (("vx", "vy", "vz"), 1000.0, "position changes 0.00[0-9]* times as fast as velocity says"),
        (("p", "q", "r"), 57.3, "attitude changes 0.0[0-9]* times as fast as body rates say"),
        (("vx", "vy", "vz"), -1.0, "position changes the other way than velocity says"),
    ],
)
def test_states_in_another_unit_or_axes_are_refused(names, factor, words):
    data, system = flown("quadrotor", "noise=1")
    with pytest.raises(InputError, match=words):
        check_units(scaled(data, names, factor), system)


@pytest.mark.parametrize("names", [("p", "q", "r"), ("qx", "qy", "qz")])
def test_an_attitude_that_turns_the_other_way_is_told(names):
    data, system = flown("quadrotor", "noise=1")
    (note,) = check_units(scaled(data, names, -1.0), system)
    assert note.startswith("attitude changes the other way than body rates say: wrong signs, axes or columns")


def test_a_robot_that_shakes_is_in_our_units():
    """Its controller believes in twice its inertia: it turns to and fro in each control period."""
    assert len(check_units(*flown("quadrotor", "inertia=x0.54", 300))) <= 1


def test_commands_in_another_unit_are_refused_and_single_ones_are_told():
    data, system = flown("quadrotor")
    with pytest.raises(InputError, match=r"have actions beyond \[-1, 1\], the farthest .* in another unit"):
        check_units(replace(data, action=data.action + 3), system)
    action = data.action.clone()
    action[7, 2] = -7
    assert check_units(replace(data, action=action), system) == [
        "1 of 100 have actions beyond [-1, 1], the farthest q_des -7; they are kept as they are"
    ]
