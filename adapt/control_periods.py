"""Unbroken runs of log rows to states, actions and context, one control period apart.

Body-rate commands, where they were not logged, are those that would have led the vehicle's rate loop to the measured
mean rates. What the context is: see `adapt.logs`.
"""

from typing import NamedTuple

import numpy as np

from adapt.log_rows import rotation_matrices, to_body

MEMORY = 0.3  # [s] time constant of the context's mean; on flights left out of the fit 0.1 and 1 s predict worse
# [s] Logged velocities are smoothed, and a smoothed value knows the near future. What is closer than this to the start
# of a period stays out of its context: half the width of the smoothing in motion-capture logs (0.13 s) and a little.
BLIND = 0.15
FORCE_NAMES = ("force_x", "force_y", "force_z")


class Piece(NamedTuple):
    """The transitions of one run, and how many of its rows they use."""

    state: np.ndarray
    action: np.ndarray
    next_state: np.ndarray
    context: np.ndarray
    rows: int


def control_periods(run, vehicle):
    """Resample one unbroken run to whole control periods, or None when it is too short.

    The first `MEMORY` seconds only fill the average of the context.
    """
    dt = vehicle.system.dt
    delay = vehicle.motors.thrust_delay if vehicle.motors is not None and run.motors is not None else 0.0
    start = run.time[0] + max(MEMORY, delay)
    count = int(np.floor((run.time[-1] - start) / dt + 1e-6))
    if count < 1:
        return None
    knots = np.minimum(start + dt * np.arange(count + 1), run.time[-1])
    run = run._replace(attitude=_continuous(run.attitude))
    states = _states_at(run, knots)
    action = _actions(run, knots, states, vehicle.system, delay)
    context = _context(run, knots[:-1], vehicle.system.gravity, delay)
    rows = int(((run.time >= knots[0]) & (run.time <= knots[-1])).sum())
    return Piece(states[:-1], action, states[1:], context, rows)


def _continuous(quaternion):
    """The same attitudes without changes of sign between rows, of unit length."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(1) < 0, -1.0, 1.0)
    signs = np.cumprod(np.concatenate(([1.0 if quaternion[0, 0] >= 0 else -1.0], flips)))
    return quaternion * (signs / np.linalg.norm(quaternion, axis=1))[:, None]


def _interpolate(time, values, knots):
    return np.stack([np.interp(knots, time, column) for column in values.T], 1)


def _states_at(run, knots):
    """States (K, 13) at times `knots` (K,) within the run."""
    attitude = _interpolate(run.time, run.attitude, knots)
    attitude = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    position, velocity, rates = (_interpolate(run.time, v, knots) for v in (run.position, run.velocity, run.rates))
    return np.concatenate((position, attitude, velocity, rates), 1)


def window_means(time, values, knots):
    """Means (K - 1, k) of values (N, k), linear between rows, over the windows between `knots` (K,)."""
    steps = np.diff(time)[:, None]
    area = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum((values[1:] + values[:-1]) / 2 * steps, 0)))
    before = np.clip(np.searchsorted(time, knots, side="right") - 1, 0, len(time) - 1)
    rest = (knots - time[before])[:, None] * (values[before] + _interpolate(time, values, knots)) / 2
    return np.diff(area[before] + rest, axis=0) / np.diff(knots)[:, None]


def held_command(mean, start, gain, dt):
    """Constant command [rad/s] after which a loop w' = gain (command - w) from `start` has this mean over `dt`."""
    lag = -np.expm1(-gain * dt) / (gain * dt)
    return (mean - lag * start) / (1 - lag)


def _actions(run, knots, states, system, delay):
    """Actions (K - 1, 4) normalised by the system's limits; beyond them the magnitude exceeds 1."""
    thrust = window_means(run.time, run.thrust[:, None], knots - delay)[:, 0]
    if run.rate_commands is not None:
        commands = window_means(run.time, run.rate_commands, knots)
    else:
        gains = np.array([system.rate_gain_x, system.rate_gain_y, system.rate_gain_z])
        commands = held_command(window_means(run.time, run.rates, knots), states[:-1, 10:], gains, system.dt)
    limits = np.array([system.rate_limit_x, system.rate_limit_y, system.rate_limit_z])
    middle, half = (system.thrust_max + system.thrust_min) / 2, (system.thrust_max - system.thrust_min) / 2
    return np.concatenate(((thrust[:, None] - middle) / half, commands / limits), 1)


def _context(run, starts, gravity, delay):
    """Context (K, c) from the rows up to `BLIND` before each of the times `starts` (K,)."""
    force = _backward_slope(run.time, run.velocity) + [0.0, 0.0, gravity]
    force = to_body(rotation_matrices(run.attitude), force)
    late_thrust = np.interp(run.time - delay, run.time, run.thrust)
    surplus = force - late_thrust[:, None] * np.array([0.0, 0.0, 1.0])
    columns = _recent_mean(run.time, surplus, MEMORY)
    if run.voltage is not None:
        columns = np.concatenate((run.voltage[:, None], columns), 1)
    rows = np.searchsorted(run.time, starts - BLIND + 1e-6, side="right") - 1
    return columns[rows]


def _backward_slope(time, values):
    slope = np.diff(values, axis=0) / np.diff(time)[:, None]
    return np.concatenate((slope[:1], slope))


def _recent_mean(time, values, memory):
    """Exponential average over the past with the time constant `memory` [s]."""
    weights = -np.expm1(-np.diff(time) / memory)
    means = np.empty_like(values)
    means[0] = values[0]
    for i, weight in enumerate(weights):
        means[i + 1] = means[i] + weight * (values[i + 1] - means[i])
    return means
