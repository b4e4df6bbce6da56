"""Quaternion kinematics on named scalars, shared by both aircraft.

A quaternion is `(w, x, y, z)`, scalar first, and turns body coordinates into world coordinates. Every function takes
and returns tuples of scalars, which may be floats, torch tensors or CasADi symbols.

Stevens, Lewis and Johnson (2016), "Aircraft Control and Simulation", ch. 1.
"""


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
