"""Flight logs to transitions of a vehicle's model.

read -> units and frames -> reject impossible rows -> cut the ground -> split into unbroken runs -> control periods.
What a log lacks is stood in for: the thrust comes from motor commands, and body-rate commands, where they were not
logged, are those that would have led the vehicle's rate loop to the measured mean rates.

Context of a transition, all of it known when the period begins:

| name                        | what                                                                           | unit  |
|-----------------------------|--------------------------------------------------------------------------------|-------|
| `voltage`                   | battery, where the log has it                                                  | V     |
| `force_x, force_y, force_z` | specific force beyond the commanded thrust, body axes, mean of the recent past | m/s^2 |

The force says what the model lacked a moment ago: a worn propeller, a sagging battery, a tilted attitude sensor. Hold
it constant when predicting ahead.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

from adapt.mappings import find_mapping
from adapt.transitions import Transitions
from envs.errors import InputError
from envs.vehicles import Vehicle

REASONS = (
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
MEMORY = 0.3  # [s] time constant of the context's mean; on flights left out of the fit 0.1 and 1 s predict worse
FORCE_NAMES = ("force_x", "force_y", "force_z")


class Rows(NamedTuple):
    """The rows of a log in SI units, world z up, body z up; None for what was not logged."""

    time: np.ndarray  # [s] (N,)
    position: np.ndarray  # [m] (N, 3)
    attitude: np.ndarray  # [-] (N, 4) scalar first, body to world
    velocity: np.ndarray  # [m/s] (N, 3) world
    rates: np.ndarray  # [rad/s] (N, 3) body
    thrust: np.ndarray  # [m/s^2] (N,) collective, per mass
    motors: np.ndarray | None  # [-] (N, k) commands
    rate_commands: np.ndarray | None  # [rad/s] (N, 3) body
    voltage: np.ndarray | None  # [V] (N,)

    def take(self, rows):
        """The same with the given rows only."""
        return Rows(*(None if values is None else values[rows] for values in self))


@dataclass(frozen=True)
class LogReport:
    """What became of the rows of a log; `str()` is a table."""

    log: str
    mapping: str
    rows: int
    rejected: dict[str, int] = field(default_factory=dict)  # a row counts under the first reason that applies
    ground: int = 0  # rows before take-off and after landing
    unused: int = 0  # rows at the ends of unbroken runs that fill no control period
    trajectories: int = 0  # unbroken runs
    transitions: int = 0
    beyond_limits: int = 0  # transitions with an action outside [-1, 1]: they are kept as they are
    seconds: float = 0.0  # [s] flown

    def __str__(self):
        lines = [(f"{self.log} ({self.mapping})", ""), ("rows read", f"{self.rows}")]
        lines += [(f"  rejected: {reason}", f"{count}") for reason, count in self.rejected.items() if count]
        lines += [("  on the ground", f"{self.ground}"), ("  in no whole control period", f"{self.unused}")]
        lines += [("transitions", f"{self.transitions}"), ("  unbroken runs", f"{self.trajectories}")]
        lines += [("  beyond the action limits", f"{self.beyond_limits}"), ("seconds flown", f"{self.seconds:.1f}")]
        width = max(len(label) for label, _ in lines)
        return "\n".join(f"{label:<{width}} {value:>8}".rstrip() for label, value in lines)


@dataclass(frozen=True)
class FlightLog:
    """One log as transitions of the vehicle's system; M transitions, float64."""

    name: str
    vehicle: Vehicle
    state: np.ndarray  # (M, 13)
    action: np.ndarray  # (M, 4), normalised by the system's limits but not clipped to them
    next_state: np.ndarray  # (M, 13)
    trajectory: np.ndarray  # (M,) number of the unbroken run
    context: np.ndarray  # (M, c)
    context_names: tuple[str, ...]
    report: LogReport


def read_flight(path, vehicle, mapping="auto"):
    """Read a CSV flight log as transitions of `vehicle` over its control period.

    Args:
        path: the CSV file.
        vehicle: `Vehicle`; its limits decide which rows are possible.
        mapping: name or TOML file of the column mapping, see `adapt.mappings`; "auto" goes by the columns.

    Raises:
        InputError: naming the file, when it cannot be read, lacks columns, is logged too slowly, or leaves nothing.
    """
    log = Path(path).name
    table = read_table(path)
    mapping = find_mapping(mapping, list(table.columns), log)
    rows = convert(table, mapping, vehicle, log)
    step_limit = _check_period(rows.time, vehicle.system.dt, log)
    reasons = reject(rows, vehicle, step_limit)
    possible = reasons < 0
    flying = airborne(rows, possible, vehicle.system.gravity)
    runs = unbroken_runs(possible & flying)
    pieces = [piece for run in runs if (piece := control_periods(rows.take(run), vehicle)) is not None]
    counts = np.bincount(reasons[~possible], minlength=len(REASONS))
    rejected = dict(zip(REASONS, (int(count) for count in counts), strict=True))
    if not pieces:
        worst = ", ".join(f"{count} {reason}" for reason, count in rejected.items() if count)
        ground = int((possible & ~flying).sum())
        raise InputError(
            f"{log}: no whole control period of {vehicle.system.dt:g} s left of {len(table)} rows "
            f"({worst or 'none rejected'}; {ground} on the ground); give a longer or cleaner flight"
        )
    return _flight_log(log, mapping.name, vehicle, pieces, rejected, flying & possible, possible)


def _flight_log(log, mapping, vehicle, pieces, rejected, used, possible):
    parts = [np.concatenate(part) for part in list(zip(*pieces, strict=True))[:4]]
    state, action, next_state, context = parts
    lengths = [len(piece.state) for piece in pieces]
    report = LogReport(
        log=log,
        mapping=mapping,
        rows=len(possible),
        rejected=rejected,
        ground=int((possible & ~used).sum()),
        unused=int(used.sum()) - sum(piece.rows for piece in pieces),
        trajectories=len(pieces),
        transitions=len(state),
        beyond_limits=int((np.abs(action) > 1).any(1).sum()),
        seconds=len(state) * vehicle.system.dt,
    )
    trajectory = np.repeat(np.arange(len(pieces)), lengths)
    names = (("voltage",) if context.shape[1] > len(FORCE_NAMES) else ()) + FORCE_NAMES
    return FlightLog(log, vehicle, state, action, next_state, trajectory, context, names, report)


def flight_transitions(logs, dtype=torch.float32, device="cpu"):
    """`Transitions` of several flights of one vehicle; every unbroken run is a trajectory of its own.

    Raises:
        InputError: when there is no log, or the logs differ in vehicle or context.
    """
    if not logs:
        raise InputError("no flight log given; at least one is needed")
    first = logs[0]
    for log in logs[1:]:
        if log.vehicle.system != first.vehicle.system:
            raise InputError(f"{log.name} was read for another vehicle than {first.name}")
        if log.context_names != first.context_names:
            raise InputError(
                f"{log.name} has the context {', '.join(log.context_names)}, {first.name} has "
                f"{', '.join(first.context_names)}; read both with a mapping to the same quantities"
            )
    offsets = np.cumsum([0] + [log.report.trajectories for log in logs[:-1]])
    trajectory = np.concatenate([log.trajectory + offset for log, offset in zip(logs, offsets, strict=True)])

    def joined(name):
        return torch.as_tensor(np.concatenate([getattr(log, name) for log in logs]), dtype=dtype, device=device)

    system = first.vehicle.system
    return Transitions(
        state=joined("state"),
        action=joined("action"),
        next_state=joined("next_state"),
        trajectory=torch.as_tensor(trajectory, device=device),
        dt=system.dt,
        system=system.name,
        state_names=system.State._fields,
        action_names=system.Action._fields,
        context=joined("context"),
        context_names=first.context_names,
    )


# ---------------------------------------------------------------------------------------- reading and conversion


def read_table(path):
    """The CSV file as a table."""
    try:
        table = pd.read_csv(path, skipinitialspace=True, low_memory=False)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give the path of a CSV file") from None
    except (ValueError, pd.errors.ParserError) as error:  # empty, not text, or rows of different length
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a CSV file with a header ({reason})") from None
    if len(table) < 2:
        raise InputError(f"{path}: {len(table)} rows, a flight log needs at least 2")
    return table


def convert(table, mapping, vehicle, log):
    """The quantities of a table in SI units and z-up axes, as `Rows`."""
    values = {name: _numbers(table, quantity, log) for name, quantity in mapping.quantities.items()}
    frames = {name: quantity.frame for name, quantity in mapping.quantities.items()}
    attitude = values["attitude"]
    if mapping.quantities["attitude"].order == "xyzw":
        attitude = attitude[:, [3, 0, 1, 2]]
    if mapping.axes == "z-down":  # turn the world and the body by half a turn about their x axes
        flip = np.array([1.0, -1.0, -1.0])
        attitude = attitude * np.array([1.0, 1.0, -1.0, -1.0])
        for name in ("position", "velocity", "rates", "rate_commands"):
            if name in values:
                values[name] = values[name] * flip
    rotation = rotation_matrices(attitude)
    if frames["velocity"] == "body":
        values["velocity"] = _to_world(rotation, values["velocity"])
    if frames["rates"] == "world":
        values["rates"] = _to_body(rotation, values["rates"])
    return Rows(
        time=values["time"][:, 0],
        position=values["position"],
        attitude=attitude,
        velocity=values["velocity"],
        rates=values["rates"],
        thrust=_thrust(values, mapping, vehicle, log),
        motors=values.get("motors"),
        rate_commands=values.get("rate_commands"),
        voltage=values["voltage"][:, 0] if "voltage" in values else None,
    )


def _numbers(table, quantity, log):
    """Columns of one quantity (N, k) in SI units; a cell that is no number becomes NaN."""
    columns = []
    for name in quantity.columns:
        column = pd.to_numeric(table[name], errors="coerce").to_numpy(float)
        if not np.isfinite(column).any():
            raise InputError(f"{log}: column {name} holds no number")
        columns.append(column * quantity.factor)
    return np.stack(columns, 1)


def _thrust(values, mapping, vehicle, log):
    """Collective thrust per mass [m/s^2] (N,), from the log or from motor commands by the vehicle's thrust curve."""
    if "thrust" in values:
        per_mass = mapping.quantities["thrust"].unit == "m/s^2"
        return values["thrust"][:, 0] / (1.0 if per_mass else vehicle.system.mass)
    if vehicle.motors is None:
        raise InputError(f"{log}: motor commands need a thrust_curve; vehicle {vehicle.name} has no [motors] table")
    return vehicle.motors.force(values["motors"]).sum(1) / vehicle.system.mass


def rotation_matrices(quaternion):
    """Body-to-world rotations (N, 3, 3) of quaternions (N, 4), scalar first."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True).clip(1e-12)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _to_world(rotation, vectors):
    return np.einsum("nij,nj->ni", rotation, vectors)


def _to_body(rotation, vectors):
    return np.einsum("nji,nj->ni", rotation, vectors)


# ---------------------------------------------------------------------------------------- which rows are used


def _check_period(time, dt, log):
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
        if rows.motors is None or motors is None:
            motors_out = nowhere
        else:
            motors_out = ((rows.motors < motors.command_min) | (rows.motors > motors.command_max)).any(1)
        thrust_out = (rows.thrust < 0) | (rows.thrust > 2 * vehicle.system.thrust_max)
        voltage = rows.voltage
        found = (
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


# ---------------------------------------------------------------------------------------- control periods


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
    """Context (K, c) from the rows up to each of the times `starts` (K,)."""
    force = _backward_slope(run.time, run.velocity) + [0.0, 0.0, gravity]
    force = _to_body(rotation_matrices(run.attitude), force)
    late_thrust = np.interp(run.time - delay, run.time, run.thrust)
    surplus = force - late_thrust[:, None] * np.array([0.0, 0.0, 1.0])
    columns = _recent_mean(run.time, surplus, MEMORY)
    if run.voltage is not None:
        columns = np.concatenate((run.voltage[:, None], columns), 1)
    return columns[np.searchsorted(run.time, starts + 1e-6, side="right") - 1]


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
