"""References through waypoints that a user wrote into a CSV file."""

import csv
import itertools
import math
from pathlib import Path

import torch
from torch import Tensor

from envs.errors import InputError
from envs.flatness import POSITION
from envs.minimum_snap import minimum_snap
from envs.shapes import Device, sample_times

COLUMNS = ("t", "x", "y", "z")
WAYPOINTS_MAX = 1000  # the closed form is dense: 1000 take about a second


def read_waypoints(
    path: Path | str, *, steps: int, dt: float, dtype: torch.dtype | None = None, device: Device = None
) -> Tensor:
    """Minimum-snap polynomial through the waypoints of a CSV file, at rest at both ends, `(1, steps, 12)`.

    The file has the columns t [s], x, y, z [m] (world, z up), one waypoint a row at increasing, not necessarily even
    times; other columns are ignored. The reference begins at the first row, wherever its clock starts, and holds the
    last point after the end. Nothing checks that a vehicle can fly it: see `feasible`.

    Raises:
        InputError: no such file, not a CSV, a missing column, a cell that isn't a finite number, time that doesn't
            increase, too few or too many rows, times too uneven to solve.
    """
    times = sample_times(steps, dt)
    table = _read_table(Path(path))
    knots, waypoints = table[:, 0] - table[0, 0], table[:, 1:]
    flat = (minimum_snap(knots, times.clamp(max=knots[-1]), rest=True) @ waypoints).flatten(1)
    after = times >= knots[-1]
    flat[after, POSITION] = waypoints[-1]
    flat[after, 3:] = 0.0
    return flat[None].to(device or "cpu", dtype or torch.get_default_dtype())


def _read_table(path: Path) -> Tensor:
    """The columns t, x, y, z of a file as `(K, 4)` float64."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            names = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except OSError as error:
        raise InputError(f"{path}: can't read waypoints ({error.strerror}); name a CSV file with t,x,y,z") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV text file; expected a header t,x,y,z and numbers") from error
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}; the first row must name t,x,y,z [s, m]")
    if not 2 <= len(rows) <= WAYPOINTS_MAX:
        raise InputError(f"{path}: {len(rows)} waypoints, expected 2 to {WAYPOINTS_MAX}; add rows or thin the file")
    places = {name: names.index(name) for name in COLUMNS}
    table = [[_number(path, row, name, cells, at) for name, at in places.items()] for row, cells in rows]
    for i in range(1, len(table)):
        if table[i][0] <= table[i - 1][0]:
            raise InputError(
                f"{path}: row {rows[i][0]}: t is {table[i][0]:g} after {table[i - 1][0]:g}; it must increase"
            )
    _check_spacing(path, [here[0] - before[0] for before, here in itertools.pairwise(table)])
    return torch.tensor(table, dtype=torch.float64)


def _check_spacing(path: Path, durations: list[float]) -> None:
    """What is so uneven loses its digits in the solution, whose terms go with the seventh power of a duration."""
    short, long = min(durations), max(durations)
    if short < 1e-6 or long > 1e6 or long > 1e4 * short:
        raise InputError(
            f"{path}: the times between waypoints run from {short:g} to {long:g} s; "
            "expected 1e-6 to 1e6 s, and nowhere 10000 times the shortest: space them more evenly"
        )


def _number(path: Path, row: int, name: str, cells: list[str], at: int) -> float:
    """The finite number in a cell; `row` counts lines of the file, its header is row 1."""
    text = cells[at].strip() if at < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: row {row}: {name} is {text!r}, expected a finite number")
    return value
