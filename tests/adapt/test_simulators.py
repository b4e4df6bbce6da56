"""Third-party simulators as plants: each gives what physics says, in the names, axes and units of our systems."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from adapt.plants import make_plant
from envs import make_dynamics, make_system
from envs.rigid_body import quaternion_rates, to_world
from envs.vehicles import load_vehicle


def flown(plant, state, action, steps):
    """The states of a flight with one action."""
    states = [plant.reset(np.asarray(state, float))]
    states += [plant.step(None, np.asarray(action, float)) for _ in range(steps)]
    return np.array(states)


def at_rest(speed=(0.0, 0.0, 0.0), attitude=(1.0, 0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0)):
    return np.array((0.0, 0.0, 0.0, *attitude, *speed, *rates))


# --- MuJoCo -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cartpole():
    """A factory of plants: cart-poles of MuJoCo and of unusual size."""
    pytest.importorskip("mujoco", reason="comes with the extra `simulators`")
    from adapt.simulators.mujoco_cartpole import MujocoCartPole

    system = replace(make_system("cartpole"), cart_mass=0.7, pole_mass=0.2, pole_half_length=0.3)
    return lambda **friction: MujocoCartPole(system, **friction), system


def test_without_friction_mujoco_moves_as_our_equations_do(cartpole):
    make, system = cartpole
    plant = make(friction=0.0, damping=0.0, hinge=0.0)
    ours = make_dynamics(replace(system, track_friction=0.0, hinge_friction=0.0), substeps=20)
    state = plant.reset(np.array([0.1, 0.2, 0.3, -0.4]))
    expected = torch.tensor(state)
    for action in (0.5, -0.3, 0.0, 0.2):
        state = plant.step(None, np.array([action]))
        expected = ours(expected, torch.tensor([action], dtype=expected.dtype))
        assert state == pytest.approx(expected.numpy(), abs=2e-5)


def test_dry_friction_stops_a_cart_at_a_constant_rate(cartpole):
    """The pole hangs and is light: deceleration friction / mass, and no rate once it stands."""
    make, system = cartpole
    plant = make(friction=2.0, damping=0.0, hinge=0.0)
    light = type(plant)(replace(system, pole_mass=1e-4), friction=2.0, damping=0.0, hinge=0.0)
    speed = flown(light, [0.0, 1.0, math.pi, 0.0], [0.0], 12)[:, 1]
    assert speed[:6] == pytest.approx(1.0 - 2.0 / 0.7 * 0.05 * np.arange(6), abs=2e-3)
    assert abs(speed[-1]) < 1e-3


def test_viscous_friction_slows_a_cart_exponentially(cartpole):
    make, system = cartpole
    light = type(make())(replace(system, pole_mass=1e-4), friction=0.0, damping=3.0, hinge=0.0)
    speed = flown(light, [0.0, 1.0, math.pi, 0.0], [0.0], 8)[:, 1]
    assert speed == pytest.approx(np.exp(-3.0 / 0.7 * 0.05 * np.arange(9)), abs=2e-3)


def test_a_settable_plant_goes_on_from_the_state_it_is_given(cartpole):
    make, _ = cartpole
    there = flown(make(), [0.1, 0.2, 0.3, -0.4], [0.3], 3)
    plant = make()
    plant.reset(np.zeros(4))
    assert plant.settable
    assert plant.step(there[2], np.array([0.3])) == pytest.approx(there[3], abs=1e-9)


# --- RotorPy and drone-models -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hummingbird():
    pytest.importorskip("rotorpy", reason="comes with the extra `simulators`")
    from adapt.simulators.rotorpy_quadrotor import RotorpyQuadrotor

    return RotorpyQuadrotor


@pytest.fixture(scope="module")
def crazyflie():
    pytest.importorskip("adapt.simulators.drone_models_crazyflie", reason="needs the extra `simulators`")
    return make_plant("drone-models", load_vehicle("crazyflie").system)


@pytest.fixture(params=["rotorpy", "drone-models"])
def quadrotor(request):
    """A quadrotor in still air and its system."""
    if request.param == "rotorpy":
        system = make_system("quadrotor")
        return request.getfixturevalue("hummingbird")(system, wind=(0, 0, 0)), system
    return request.getfixturevalue("crazyflie"), load_vehicle("crazyflie").system


def test_a_quadrotor_at_trim_hovers(quadrotor):
    plant, system = quadrotor
    states = flown(plant, at_rest(), system.trim_action, 10)
    assert states == pytest.approx(np.tile(at_rest(), (11, 1)), abs=1e-6)


def test_a_turned_quadrotor_keeps_its_attitude_scalar_first(quadrotor):
    """Tilted by 0.3 rad to the right (about x), thrust for hover pushes towards -y by g sin 0.3, less drag."""
    plant, system = quadrotor
    tilted = at_rest(attitude=(math.cos(0.15), math.sin(0.15), 0.0, 0.0))
    states = flown(plant, tilted, system.trim_action, 2)
    assert states[:, 3:7] == pytest.approx(np.tile(tilted[3:7], (3, 1)), abs=1e-3)
    assert states[1, 8] == pytest.approx(-system.gravity * math.sin(0.3) * 0.1, rel=0.05)
    assert states[1, 7] == pytest.approx(0.0, abs=1e-6)


def test_body_rates_follow_their_commands(quadrotor):
    """Yaw by less: the rotors of the Hummingbird drag through the air as it turns, a torque that nothing integrates."""
    plant, system = quadrotor
    for axis in range(3):
        action = np.array(system.trim_action)
        action[1 + axis] = 0.4
        rates = flown(plant, at_rest(), action, 15)[-3:, 10:].mean(0)
        expected = np.zeros(3)
        expected[axis] = 0.4 * getattr(system, f"rate_limit_{'xyz'[axis]}")
        assert rates == pytest.approx(expected, abs=0.2 * expected.max()), axis


def test_the_attitude_turns_by_the_body_rates(quadrotor):
    plant, _ = quadrotor
    start = at_rest(attitude=(0.8, 0.2, -0.4, 0.4), rates=(0.1, -0.2, 0.3))
    states = flown(plant, start, (0.0, 0.3, -0.2, 0.5), 5)
    turning = np.array([[float(rate) for rate in quaternion_rates(state[3:7], state[10:])] for state in states])
    mean = (turning[1:] + turning[:-1]) / 2
    assert np.diff(states[:, 3:7], axis=0) / 0.1 == pytest.approx(mean, abs=0.03)


def test_thrust_climbs_by_what_is_commanded_beyond_the_weight(quadrotor):
    plant, system = quadrotor
    action = np.array(system.trim_action)
    action[0] += 0.1
    climb = flown(plant, at_rest(), action, 10)[:, 9]
    wanted = 0.1 * (system.thrust_max - system.thrust_min) / 2
    assert np.diff(climb).max() / system.dt == pytest.approx(wanted, rel=0.25)  # before drag has grown


def test_rotor_drag_of_the_hummingbird_grows_with_speed_as_published(hummingbird):
    """Four rotors at hover speed give k_d times speed each; the body adds c_D v^2."""
    plant = hummingbird(make_system("quadrotor"), wind=(0, 0, 0))
    rotors = plant.hover.sum()
    for speed in (0.5, 2.0):
        states = flown(plant, at_rest(speed=(speed, 0, 0)), make_system("quadrotor").trim_action, 1)
        force = 1.19e-4 * rotors * speed + 0.5e-2 * speed**2
        mean = -(states[1, 7] - speed) / 0.1
        rate = force / 0.5 / speed
        assert mean == pytest.approx(speed * (1 - math.exp(-rate * 0.1)) / 0.1, rel=0.03)


def test_wind_carries_a_hovering_hummingbird_along(hummingbird):
    plant = hummingbird(make_system("quadrotor"), wind=(0.0, 2.0, 0.0))
    assert flown(plant, at_rest(), make_system("quadrotor").trim_action, 5)[-1, 8] > 0.2
    drifting = flown(plant, at_rest(speed=(0, 2.0, 0)), make_system("quadrotor").trim_action, 5)
    assert drifting[:, 8] == pytest.approx(np.full(6, 2.0), abs=0.02), "air at rest around it"


def test_drag_of_the_crazyflie_is_the_one_fitted_on_real_flights(crazyflie):
    trim = load_vehicle("crazyflie").system.trim_action
    speed = flown(crazyflie, at_rest(speed=(1.0, 0, 0)), trim, 5)[:, 7]
    assert speed == pytest.approx(np.exp(-0.01471782 / 0.0319 * 0.1 * np.arange(6)), rel=0.01)


def test_led_rotors_of_the_crazyflie_follow_within_a_control_period(crazyflie):
    """With a lag of 0.02 s the mean of the first period is 1 - 0.2 (1 - e^-5) of what is wanted; alone it were 0.3."""
    system = load_vehicle("crazyflie").system
    for change in (0.1, -0.1):
        action = np.array(system.trim_action)
        action[0] += change
        climb = np.diff(flown(crazyflie, at_rest(), action, 3)[:, 9]) / system.dt
        wanted = change * (system.thrust_max - system.thrust_min) / 2
        assert climb[0] == pytest.approx(0.8 * wanted, rel=0.1)
        assert climb[-1] == pytest.approx(wanted, rel=0.1)


def test_a_motor_gives_no_more_than_its_published_most(crazyflie):
    """Four times 0.12 N on 31.9 g give 15.05 m/s^2, though 18.5 m/s^2 are asked for."""
    climb = np.diff(flown(crazyflie, at_rest(), (1.0, 0, 0, 0), 6)[:, 9]) / 0.1
    most = 0.48 / 0.0319 - 9.81
    assert 0.75 * most < climb.max() < most, "drag takes some"
    assert climb[0] < 0.5 * most, "a rotor at its limit can't be led"


@pytest.mark.parametrize("law", [(7.4, 0.0, 0.0, 2.4e-4), (5.0, 1e-4, 3.0, 1e-4)])
def test_led_rotors_approach_the_wanted_speed_with_the_lag_that_is_asked_for(law):
    from adapt.simulators.rate_control import lead

    wanted, speed, lag, dt = np.array((2.1e4, 1.7e4)), np.array((1.8e4, 1.9e4)), 0.05, 1e-4
    start = speed
    for _ in range(500):  # one lag, by the law itself
        command = lead(wanted, speed, np.array(law), lag)
        a, b = np.where(command > speed, np.array(law)[:2, None], np.array(law)[2:, None])
        speed = speed + dt * (a * (command - speed) + b * (command**2 - speed**2))
    assert (wanted - speed) / (wanted - start) == pytest.approx(math.exp(-1), rel=0.01)


def test_rotors_that_are_asked_to_stop_at_once_get_a_command_that_is_finite():
    from adapt.simulators.rate_control import lead

    law = np.array((7.4, 0.0, 0.0, 2.4e-4))
    assert lead(np.zeros(1), np.array([2e4]), law, 0.001) == pytest.approx(0.0, abs=1.0)


def test_angles_and_quaternions_are_the_same_attitude():
    from adapt.simulators.attitude import angles, quaternion

    for wanted in ((0.3, -0.4, 2.5), (-2.0, 1.2, -0.1), (0.0, 0.0, 0.0)):
        assert angles(*quaternion(*wanted)) == pytest.approx(wanted)
    assert quaternion(0.2, 0.0, 0.0) == pytest.approx((math.cos(0.1), math.sin(0.1), 0, 0))
    assert quaternion(0.0, 0.2, 0.0) == pytest.approx((math.cos(0.1), 0, math.sin(0.1), 0))
    assert quaternion(0.0, 0.0, 0.2) == pytest.approx((math.cos(0.1), 0, 0, math.sin(0.1)))
    yawed_then_pitched = to_world(quaternion(0.0, 0.2, math.pi / 2), (1.0, 0.0, 0.0))
    assert yawed_then_pitched == pytest.approx((0.0, math.cos(0.2), -math.sin(0.2)))
