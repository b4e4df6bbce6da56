"""Quaternion kinematics on named scalars, shared by both aircraft.

A quaternion is `(w, x, y, z)`, scalar first, and turns body coordinates into world coordinates. Every function takes
and returns tuples of scalars, which may be floats, torch tensors or CasADi symbols.

Stevens, Lewis and Johnson (2016), "Aircraft Control and Simulation", ch. 1.
"""


def rotation_columns(q):
    """The body axes in world coordinates: the three columns of the rotation matrix, each a 3-tuple."""
    w, x, y, z = q
    first = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return first, second, third


def to_world(q, vector):
    """A body vector in world coordinates."""
    a, b, c = rotation_columns(q)
    vx, vy, vz = vector
    return tuple(a[i] * vx + b[i] * vy + c[i] * vz for i in range(3))


def to_body(q, vector):
    """A world vector in body coordinates."""
    return tuple(dot(column, vector) for column in rotation_columns(q))


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


def cross(a, b):
    """The vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a, b):
    """The scalar product of two 3-tuples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
