"""Which rows of a flight log are used: no impossible ones, none on the ground, in unbroken runs."""

import numpy as np

from envs.errors import InputError

REASONS = (
    "no message near enough",
    "not valid by its own flags",
    "not a number",
    "time stands still",
    "time jumps",
    "motor command out of range",
    "thrust out of range",
    "quaternion not of unit length",
    "body rate beyond the sensor",
    "speed beyond the plausible",
    "voltage out of range",
)
CLEARANCE = 0.3  # [m] height over the resting place below which the ground still acts on the vehicle
REST_THRUST = 0.3  # [-] share of the weight; less thrust than this and hardly any speed is standing on the ground
REST_SPEED = 0.2  # [m/s]


def check_period(time, dt, log):
    """The longest step [s] between two rows that is no gap: half a control period."""
    steps = np.diff(time)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    period = float(np.median(steps)) if len(steps) else np.inf
    if not period <= dt / 2 * (1 + 1e-6):
        raise InputError(
            f"{log}: rows are {period:g} s apart, expected at most {dt / 2:g} s, half the control period; "
            "check the unit of the time column or log faster"
        )
    return max(dt / 2, 2 * period) * (1 + 1e-6)


def reject(rows, vehicle, step_limit):
    """For each row the number of the first of `REASONS` that makes it impossible, or -1: (N,) int."""
    with np.errstate(invalid="ignore"):  # NaN compares false: its rows are found by the first reason
        steps = np.diff(rows.time, prepend=rows.time[0] - step_limit / 2)
        norm = np.linalg.norm(rows.attitude, axis=1)
        sensors, motors = vehicle.sensors, vehicle.motors
        nowhere = np.zeros(len(steps), bool)
        missed, flagged = (nowhere if doubt is None else doubt for doubt in (rows.missed, rows.flagged))
        if rows.motors is None or motors is None:
            motors_out = nowhere
        else:
            motors_out = ((rows.motors < motors.command_min) | (rows.motors > motors.command_max)).any(1)
        thrust_out = (rows.thrust < 0) | (rows.thrust > 2 * vehicle.system.thrust_max)
        voltage = rows.voltage
        found = (
            missed,
            flagged,
            ~np.all([np.isfinite(v).reshape(len(v), -1).all(1) for v in rows if v is not None], axis=0),
            steps <= 0,
            steps > step_limit,
            motors_out,
            thrust_out,
            np.abs(norm - 1) > 0.02,
            (np.abs(rows.rates) > sensors.rate_max).any(1),
            np.linalg.norm(rows.velocity, axis=1) > sensors.speed_max,
            nowhere if voltage is None else (voltage < sensors.voltage_min) | (voltage > sensors.voltage_max),
        )
    stacked = np.stack(found)
    return np.where(stacked.any(0), stacked.argmax(0), -1)


def airborne(rows, possible, gravity):
    """Whether the vehicle flies clear of the ground: (N,) bool.

    It stands where the thrust is a small part of the weight and nothing moves; a log that never shows this is taken to
    be in the air throughout.
    """
    rest = possible & (rows.thrust < REST_THRUST * gravity) & (np.linalg.norm(rows.velocity, axis=1) < REST_SPEED)
    if not rest.any():
        return np.ones(len(rest), bool)
    with np.errstate(invalid="ignore"):
        return rows.position[:, 2] > np.median(rows.position[rest, 2]) + CLEARANCE


def unbroken_runs(used):
    """Slices of consecutive used rows."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], used, [False])).astype(int)))
    return [slice(start, stop) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
