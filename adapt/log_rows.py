"""The rows of a flight log in SI units and z-up axes: reading the table, converting units, frames and thrust."""

from typing import NamedTuple

import numpy as np
import pandas as pd

from envs.errors import InputError


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
    missed: np.ndarray | None = None  # (N,) bool, another topic of the log had no message near enough
    flagged: np.ndarray | None = None  # (N,) bool, a column that the mapping requires has another value

    def take(self, rows):
        """The same with the given rows only."""
        return Rows(*(None if values is None else values[rows] for values in self))


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
        values["velocity"] = to_world(rotation, values["velocity"])
    if frames["rates"] == "world":
        values["rates"] = to_body(rotation, values["rates"])
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
        flagged=_flagged(table, mapping, log),
    )


def _flagged(table, mapping, log):
    """Rows whose columns don't have the values that the mapping requires: (N,) bool, or None if it requires none."""
    flagged = None
    for column, good in mapping.require.items():
        wrong = ~table[column].isin(good).to_numpy()
        if wrong.all():
            values = table[column].dropna().unique()[:3]
            found = ", ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in values) or "empty"
            wanted = " or ".join(str(value) for value in good)
            raise InputError(f"{log}: {column} is {found} in all rows, mapping {mapping.name} requires {wanted}")
        flagged = wrong if flagged is None else flagged | wrong
    return flagged


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
    """Collective thrust per mass that the controller believes in [m/s^2] (N,), logged or by the thrust curve."""
    mass = vehicle.system.believed[0]
    if "thrust" in values:
        per_mass = mapping.quantities["thrust"].unit == "m/s^2"
        return values["thrust"][:, 0] / (1.0 if per_mass else mass)
    if vehicle.motors is None:
        raise InputError(f"{log}: motor commands need a thrust_curve; vehicle {vehicle.name} has no [motors] table")
    return vehicle.motors.force(values["motors"]).sum(1) / mass


def rotation_matrices(quaternion):
    """Body-to-world rotations (N, 3, 3) of quaternions (N, 4), scalar first."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True).clip(1e-12)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def to_world(rotation, vectors):
    """Vectors (N, 3) in world axes, from body axes, by body-to-world rotations (N, 3, 3)."""
    return np.einsum("nij,nj->ni", rotation, vectors)


def to_body(rotation, vectors):
    """Vectors (N, 3) in body axes, from world axes, by body-to-world rotations (N, 3, 3)."""
    return np.einsum("nji,nj->ni", rotation, vectors)
