"""Attitude as roll, pitch and yaw, which some simulators speak, and as a unit quaternion, scalar first."""

import math

import numpy as np


def angles(w, x, y, z):
    """Roll, pitch, yaw [rad] of a unit quaternion."""
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quaternion(roll, pitch, yaw):
    """The unit quaternion (4,) of roll, pitch, yaw [rad]."""
    (a, d), (b, e), (c, f) = ((math.cos(angle / 2), math.sin(angle / 2)) for angle in (roll, pitch, yaw))
    return np.array((a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c))
