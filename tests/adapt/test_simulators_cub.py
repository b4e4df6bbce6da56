"""JSBSim's Cub as a plant: it moves as its velocities say, as our linear vehicle nearly does, and by its controls."""

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


@pytest.fixture(scope="module")
def cub():
    """In still air."""
    pytest.importorskip("jsbsim", reason="comes with the extra `simulators`")
    from adapt.simulators.jsbsim_aircraft import JsbsimAircraft

    return JsbsimAircraft(load_vehicle("j3cub").system, wind=(0, 0, 0))


CRUISE = np.array((0.0, 0, 0, 1, 0, 0, 0, 11.5, 0, 0, 0, 0, 0))


def test_the_cub_starts_where_it_is_told_to(cub):
    attitude = np.array((0.9, 0.1, -0.2, 0.3))
    attitude /= np.linalg.norm(attitude)
    state = np.array((3.0, -4.0, 5.0, *attitude, 11.0, 0.5, 0.7, 0.1, -0.2, 0.3))
    assert cub.reset(state) == pytest.approx(state, abs=2e-3)
    assert cub.reset(CRUISE) == pytest.approx(CRUISE, abs=2e-3)


def test_the_vehicle_is_the_cub_at_its_scale(cub):
    system = load_vehicle("j3cub").system
    assert cub.scale == pytest.approx(7.5, rel=1e-4)
    lengths = {"metrics/bw-ft": system.span, "metrics/cbarw-ft": system.chord}
    for name, ours in lengths.items():
        assert cub.fdm[name] * 0.3048 / 7.5 == pytest.approx(ours, rel=1e-3)
    assert cub.fdm["metrics/Sw-sqft"] * 0.3048**2 / 7.5**2 == pytest.approx(system.wing_area, rel=1e-3)
    for axes, ours in zip(("xx", "yy", "zz"), (system.inertia_x, system.inertia_y, system.inertia_z), strict=True):
        theirs = cub.fdm[f"inertia/i{axes}-slugs_ft2"] * 14.5939 * 0.3048**2
        assert theirs / 7.5**5 == pytest.approx(ours, rel=1e-3)


@pytest.mark.parametrize("action", [(0, 0, 0, 0), (0, 0.3, 0, 0), (0, -0.3, 0, 0), (0, 0, 0.5, 0), (0, 0, 0, 0.5)])
def test_the_linear_vehicle_moves_nearly_as_the_cub_does(cub, action):
    """After 0.2 s: body rates within 0.13 rad/s, velocities within 0.1 m/s."""
    ours, state = make_dynamics(load_vehicle("j3cub").system), torch.tensor(CRUISE)
    for _ in range(4):
        state = ours(state, torch.tensor(action, dtype=torch.double))
    theirs = flown(cub, CRUISE, action, 4)[-1]
    assert theirs[10:] == pytest.approx(state[10:].numpy(), abs=0.13)
    assert theirs[7:10] == pytest.approx(state[7:10].numpy(), abs=0.1)


def test_the_engine_of_the_cub_runs_steadily_from_the_start(cub):
    cub.reset(CRUISE)
    begun = cub.fdm["propulsion/engine/propeller-rpm"]
    for _ in range(4):
        cub.step(None, np.zeros(4))
    assert cub.fdm["propulsion/engine/propeller-rpm"] == pytest.approx(begun, rel=0.01)


def test_the_surfaces_of_the_cub_go_as_far_as_the_vehicle_says(cub):
    system = load_vehicle("j3cub").system
    flown(cub, CRUISE, (0.0, 1.0, -1.0, 1.0), 1)
    moved = [cub.fdm[f"fcs/{name}-pos-rad"] for name in ("elevator", "left-aileron", "rudder")]
    assert moved == pytest.approx([system.elevator_limit, -system.aileron_limit, system.rudder_limit], rel=1e-3)


def test_a_vehicle_whose_ailerons_are_counted_the_other_way_rolls_its_own_way(cub):
    other = make_plant("jsbsim", make_system("fixed_wing"))  # its aileron rolls to the left
    right, left = (flown(plant, CRUISE, (0.0, 0.0, 0.5, 0.0), 3)[-1, 10] for plant in (cub, other))
    assert left < -0.1 < 0.1 < right


def test_the_cub_moves_as_fast_as_its_velocity_says(cub):
    """Positions are the integral of the velocity in world axes: scale and axes agree."""
    states = flown(cub, CRUISE, (0.0, 0.1, 0.4, 0.0), 20)
    velocity = np.array([to_world(state[3:7], state[7:10]) for state in states])
    mean = (velocity[1:] + velocity[:-1]) / 2
    assert np.diff(states[:, :3], axis=0) / 0.05 == pytest.approx(mean, abs=0.03)


def test_the_attitude_of_the_cub_turns_by_its_body_rates(cub):
    """JSBSim's heading runs from 0 to 360 degrees, so that the quaternion may begin with the other sign."""
    states = flown(cub, CRUISE, (0.0, 0.3, 0.6, 0.3), 10)
    states[:, 3:7] *= np.sign(states[:, 3:4])
    turning = np.array([[float(rate) for rate in quaternion_rates(state[3:7], state[10:])] for state in states])
    mean = (turning[1:] + turning[:-1]) / 2
    assert np.diff(states[:, 3:7], axis=0) / 0.05 == pytest.approx(mean, abs=0.02)


def test_the_cub_answers_its_controls_with_the_signs_of_the_model(cub):
    """Elevator down pitches down, and so on: the same sign as our equations a tenth of a second later."""
    ours = make_dynamics(load_vehicle("j3cub").system)
    neutral = flown(cub, CRUISE, (0.0, 0, 0, 0), 2)[-1]
    for control, rate in ((1, 11), (2, 10), (3, 12)):
        action = np.zeros(4)
        action[control] = 0.5
        moved = flown(cub, CRUISE, action, 2)[-1] - neutral
        expected = torch.tensor(CRUISE)
        still = torch.tensor(CRUISE)
        for _ in range(2):
            expected, still = ours(expected, torch.tensor(action)), ours(still, torch.zeros(4, dtype=torch.double))
        assert np.sign(moved[rate]) == np.sign(float((expected - still)[rate])), control
        assert abs(moved[rate]) > 0.02


def test_the_cub_is_symmetric(cub):
    """What an aileron does to the left, it does to the right, but for the propeller."""
    left, right = (flown(cub, CRUISE, (-1.0, 0.0, sign * 0.5, 0.0), 6)[-1] for sign in (-1, 1))
    assert left[10] == pytest.approx(-right[10], rel=0.15)
    assert left[7] == pytest.approx(right[7], rel=0.01)


def test_the_same_flight_twice_is_the_same(cub):
    first, second = (flown(cub, CRUISE, (0.2, 0.1, 0.1, 0.0), 20) for _ in range(2))
    assert first == pytest.approx(second, abs=2e-3)


def test_a_glide_loses_energy_and_full_throttle_is_faster_than_none(cub):
    states = flown(cub, CRUISE, (-1.0, -0.2, 0, 0), 60)
    energy = (states[:, 7:10] ** 2).sum(-1) / 2 - 9.81 * states[:, 2]
    assert energy[-1] < energy[20] < energy[5]
    powered = flown(cub, CRUISE, (1.0, -0.2, 0, 0), 60)
    assert (powered[-1, 7:10] ** 2).sum() / 2 - 9.81 * powered[-1, 2] > energy[-1] + 5


def test_the_wind_around_the_cub_is_that_of_the_model(cub):
    """With the air at rest around it, it flies as in still air, carried along; a crosswind turns it as ours."""
    system = load_vehicle("j3cub").system
    windy = type(cub)(system, wind=(2.0, 0.0, 0.0))
    carried = CRUISE + np.array((0, 0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 0))
    still, moved = flown(cub, CRUISE, (0, 0, 0, 0), 5)[-1], flown(windy, carried, (0, 0, 0, 0), 5)[-1]
    assert moved[0] - still[0] == pytest.approx(0.25 * 2.0, abs=0.01)
    assert moved[2] == pytest.approx(still[2], abs=0.01)
    ours, state = make_dynamics(system, "crosswind=1"), torch.tensor(CRUISE)
    for _ in range(10):
        state = ours(state, torch.zeros(4, dtype=torch.double))
    yawed = flown(type(cub)(system, wind=(0.0, 1.0, 0.0)), CRUISE, (0, 0, 0, 0), 10)[-1]
    assert yawed[8] == pytest.approx(float(state[8]), abs=0.1)
    assert yawed[8] > 0.3
