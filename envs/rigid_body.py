"""Quaternion kinematics on named scalars, shared by both aircraft.

A quaternion is `(w, x, y, z)`, scalar first, and turns body coordinates into world coordinates. Every function takes
and returns tuples of scalars, which may be floats, torch tensors or CasADi symbols.

Stevens, Lewis and Johnson (2016), "Aircraft Control and Simulation", ch. 1.
"""

import torch

SMALL = 1e-8  # [rad^2] below this square of an angle, series: their error is less than that of a double


def axis_x(q):
    """The body x axis in world coordinates: the first column of the rotation matrix."""
    w, x, y, z = q
    return 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)


def axis_y(q):
    """The body y axis in world coordinates: the second column of the rotation matrix."""
    w, x, y, z = q
    return 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)


def axis_z(q):
    """The body z axis in world coordinates: the third column of the rotation matrix."""
    w, x, y, z = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


def inverse(q):
    """The quaternion of the opposite rotation."""
    return q[0], -q[1], -q[2], -q[3]


def to_world(q, vector):
    """A body vector in world coordinates: v + w t + u x t with t = 2 u x v, fewer operations than by the matrix."""
    w, *axis = q
    twice = tuple(2 * c for c in cross(axis, vector))
    turned = cross(axis, twice)
    return tuple(v + w * t + c for v, t, c in zip(vector, twice, turned, strict=True))


def to_body(q, vector):
    """A world vector in body coordinates."""
    return to_world(inverse(q), vector)


def quaternion_rates(q, rates):
    """dq/dt for body rates `(p, q, r)` [rad/s]: half the quaternion product q * (0, rates)."""
    w, x, y, z = q
    hp, hq, hr = (0.5 * rate for rate in rates)
    return (
        -(x * hp + y * hq + z * hr),
        w * hp + y * hr - z * hq,
        w * hq + z * hp - x * hr,
        w * hr + x * hq - y * hp,
    )


def normalised(q):
    """The unit quaternion in the direction of `q`."""
    w, x, y, z = q
    scale = 1 / (w * w + x * x + y * y + z * z).sqrt()
    return w * scale, x * scale, y * scale, z * scale


def product(a, b):
    """Hamilton's product: the rotation `b` followed by `a`."""
    vector = cross(a[1:], b[1:])
    return (
        a[0] * b[0] - (a[1] * b[1] + a[2] * b[2] + a[3] * b[3]),
        *(a[0] * b[i + 1] + b[0] * a[i + 1] + vector[i] for i in range(3)),
    )


def rotation_vector(q):
    """Axis times angle [rad] of a unit quaternion, the shorter way round (0 ... pi); torch only.

    Near zero a series takes over, so that value and gradient stay finite there.
    """
    w, *axis = (torch.where(q[0] < 0, -part, part) for part in q)
    square = axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]
    small = square < SMALL
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    factor = torch.where(small, 2 + square / 3, 2 * torch.atan2(sine, w) / sine)
    return tuple(factor * part for part in axis)


def quaternion_of(vector):
    """The unit quaternion of a rotation vector [rad], the inverse of `rotation_vector`; torch only."""
    square = vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]
    small = square < SMALL
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    factor = torch.where(small, 0.5 - square / 48, (angle / 2).sin() / angle)
    cosine = torch.where(small, 1 - square / 8, (angle / 2).cos())
    return cosine, *(factor * part for part in vector)


def pose_difference(x, y):
    """What leads from the pose of `x` to that of `y`, in the body axes of `x`: way [m] and rotation vector [rad]."""
    back = inverse(attitude(x))
    way = to_world(back, (y.px - x.px, y.py - x.py, y.pz - x.pz))
    return *way, *rotation_vector(product(back, attitude(y)))


def pose_displaced(x, delta):
    """Position and unit quaternion that `delta` leads to from the pose of `x`: the inverse of `pose_difference`."""
    way = to_world(attitude(x), delta[:3])
    turned = normalised(product(attitude(x), quaternion_of(delta[3:])))
    return x.px + way[0], x.py + way[1], x.pz + way[2], *turned


def attitude(x):
    """The quaternion of a state that has `qw, qx, qy, qz`."""
    return x.qw, x.qx, x.qy, x.qz


def with_unit_attitude(x):
    """The state with its quaternion brought back to unit length, as `System.project` wants it."""
    unit = normalised(attitude(x))
    return x._replace(**dict(zip(("qw", "qx", "qy", "qz"), unit, strict=True)))


def cross(a, b):
    """The vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
