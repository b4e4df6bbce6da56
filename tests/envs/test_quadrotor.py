"""Flight mechanics of the quadrotor, for default and other parameters."""

import math
from dataclasses import replace

import pytest
import torch

from envs import Dynamics, InputError, make_dynamics, rigid_body
from envs.quadrotor import Quadrotor

HOVERING = torch.tensor([1.0, -2, 3, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)


@pytest.fixture(params=[None, 1, 2], ids=str)
def quadrotor(request, vary):
    """A quadrotor whose controller knows it, all thrust delivered."""
    if request.param is None:
        return Quadrotor()
    unknown = dict.fromkeys(f"controller_{name}" for name in ("mass", "inertia_x", "inertia_y", "inertia_z"))
    return replace(vary(Quadrotor(), request.param), thrust_loss=0.0, **unknown)


def trim(system):
    return torch.tensor(system.trim_action, dtype=torch.float64)


def hovers(system):
    state = HOVERING.clone()
    for _ in range(20):
        state = Dynamics(system)(state, trim(system))
    return torch.allclose(state, HOVERING, rtol=0, atol=1e-10)


def test_the_trim_action_hovers(quadrotor):
    assert hovers(quadrotor)
    assert trim(quadrotor)[1:].tolist() == [0, 0, 0]


OWN = (
    {"mass": 0.034},
    {"thrust_min": 0.0, "thrust_max": 30.0},
    {"gravity": 3.7},
    {"thrust_loss": 0.2},
    {"controller_mass": 0.6},
)


@pytest.mark.parametrize("change", OWN, ids=str)
def test_a_quadrotor_of_ones_own_hovers(change):
    assert hovers(replace(Quadrotor(), **change))


def test_the_default_trim_is_the_middle_of_the_thrust_range():
    assert trim(Quadrotor()).abs().max() < 1e-12


def test_without_thrust_it_falls_along_a_parabola(quadrotor, draw):
    falling = replace(quadrotor, thrust_min=0.0)
    state, action = draw(falling, 20)
    action[:, 0] = -1
    following, gravity, dt = (
        Dynamics(falling)(state, action),
        torch.tensor([0, 0, -falling.gravity], dtype=torch.float64),
        falling.dt,
    )
    torch.testing.assert_close(following[:, 7:10], state[:, 7:10] + dt * gravity)
    torch.testing.assert_close(following[:, :3], state[:, :3] + dt * state[:, 7:10] + dt**2 / 2 * gravity)


@pytest.mark.parametrize(("action", "limit"), [(-1.0, "thrust_min"), (1.0, "thrust_max")])
def test_the_ends_of_the_thrust_action_are_the_limits_and_push_along_the_body_z_axis(
    quadrotor, draw, derivative, action, limit
):
    state, actions = draw(quadrotor, 20)
    actions[:, 0] = action
    up = torch.stack(rigid_body.to_world(state[:, 3:7].unbind(-1), (0.0, 0.0, 1.0)), -1)
    expected = getattr(quadrotor, limit) * up - torch.tensor([0, 0, quadrotor.gravity], dtype=torch.float64)
    torch.testing.assert_close(derivative(quadrotor, state, actions)[:, 7:10], expected)


def test_a_turned_start_ends_turned(quadrotor, draw, turn):
    """No heading is special: a rotation about the vertical commutes with the dynamics."""
    state, action = draw(quadrotor, 20)
    dynamics, yaw = Dynamics(quadrotor), turn(1.1, (0, 0, 1))

    def turned(s):
        position = rigid_body.to_world(yaw, s[:, :3].unbind(-1))
        velocity = rigid_body.to_world(yaw, s[:, 7:10].unbind(-1))
        w, z = yaw[0], yaw[3]
        qw, qx, qy, qz = s[:, 3:7].unbind(-1)
        attitude = (w * qw - z * qz, w * qx - z * qy, w * qy + z * qx, w * qz + z * qw)
        return torch.cat((torch.stack((*position, *attitude, *velocity), -1), s[:, 10:]), -1)

    torch.testing.assert_close(dynamics(turned(state), action), turned(dynamics(state, action)))


def test_body_rates_of_the_nominal_robot_approach_the_command_exponentially(quadrotor, draw):
    state, action = draw(quadrotor, 20)
    gains = torch.tensor([quadrotor.rate_gain_x, quadrotor.rate_gain_y, quadrotor.rate_gain_z], dtype=torch.float64)
    limits = torch.tensor([quadrotor.rate_limit_x, quadrotor.rate_limit_y, quadrotor.rate_limit_z], dtype=torch.float64)
    wanted = limits * action[:, 1:]
    expected = wanted + (state[:, 10:] - wanted) * (-gains * quadrotor.dt).exp()
    following = Dynamics(quadrotor, substeps=40)(state, action)
    torch.testing.assert_close(following[:, 10:], expected, atol=1e-7, rtol=0)


def test_yaw_commanded_in_hover_turns_by_the_integral_of_the_rate(quadrotor):
    """Only the heading moves: its angle is rate t - rate (1 - exp(-K t)) / K."""
    action, state, n = trim(quadrotor), HOVERING, 10
    action[3] = 1.0
    for _ in range(n):
        state = Dynamics(quadrotor, substeps=20)(state, action)
    gain, rate, t = quadrotor.rate_gain_z, quadrotor.rate_limit_z, n * quadrotor.dt
    angle = rate * (t - (1 - math.exp(-gain * t)) / gain)
    expected = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)])
    torch.testing.assert_close(state[3:7], expected.double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(state[:3], HOVERING[:3])


@pytest.mark.parametrize("factor", [0.8, 1.2, 3.0])
def test_under_a_payload_the_hover_command_falls_short_by_the_ratio_of_masses(quadrotor, factor):
    loaded = make_dynamics(quadrotor, f"mass=x{factor}")
    velocity = loaded(HOVERING, trim(quadrotor))[7:10] / quadrotor.dt
    assert velocity.tolist() == pytest.approx([0, 0, quadrotor.gravity * (1 / factor - 1)])


def test_a_share_of_lost_thrust_is_missing_in_hover(quadrotor):
    velocity = make_dynamics(quadrotor, "thrust_loss=0.2")(HOVERING, trim(quadrotor))[7:10] / quadrotor.dt
    assert velocity.tolist() == pytest.approx([0, 0, -0.2 * quadrotor.gravity])


def test_the_airframe_answers_with_its_own_inertia_to_the_torque_of_its_controller(quadrotor, draw, derivative):
    """J w' = J0 K (w_des - w) + w x J0 w - w x J w, in vectors."""
    mistaken = replace(quadrotor, controller_inertia_x=0.05, controller_inertia_y=0.02, controller_inertia_z=0.03)
    state, action = draw(mistaken, 20)
    own = torch.tensor([mistaken.inertia_x, mistaken.inertia_y, mistaken.inertia_z], dtype=torch.float64)
    gains = torch.tensor([mistaken.rate_gain_x, mistaken.rate_gain_y, mistaken.rate_gain_z], dtype=torch.float64)
    limits = torch.tensor([mistaken.rate_limit_x, mistaken.rate_limit_y, mistaken.rate_limit_z], dtype=torch.float64)
    believed, w = torch.tensor([0.05, 0.02, 0.03], dtype=torch.float64), state[:, 10:]
    torque = believed * gains * (limits * action[:, 1:] - w) + torch.linalg.cross(w, believed * w)
    expected = (torque - torch.linalg.cross(w, own * w)) / own
    torch.testing.assert_close(derivative(mistaken, state, action)[:, 10:], expected)


def test_a_spin_without_torque_keeps_its_energy_and_its_angular_momentum_in_world_axes(quadrotor, draw):
    """A controller that believes in no inertia gives no torque."""
    idle = dict.fromkeys(("controller_inertia_x", "controller_inertia_y", "controller_inertia_z"), 1e-15)
    spinning = replace(quadrotor, inertia_y=2 * quadrotor.inertia_x, **idle)
    inertia = torch.tensor([spinning.inertia_x, spinning.inertia_y, spinning.inertia_z], dtype=torch.float64)

    def conserved(s):
        momentum = rigid_body.to_world(s[:, 3:7].unbind(-1), (inertia * s[:, 10:]).unbind(-1))
        return torch.stack((*momentum, (inertia * s[:, 10:] ** 2).sum(-1) / 2), -1)

    state, action = draw(spinning, 10)
    state[:, 10:] *= 4
    before, rates = conserved(state), state[:, 10:]
    for _ in range(10):
        state = Dynamics(spinning, substeps=20)(state, action)
    torch.testing.assert_close(conserved(state), before, atol=1e-7, rtol=1e-6)
    assert (state[:, 10:] - rates).abs().max() > 0.1  # it tumbles


def test_fixed_beliefs_do_not_follow_a_changed_airframe(quadrotor):
    changed = replace(quadrotor.configured(), mass=1.0, inertia_x=1.0, inertia_y=2.0, inertia_z=3.0)
    assert changed.believed == quadrotor.believed
    assert replace(quadrotor, mass=1.0, inertia_y=2.0).believed[0] == 1.0


def test_configured_changes_nothing_about_the_flight(quadrotor, draw):
    state, action = draw(quadrotor, 5)
    torch.testing.assert_close(Dynamics(quadrotor.configured())(state, action), Dynamics(quadrotor)(state, action))


def test_thrust_limits_in_the_wrong_order_are_refused():
    with pytest.raises(InputError, match=r"thrust_min 20 is not below thrust_max 17\.31"):
        replace(Quadrotor(), thrust_min=20.0)


def test_a_residual_acts_along_the_body_axes(quadrotor, draw, scalars):
    state, _ = draw(quadrotor, 10)
    x = scalars(quadrotor, state)
    rates = quadrotor.residual_rates(x, (0.0, 0.0, 2.0, 0.1, 0.2, 0.3))
    up = rigid_body.axis_z(state[:, 3:7].unbind(-1))
    force = torch.stack([rates[name] for name in ("vx", "vy", "vz")], -1)
    torch.testing.assert_close(force, 2 * torch.stack(up, -1))
    assert [rates[name] for name in "pqr"] == [0.1, 0.2, 0.3]
