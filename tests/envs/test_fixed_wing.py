"""Flight mechanics of the fixed wing, for default and other parameters."""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd.functional import jacobian, jvp

from envs import Dynamics, make_dynamics, rigid_body
from envs.errors import InputError
from envs.fixed_wing import CRUISE, FixedWing, limited
from policies.compiled_dynamics import CompiledDynamics

# In a mirror y, roll, yaw, v_b, p and r change sign, and so do aileron and rudder.
MIRROR = torch.tensor([1.0, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1], dtype=torch.float64)
MIRROR_ACTION = torch.tensor([1.0, 1, -1, -1], dtype=torch.float64)


@pytest.fixture(params=[None, 1, 2], ids=str)
def fixed_wing(request, vary):
    """A fixed wing in still air."""
    system = FixedWing() if request.param is None else vary(FixedWing(), request.param)
    return replace(system, wind=0.0, crosswind=0.0, downdraught=0.0)


def level(pitch, speed=CRUISE):
    """State of level flight with a pitch angle."""
    zero, half = torch.zeros_like(pitch), pitch / 2
    attitude = (half.cos(), zero, half.sin(), zero)
    return torch.stack((zero, zero, zero, *attitude, speed * pitch.cos(), zero, speed * pitch.sin(), zero, zero, zero))


def solve_trim(system, derivative):
    """State and action of straight and level flight at cruise: Newton's method on pitch, thrust and elevator."""

    def flight(unknown):
        pitch, thrust, elevator = unknown.unbind()
        return level(pitch), torch.stack((thrust, elevator, 0 * pitch, 0 * pitch))

    def unbalanced(unknown):
        rates = derivative(system, *flight(unknown))
        return torch.stack((rates[7], rates[9], rates[11]))

    unknown = torch.zeros(3, dtype=torch.float64)
    for _ in range(30):
        unknown = unknown - torch.linalg.solve(jacobian(unbalanced, unknown), unbalanced(unknown))
    return flight(unknown)


def test_straight_and_level_flight_at_trim_stays_so(fixed_wing, derivative):
    start, action = solve_trim(fixed_wing, derivative)
    state = start
    for _ in range(20):
        state = Dynamics(fixed_wing)(state, action)
    start[0] += 20 * fixed_wing.dt * CRUISE
    torch.testing.assert_close(state, start, atol=1e-9, rtol=0)


def test_the_default_aircraft_trims_well_inside_its_limits(derivative):
    state, action = solve_trim(FixedWing(), derivative)
    assert action.abs().max() < 0.8
    assert 2 * math.degrees(math.asin(state[5].item())) == pytest.approx(1, abs=5)


def test_air_and_propeller_act_as_in_beard_and_mclain(fixed_wing, draw, scalars):
    """Force and torque from the matrices of coefficients, airspeed angles by atan and asin."""
    state, action = draw(fixed_wing, 30)
    action[:, 0] = -1
    wide = replace(fixed_wing, incidence_limit=1.5)
    velocity, (p, q, r) = state[:, 7:10], state[:, 10:].unbind(-1)
    airspeed = velocity.norm(dim=-1)
    alpha, beta = torch.atan2(velocity[:, 2], velocity[:, 0]), torch.asin(velocity[:, 1] / airspeed)
    pitch_rate = wide.chord * q / (2 * airspeed)
    roll_rate, yaw_rate = wide.span * p / (2 * airspeed), wide.span * r / (2 * airspeed)
    limits = torch.tensor([wide.elevator_limit, wide.aileron_limit, wide.rudder_limit], dtype=torch.float64)
    elevator, aileron, rudder = (limits * action[:, 1:]).unbind(-1)
    long = torch.stack((torch.ones_like(alpha), alpha, pitch_rate, elevator), -1)
    lat = torch.stack((beta, roll_rate, yaw_rate, aileron, rudder), -1)
    pressure = (wide.air_density / 2 * airspeed**2 * wide.wing_area).unsqueeze(-1)
    lift, drag, pitch = (
        pressure * (long @ torch.tensor((wide.lift, wide.drag, wide.pitch), dtype=torch.float64).T)
    ).unbind(-1)
    side, roll, yaw = (pressure * (lat @ torch.tensor((wide.side, wide.roll, wide.yaw), dtype=torch.float64).T)).unbind(
        -1
    )
    force, torque = wide.wrench(*scalars(wide, state, action))
    expected = (
        -drag * alpha.cos() + lift * alpha.sin(), side, -drag * alpha.sin() - lift * alpha.cos(),
        wide.span * roll, wide.chord * pitch, wide.span * yaw,
    )  # fmt: skip
    torch.testing.assert_close(torch.stack((*force, *torque)), torch.stack(expected), atol=1e-4, rtol=1e-4)


def energy(system, state):
    """Kinetic energy of motion and rotation and potential energy [J]; z points down."""
    p, q, r = state[..., 10:].unbind(-1)
    spin = (
        system.inertia_x * p * p + system.inertia_y * q * q + system.inertia_z * r * r - 2 * system.inertia_xz * p * r
    )
    speed = state[..., 7:10].square().sum(-1)
    return (system.mass * speed + spin) / 2 - system.mass * system.gravity * state[..., 2]


def test_the_energy_changes_by_the_power_of_air_and_propeller(fixed_wing, draw, derivative, scalars):
    state, action = draw(fixed_wing, 30)
    _, power = jvp(lambda s: energy(fixed_wing, s), (state,), (derivative(fixed_wing, state, action),))
    force, torque = fixed_wing.wrench(*scalars(fixed_wing, state, action))
    expected = (torch.stack((*force, *torque), -1) * state[:, 7:]).sum(-1)
    torch.testing.assert_close(power, expected)


def test_a_straight_glide_loses_energy_by_drag_alone(fixed_wing, draw, derivative):
    """Lift does no work: dE/dt = -D V with D from dynamic pressure, area and the drag coefficient."""
    state, action = draw(fixed_wing, 30)
    state[:, 8], state[:, 10:], action[:, 0] = 0, 0, -1
    speed = state[:, 7:10].norm(dim=-1)
    alpha = limited(torch.atan2(state[:, 9], state[:, 7]), fixed_wing.incidence_limit)
    zero, slope, _, elevator = fixed_wing.drag
    coefficient = zero + slope * alpha + elevator * fixed_wing.elevator_limit * action[:, 1]
    drag = fixed_wing.air_density / 2 * speed**2 * fixed_wing.wing_area * coefficient
    _, power = jvp(lambda s: energy(fixed_wing, s), (state,), (derivative(fixed_wing, state, action),))
    torch.testing.assert_close(power, -drag * speed)
    assert (power < 0).all()


def test_in_a_vacuum_it_is_a_free_rigid_body(fixed_wing, draw):
    """Energy and angular momentum in world axes stay, the latter with the product of inertia."""
    system = replace(fixed_wing, air_density=0.0)
    ix, iy, iz, ixz = system.inertia_x, system.inertia_y, system.inertia_z, system.inertia_xz
    inertia = torch.tensor([[ix, 0, -ixz], [0, iy, 0], [-ixz, 0, iz]], dtype=torch.float64)

    def momentum(s):
        return torch.stack(rigid_body.to_world(s[:, 3:7].unbind(-1), (s[:, 10:] @ inertia).unbind(-1)), -1)

    state, action = draw(system, 10)
    state[:, 10:] *= 4
    action[:, 0] = -1
    energy_before, momentum_before = energy(system, state), momentum(state)
    for _ in range(10):
        state = Dynamics(system, substeps=20)(state, action)
    torch.testing.assert_close(energy(system, state), energy_before, atol=1e-5, rtol=1e-7)
    torch.testing.assert_close(momentum(state), momentum_before, atol=1e-6, rtol=1e-6)


def standing_air(system):
    """A fixed wing that flies level with a tail wind as fast as itself, which turns: state, action (3, ...)."""
    state = level(torch.zeros(3, dtype=torch.float64)).T.contiguous()
    state[:, 10:] = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [0.0, 1.0, 0.0]])
    return replace(system, wind=CRUISE), state, torch.zeros(3, 4, dtype=torch.float64)


def test_air_that_stands_still_about_the_aircraft_does_not_push_it(fixed_wing, scalars):
    system, state, action = standing_air(fixed_wing)
    action[:, 0] = -1
    force, torque = system.wrench(*scalars(system, state, action))
    assert max(float(part.abs().max()) for part in (*force, *torque)) < 1e-4


@pytest.mark.parametrize("compiled", [False, True])
def test_the_derivatives_are_finite_where_the_air_stands_still(fixed_wing, compiled):
    system, state, action = standing_air(fixed_wing)
    exact = Dynamics(system)
    dynamics = CompiledDynamics(exact) if compiled else exact
    state.requires_grad_()
    action.requires_grad_()
    following = dynamics(state, action)
    slopes = torch.autograd.grad(following.square().sum(), (state, action))
    assert all(part.isfinite().all() for part in (following, *slopes))
    torch.testing.assert_close(following, exact(state, action), rtol=1e-9, atol=1e-11)
    wanted = torch.autograd.grad(exact(state, action).square().sum(), (state, action))
    torch.testing.assert_close(slopes, wanted, rtol=1e-7, atol=1e-9)


def test_what_keeps_standing_air_finite_changes_no_flight(fixed_wing, draw, scalars, monkeypatch):
    state, action = draw(fixed_wing, 100)
    flown = torch.stack(sum(fixed_wing.wrench(*scalars(fixed_wing, state, action)), ()))
    monkeypatch.setattr("envs.fixed_wing.CALM", 0.0)
    exact = torch.stack(sum(fixed_wing.wrench(*scalars(fixed_wing, state, action)), ()))
    assert ((flown - exact).abs() / exact.abs().amax(0)).max() < 1e-7


def test_thrust_acts_along_a_line_below_the_body_x_axis(fixed_wing, draw, scalars):
    state, action = draw(fixed_wing, 5)
    idle, full = action.clone(), action.clone()
    idle[:, 0], full[:, 0] = -1, 1
    (off, _), (on, _) = (fixed_wing.wrench(*scalars(fixed_wing, state, a)) for a in (idle, full))
    thrust = (1 - fixed_wing.thrust_loss) * fixed_wing.thrust_max
    expected = [thrust * math.cos(fixed_wing.thrust_angle), 0, thrust * math.sin(fixed_wing.thrust_angle)]
    difference = torch.stack([b - a for a, b in zip(off, on, strict=True)], -1)
    torch.testing.assert_close(difference, torch.tensor(expected, dtype=torch.float64).expand(5, 3))


def test_left_and_right_are_mirror_images(fixed_wing, draw):
    state, action = draw(fixed_wing, 20)
    mirrored = Dynamics(fixed_wing)(MIRROR * state, MIRROR_ACTION * action)
    torch.testing.assert_close(mirrored, MIRROR * Dynamics(fixed_wing)(state, action))


def test_a_crosswind_from_the_other_side_is_the_mirror_image(fixed_wing, draw):
    state, action = draw(fixed_wing, 20)
    right, left = (Dynamics(replace(fixed_wing, wind=1.0, crosswind=w, downdraught=0.5)) for w in (3.0, -3.0))
    torch.testing.assert_close(left(MIRROR * state, MIRROR_ACTION * action), MIRROR * right(state, action))


@pytest.mark.parametrize("wind", [(4.0, 0, 0), (0, -3.0, 0), (0, 0, 2.0), (2.0, 3.0, -1.0)], ids=str)
def test_flight_in_wind_is_flight_in_still_air_seen_from_a_moving_frame(fixed_wing, draw, wind):
    state, action = draw(fixed_wing, 20)
    vector, dt = torch.tensor(wind, dtype=torch.float64), fixed_wing.dt
    target = f"wind={wind[0]} crosswind={wind[1]} downdraught={wind[2]}"
    still, blown = (make_dynamics(fixed_wing, text, substeps=20) for text in ("", target))

    def carried(s, time):
        """The state over ground of one that flies through the air."""
        body = torch.stack(rigid_body.to_body(s[:, 3:7].unbind(-1), vector.unbind()), -1)
        return torch.cat((s[:, :3] + time * vector, s[:, 3:7], s[:, 7:10] + body, s[:, 10:]), -1)

    torch.testing.assert_close(
        blown(carried(state, 0), action), carried(still(state, action), dt), atol=1e-7, rtol=1e-7
    )


def test_an_external_force_is_felt_in_body_axes(fixed_wing, draw, scalars):
    state, _ = draw(fixed_wing, 10)
    x = scalars(fixed_wing, state)
    added = fixed_wing.accelerate(x, fixed_wing.velocity(x))
    torch.testing.assert_close(torch.stack([added[name] for name in ("u_b", "v_b", "w_b")], -1), state[:, 7:10])


def test_an_angle_is_limited_smoothly():
    limit, angle = 0.2, torch.linspace(-10, 10, 2001, dtype=torch.float64)
    bounded = limited(angle, limit)
    assert (bounded.abs() < limit).all()
    assert (bounded.diff() > 0).all()
    torch.testing.assert_close(bounded, -bounded.flip(0))
    third = torch.tensor(limit / 3, dtype=torch.float64)
    assert limited(third, limit).item() == pytest.approx(third.item(), rel=0.0031)
    assert jacobian(lambda a: limited(a, limit), torch.tensor(0.0, dtype=torch.float64)) == 1


@pytest.mark.parametrize("degrees", [15, 30, 60])
def test_beyond_the_incidence_limit_lift_grows_no_more(fixed_wing, scalars, degrees):
    alpha = torch.tensor(math.radians(degrees), dtype=torch.float64)
    state = level(alpha)
    force, _ = fixed_wing.wrench(*scalars(fixed_wing, state, torch.tensor([-1.0, 0, 0, 0], dtype=torch.float64)))
    lift = force[0] * alpha.sin() - force[2] * alpha.cos()
    coefficient = lift / (fixed_wing.air_density / 2 * CRUISE**2 * fixed_wing.wing_area)
    most = fixed_wing.lift[0] + fixed_wing.lift[1] * fixed_wing.incidence_limit
    assert 0.7 * most < coefficient.item() < most


def test_a_product_of_inertia_that_no_body_has_is_refused():
    with pytest.raises(InputError, match=r"inertia_xz is 0\.5, too large"):
        replace(FixedWing(), inertia_xz=0.5)
