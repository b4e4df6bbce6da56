"""Facts about rotations that hold for any unit quaternion."""

import math

import pytest
import torch
from torch.autograd.functional import jvp

from envs import rigid_body
from envs.fixed_wing import FixedWing
from envs.quadrotor import Quadrotor


def random_quaternions(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 4, generator=generator, dtype=torch.float64), dim=-1)


def random_vectors(n, seed=1):
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rotation_matrix(quaternions):
    axes = (rigid_body.axis_x, rigid_body.axis_y, rigid_body.axis_z)
    return torch.stack([torch.stack(axis(quaternions.unbind(-1)), -1) for axis in axes], -1)


def product(a, b):
    """Hamilton's product, written as scalar and vector part."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + torch.linalg.cross(a[..., 1:], b[..., 1:])
    return torch.cat((scalar, vector), -1)


def test_a_rotation_matrix_is_orthogonal_and_right_handed():
    matrix = rotation_matrix(random_quaternions(20))
    torch.testing.assert_close(matrix.mT @ matrix, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(20, dtype=torch.float64))


@pytest.mark.parametrize("axis", range(3))
def test_a_quarter_turn_about_an_axis_carries_the_second_axis_into_the_third(axis):
    q = [math.cos(math.pi / 4), 0.0, 0.0, 0.0]
    q[1 + axis] = math.sin(math.pi / 4)
    second, third = torch.eye(3)[(axis + 1) % 3], torch.eye(3)[(axis + 2) % 3]
    assert rigid_body.to_world(q, second.tolist()) == pytest.approx(third.tolist(), abs=1e-12)


def test_the_rotation_of_a_vector_is_the_sandwich_product():
    q, v = random_quaternions(20), random_vectors(20)
    pure = torch.cat((torch.zeros(20, 1, dtype=torch.float64), v), -1)
    conjugate = q * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
    expected = product(product(q, pure), conjugate)[:, 1:]
    torch.testing.assert_close(torch.stack(rigid_body.to_world(q.unbind(-1), v.unbind(-1)), -1), expected)


def test_the_rotation_of_a_vector_is_the_product_with_the_matrix_of_body_axes():
    q, v = random_quaternions(20), random_vectors(20)
    expected = (rotation_matrix(q) @ v.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(torch.stack(rigid_body.to_world(q.unbind(-1), v.unbind(-1)), -1), expected)


def test_the_inverse_quaternion_has_the_transposed_matrix():
    q = random_quaternions(20)
    inverse = torch.stack(rigid_body.inverse(q.unbind(-1)), -1)
    torch.testing.assert_close(rotation_matrix(inverse), rotation_matrix(q).mT)


def test_to_body_undoes_to_world():
    q, v = random_quaternions(20).unbind(-1), random_vectors(20)
    there = rigid_body.to_world(q, v.unbind(-1))
    torch.testing.assert_close(torch.stack(rigid_body.to_body(q, there), -1), v)


def test_constant_body_rates_turn_by_rate_times_time():
    """The derivative of q * (cos |w|t/2, sin |w|t/2 w/|w|) at t = 0."""
    q, w = random_quaternions(20), random_vectors(20)
    speed = w.norm(dim=-1, keepdim=True)

    def later(t):
        return product(q, torch.cat(((speed * t / 2).cos(), (speed * t / 2).sin() * w / speed), -1))

    _, expected = jvp(later, torch.tensor(0.0, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64))
    rates = torch.stack(rigid_body.quaternion_rates(q.unbind(-1), w.unbind(-1)), -1)
    torch.testing.assert_close(rates, expected)


def test_normalised_keeps_the_direction_and_makes_the_norm_one():
    q = random_quaternions(20)
    scale = torch.linspace(0.1, 5, 20, dtype=torch.float64).unsqueeze(-1)
    torch.testing.assert_close(torch.stack(rigid_body.normalised((scale * q).unbind(-1)), -1), q)


def test_cross_is_that_of_linear_algebra():
    a, b = random_vectors(20, 1), random_vectors(20, 2)
    cross = torch.stack(rigid_body.cross(a.unbind(-1), b.unbind(-1)), -1)
    torch.testing.assert_close(cross, torch.linalg.cross(a, b))


@pytest.fixture(params=[Quadrotor(), FixedWing()], ids=lambda system: system.name)
def aircraft(request):
    return request.param


def random_states(system, n, seed=0):
    """States of any attitude, position, velocity and body rates, and so far apart that every rotation occurs."""
    generator = torch.Generator().manual_seed(seed)
    state = 3 * torch.randn(n, len(system.State._fields), generator=generator, dtype=torch.float64)
    return tuple(system.project(system.State(*state.unbind(-1))))


def stacked(scalars):
    return torch.stack(tuple(scalars), -1)


def same_way_round(x):
    """A state tensor with the scalar part of its quaternion (if any) not negative: q and -q are one attitude."""
    if x.shape[-1] < 13:
        return x
    sign = torch.where(x[..., 3:4] < 0, -1.0, 1.0)
    return torch.cat((x[..., :3], sign * x[..., 3:7], x[..., 7:]), -1)


def test_displaced_undoes_difference_for_any_two_states(robot):
    x, y = (robot.State(*random_states(robot, 200, seed)) for seed in (0, 1))
    again = robot.displaced(x, robot.difference(x, y))
    assert isinstance(again, robot.State)
    torch.testing.assert_close(same_way_round(stacked(again)), same_way_round(stacked(y)), rtol=0, atol=1e-12)


def test_difference_undoes_displaced_for_turns_of_less_than_half_a_circle(robot):
    x = robot.State(*random_states(robot, 200))
    generator = torch.Generator().manual_seed(2)
    delta = torch.randn(200, len(robot.difference(x, x)), generator=generator, dtype=torch.float64)
    if delta.shape[-1] == 12:
        delta[:, 3:6] *= 3 / (1 + delta[:, 3:6].norm(dim=-1, keepdim=True))
    again = robot.difference(x, robot.displaced(x, delta.unbind(-1)))
    torch.testing.assert_close(stacked(again), delta, rtol=0, atol=1e-12)


def test_a_displaced_attitude_is_a_unit_quaternion(aircraft):
    x = aircraft.State(*random_states(aircraft, 200))
    delta = 10 * torch.randn(12, 200, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    turned = stacked(rigid_body.attitude(aircraft.displaced(x, tuple(delta))))
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(200, dtype=torch.float64), rtol=0, atol=1e-14)


def test_no_difference_leads_nowhere(robot):
    x = robot.State(*random_states(robot, 20))
    assert stacked(robot.difference(x, x)).abs().max() < 1e-15


def elsewhere(robot, x, turn, shift):
    """The state of a robot in a world turned about gravity and moved."""
    q = tuple(torch.as_tensor(part, dtype=torch.float64) for part in turn)
    place = tuple(a + b for a, b in zip(rigid_body.to_world(q, (x.px, x.py, x.pz)), shift, strict=True))
    attitude = product(torch.stack(q).expand(len(x.qw), 4), stacked(rigid_body.attitude(x))).unbind(-1)
    moved = dict(zip(("px", "py", "pz", "qw", "qx", "qy", "qz"), (*place, *attitude), strict=True))
    if "vx" in x._fields:
        moved |= dict(zip(("vx", "vy", "vz"), rigid_body.to_world(q, (x.vx, x.vy, x.vz)), strict=True))
    return x._replace(**moved)


def test_the_difference_does_not_depend_on_the_place_nor_on_the_heading_of_the_world(aircraft, turn):
    x, y = (aircraft.State(*random_states(aircraft, 50, seed)) for seed in (0, 1))
    about = turn(1.1, (0.0, 0.0, 1.0))
    seen = aircraft.difference(
        elsewhere(aircraft, x, about, (5.0, -3.0, 2.0)), elsewhere(aircraft, y, about, (5.0, -3.0, 2.0))
    )
    torch.testing.assert_close(stacked(seen), stacked(aircraft.difference(x, y)), rtol=0, atol=1e-11)


def test_the_difference_of_a_short_time_is_body_velocity_body_rates_and_their_change(aircraft, derivative, draw):
    """To first order: the tangent space is where the derivative of the state lives."""
    state, action = draw(aircraft, 20)
    h, rate = 1e-6, derivative(aircraft, state, action)
    x = aircraft.State(*state.unbind(-1))
    y = aircraft.project(aircraft.State(*(state + h * rate).unbind(-1)))
    seen = stacked(aircraft.difference(x, y)) / h
    body = stacked(rigid_body.to_body(rigid_body.attitude(x), aircraft.velocity(x)))
    change = rate[:, 7:10]
    if "vx" in aircraft.State._fields:
        change = stacked(rigid_body.to_body(rigid_body.attitude(x), change.unbind(-1)))
    expected = torch.cat((body, state[:, 10:], change, rate[:, 10:]), -1)
    torch.testing.assert_close(seen, expected, rtol=1e-4, atol=1e-4)


def test_a_rotation_vector_is_axis_times_angle_the_shorter_way_round(turn):
    def vector(angle, axis):
        q = torch.tensor(turn(angle, axis), dtype=torch.float64)
        return torch.stack(rigid_body.rotation_vector(q.unbind())).tolist()

    for angle in (1e-9, 1e-5, 1e-4, 0.3, 3.1):
        assert vector(angle, (0.0, 0.6, 0.8)) == pytest.approx([0.0, 0.6 * angle, 0.8 * angle], rel=1e-12)
    assert vector(4.0, (1.0, 0.0, 0.0)) == pytest.approx([4.0 - 2 * math.pi, 0.0, 0.0])


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.99e-4, 1.01e-4, 1.0])
def test_rotations_have_the_right_gradient_also_at_zero(size):
    vector = (size * torch.nn.functional.normalize(random_vectors(3), dim=-1)).requires_grad_()

    def there_and_back(vector):
        return torch.stack(rigid_body.rotation_vector(rigid_body.quaternion_of(vector.unbind(-1))), -1)

    (gradient,) = torch.autograd.grad(there_and_back(vector).sum(), vector)
    torch.testing.assert_close(gradient, torch.ones_like(gradient), rtol=0, atol=1e-9)


def test_the_product_of_quaternions_is_hamiltons():
    a, b = random_quaternions(20, 0), random_quaternions(20, 1)
    torch.testing.assert_close(stacked(rigid_body.product(a.unbind(-1), b.unbind(-1))), product(a, b))
