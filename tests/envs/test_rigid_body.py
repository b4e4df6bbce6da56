"""Facts about rotations that hold for any unit quaternion."""

import math

import pytest
import torch
from torch.autograd.functional import jvp

from envs import rigid_body


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
