"""Flight logs to transitions of a vehicle's model: CSV, PX4 ULog, ROS bags.

read -> bring topics to one clock -> units and frames -> reject impossible rows -> cut the ground -> split into unbroken
runs -> control periods.
What a log lacks is stood in for: the thrust comes from motor commands, and body-rate commands, where they were not
logged, are those that would have led the vehicle's rate loop to the measured mean rates.

Context of a transition, from what was logged up to 0.15 s before the period begins:

| name                        | what                                                                           | unit  |
|-----------------------------|--------------------------------------------------------------------------------|-------|
| `voltage`                   | battery, where the log has it                                                  | V     |
| `force_x, force_y, force_z` | specific force beyond the commanded thrust, body axes, mean of the recent past | m/s^2 |

The force says what the model lacked a moment ago: a worn propeller, a sagging battery, a tilted attitude sensor. Hold
it constant when predicting ahead.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from adapt.control_periods import FORCE_NAMES, control_periods
from adapt.log_cleaning import REASONS, airborne, check_period, reject, unbroken_runs
from adapt.log_rows import convert
from adapt.log_topics import read_log
from adapt.transitions import Transitions
from envs.errors import InputError
from envs.quadrotor import Quadrotor
from envs.vehicles import Vehicle


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
    damaged: bool = False  # parts of the file could not be read

    def __str__(self):
        lines = [(f"{self.log} ({self.mapping})", ""), ("rows read", f"{self.rows}")]
        lines += [(f"  rejected: {reason}", f"{count}") for reason, count in self.rejected.items() if count]
        lines += [("  on the ground", f"{self.ground}"), ("  in no whole control period", f"{self.unused}")]
        lines += [("transitions", f"{self.transitions}"), ("  unbroken runs", f"{self.trajectories}")]
        lines += [("  beyond the action limits", f"{self.beyond_limits}"), ("seconds flown", f"{self.seconds:.1f}")]
        if self.damaged:
            lines[1:1] = [("damaged: what could be read of it", "")]
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
    """Read a flight log as transitions of `vehicle` over its control period.

    Args:
        path: CSV, PX4 ULog (.ulg), or ROS bag (.bag, .mcap, .db3, or the folder of a ROS 2 bag).
        vehicle: `Vehicle`; its limits decide which rows are possible.
        mapping: name or TOML file of the column mapping, see `adapt.mappings`; "auto" goes by the columns.

    Raises:
        InputError: naming the file, when the vehicle is no quadrotor, it cannot be read, its reader isn't installed,
            it lacks topics, fields or columns, is logged too slowly, or leaves nothing.
    """
    log = Path(path).name
    if not isinstance(vehicle.system, Quadrotor):  # what is logged becomes collective thrust and body-rate commands
        kind = vehicle.system.name
        raise InputError(f"{log}: flight logs are of quadrotors, {vehicle.name} is a {kind}; give --transitions of it")
    table, mapping, missed, damaged = read_log(path, mapping, vehicle.system.dt)
    rows = convert(table, mapping, vehicle, log)._replace(missed=missed)
    step_limit = check_period(rows.time, vehicle.system.dt, log)
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
    return _flight_log(log, mapping.name, damaged, vehicle, pieces, rejected, flying & possible, possible)


def _flight_log(log, mapping, damaged, vehicle, pieces, rejected, used, possible):
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
        damaged=damaged,
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
