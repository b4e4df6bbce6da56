"""What a quadrotor must do along a curve of flat points, and whether a vehicle can.

A flat point is a row of 12 numbers, columns `FLAT`: position [m], velocity [m/s], acceleration [m/s^2] and jerk [m/s^3]
in the world frame, z up.

Mellinger & Kumar (2011), "Minimum snap trajectory generation and control for quadrotors", ICRA: flatness.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

FLAT = ("px", "py", "pz", "vx", "vy", "vz", "ax", "ay", "az", "jx", "jy", "jz")
POSITION, VELOCITY, ACCELERATION, JERK = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True)
class FlightLimits:
    """What a flat curve may ask of a vehicle; the defaults are those of `Quadrotor`."""

    gravity: float = 9.81  # [m/s^2]
    thrust_min: float = 2.31  # [m/s^2] mass-normalised
    thrust_max: float = 17.31  # [m/s^2] mass-normalised
    rate_x: float = 0.5  # [rad/s] largest |body rate|
    rate_y: float = 0.5  # [rad/s]
    rate_z: float = 0.5  # [rad/s]


def flatness(flat: Tensor, gravity: float) -> tuple[Tensor, Tensor, Tensor]:
    """Thrust, attitude and body rates with which a quadrotor flies along flat points, its nose towards world x.

    Mellinger & Kumar (2011), sect. III. Heading as in Faessler, Franchi & Scaramuzza (2018), "Differential flatness of
    quadrotor dynamics subject to rotor drag", without drag: the body x axis stays in the world x-z plane
    (yaw-pitch-roll with yaw 0), and the body z rate is the one that keeps it there, not Mellinger's approximation 0.

    Args:
        flat: `(..., 12)`, columns `FLAT`.
        gravity: [m/s^2].

    Returns:
        thrust `(...)` [m/s^2] mass-normalised; quaternion `(..., 4)` body to world, scalar first, qw >= 0; body rates
        `(..., 3)` [rad/s]. Free fall (acceleration equal to gravity) has no attitude: rates aren't finite there.
    """
    ax, ay, az = flat[..., ACCELERATION].unbind(-1)
    jx, jy, jz = flat[..., JERK].unbind(-1)
    lift = az + gravity
    lift_in_plane = (ax * ax + lift * lift).sqrt()  # the part in the x-z plane
    thrust = (lift_in_plane * lift_in_plane + ay * ay).sqrt()
    # z_b = Ry(pitch) Rx(roll) e_z = (cos(roll) sin(pitch), -sin(roll), cos(roll) cos(pitch))
    sin_roll, cos_roll = -ay / thrust, lift_in_plane / thrust
    sin_pitch, cos_pitch = ax / lift_in_plane, lift / lift_in_plane
    jerk_in_plane = jx * sin_pitch + jz * cos_pitch
    p = -(cos_roll * jy + sin_roll * jerk_in_plane) / thrust  # -(jerk . y_b) / thrust
    q = (jx * cos_pitch - jz * sin_pitch) / thrust  # (jerk . x_b) / thrust
    r = -q * sin_roll / cos_roll  # keeps x_b in the x-z plane
    return (
        thrust,
        _roll_pitch_quaternion(torch.atan2(-ay, lift_in_plane), torch.atan2(ax, lift)),
        torch.stack((p, q, r), -1),
    )


def _roll_pitch_quaternion(roll: Tensor, pitch: Tensor) -> Tensor:
    """Quaternion of Ry(pitch) Rx(roll), angles `(...)` [rad] to `(..., 4)`."""
    sin_r, cos_r = (roll / 2).sin(), (roll / 2).cos()
    sin_p, cos_p = (pitch / 2).sin(), (pitch / 2).cos()
    return torch.stack((cos_p * cos_r, cos_p * sin_r, sin_p * cos_r, -sin_p * sin_r), -1)


def feasible(flat: Tensor, limits: FlightLimits, margin: float = 0.9) -> Tensor:
    """Which curves `(N, T, 12)` stay inside the limits at every point: bool `(N,)`.

    `margin` shrinks each range about its middle: 0.9 leaves the middle 90 % of the thrust range and rates up to 90 %.
    """
    thrust, _, rates = flatness(flat, limits.gravity)
    middle, half = (limits.thrust_max + limits.thrust_min) / 2, (limits.thrust_max - limits.thrust_min) / 2
    rate_limits = rates.new_tensor((limits.rate_x, limits.rate_y, limits.rate_z))
    thrust_fits = (thrust - middle).abs() <= margin * half  # False where not finite
    rates_fit = (rates.abs() <= margin * rate_limits).all(-1)
    return (thrust_fits & rates_fit).all(-1)
