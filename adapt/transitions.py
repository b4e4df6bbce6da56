"""Transitions: what a robot did, as (state, action, next state) one control period apart.

They come from flying a policy in a target (`adapt.flying`) or from a flight log (`adapt.logs`), and are what a residual
is fitted to. Rows stand in order of time, one trajectory after another; two rows of a trajectory are neighbours only in
order, so a transition that was rejected may be missing between them.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from adapt.transition_files import by_suffix, read_binary, read_csv, write_binary, write_csv
from envs.errors import InputError
from policies.files import replacing

QUATERNION = ("qw", "qx", "qy", "qz")
QUATERNION_TOLERANCE = 1e-3  # [-] allowed error of a quaternion's length
DT_TOLERANCE = 1e-6  # [-] relative
LARGEST = 1e9  # [SI unit of the state] what no state of a robot exceeds


@dataclass(frozen=True)
class Transitions:
    """N transitions of one robot; units are those of its states, actions are in [-1, 1].

    Raises:
        InputError: shapes or names that don't fit each other.
    """

    state: Tensor  # (N, n)
    action: Tensor  # (N, m)
    next_state: Tensor  # (N, n)
    trajectory: Tensor  # (N,) int64, which flight a row belongs to
    dt: float  # [s] control period
    system: str
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    context: Tensor | None = None  # (N, c) what else a residual may depend on, such as the battery voltage
    context_names: tuple[str, ...] = ()

    def __post_init__(self):
        rows = len(self.trajectory)
        wanted = {
            "state": (self.state, self.state_names),
            "action": (self.action, self.action_names),
            "next_state": (self.next_state, self.state_names),
        }
        if self.context is not None or self.context_names:
            wanted["context"] = (self.context, self.context_names)
        for name, (tensor, names) in wanted.items():
            shape = None if tensor is None else tuple(tensor.shape)
            if shape != (rows, len(names)):
                raise InputError(
                    f"transitions: {name} is {shape}, expected {(rows, len(names))} for {', '.join(names)}"
                )

    def __len__(self):
        return len(self.trajectory)

    def select(self, rows):
        """Some of the rows: a mask (N,), indices, or a slice."""
        context = None if self.context is None else self.context[rows]
        parts = {name: getattr(self, name)[rows] for name in ("state", "action", "next_state", "trajectory")}
        return replace(self, **parts, context=context)

    def double(self):
        """The same in double precision."""
        context = None if self.context is None else self.context.double()
        parts = {name: getattr(self, name).double() for name in ("state", "action", "next_state")}
        return replace(self, **parts, context=context)

    def split(self, fraction, generator):
        """Two parts, the first with about `fraction` of the trajectories drawn at random, never less than one in each.

        A trajectory is never shared, because neighbouring rows are nearly copies. A single one has to be: it is cut
        once in time, its beginning goes to the first part.

        Raises:
            InputError: a fraction outside (0, 1), or fewer than two rows.
        """
        if not 0 < fraction < 1:
            raise InputError(f"split: fraction is {fraction:g}, expected between 0 and 1")
        if len(self) < 2:
            raise InputError(f"split: {len(self)} transitions, expected at least 2")
        flights = self.trajectory.unique()
        if len(flights) < 2:
            cut = min(max(1, round(fraction * len(self))), len(self) - 1)
            return self.select(slice(0, cut)), self.select(slice(cut, None))
        order = flights[torch.randperm(len(flights), generator=generator)]
        first = torch.isin(self.trajectory, order[: min(max(1, round(fraction * len(order))), len(order) - 1)])
        return self.select(first), self.select(~first)

    def save(self, path):
        """Write a `.csv` (for people) or a `.safetensors` (compact) file; `Transitions.load` gives the same numbers.

        Raises:
            InputError: an unknown suffix, or a place that can't be written.
        """
        path = Path(path)
        write = by_suffix(path, write_csv, write_binary)
        with replacing(path) as temporary:
            write(self, temporary)

    @classmethod
    def load(cls, path, system=None, minimum=1):
        """Read what `save` wrote, or a CSV made by hand.

        A CSV has the columns `trajectory`, one for each state, `action_` and the name of each action, `next_` and the
        name of each state, and optionally `context_...`; others are ignored. Lines that start with # are comments; the
        first one that `save` writes names the system and the control period, without it `system` says both.

        Args:
            system: the robot that is expected (a `System`); its names, control period and manifold are checked.
            minimum: how many rows are needed.

        Raises:
            InputError: missing or unreadable file, unknown suffix, missing column, a cell that is no finite number, too
                few rows, another system or control period, a quaternion that isn't a unit one.
        """
        path = Path(path)
        read = by_suffix(path, read_csv, read_binary)
        try:
            transitions = read(cls, path, system)
        except OSError as error:
            raise InputError(
                f"{path}: can't read transitions ({error.strerror or error}); name a file that exists"
            ) from error
        check(transitions, system, minimum, str(path))
        return transitions


def joined(parts):
    """Transitions of one robot one after another; trajectories of different parts stay apart."""
    first, names = parts[0], ("state", "action", "next_state")
    trajectory, begun = [], 0
    for part in parts:
        trajectory.append(part.trajectory - part.trajectory.min() + begun)
        begun = int(trajectory[-1].max()) + 1
    tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    context = None if first.context is None else torch.cat([part.context for part in parts])
    return replace(first, **tensors, trajectory=torch.cat(trajectory), context=context)


def check(transitions, system=None, minimum=1, source="transitions"):
    """Refuse transitions that nothing can be learned from, or that are of another robot than `system`.

    Raises:
        InputError: too few rows, another system, other names, another control period, a number that isn't finite or is
            too large, a quaternion that is no unit one.
    """
    if len(transitions) < minimum:
        raise InputError(f"{source}: {len(transitions)} transitions, at least {minimum} are needed; record more")
    if system is not None:
        _check_system(transitions, system, source)
    for part in ("state", "action", "next_state", "context"):
        values = getattr(transitions, part)
        if values is None:
            continue
        wrong = (~(values.abs() <= LARGEST)).any(-1).nonzero()  # a number that is none is no smaller either
        if len(wrong):
            row = int(wrong[0])
            largest = float(values[row].abs().max())
            said = f"as large as {largest:.3g}" if math.isfinite(largest) else "not finite"
            raise InputError(f"{source}: transition {row + 1}: {part} is {said}; remove the row")
    if set(QUATERNION) <= set(transitions.state_names):
        _check_quaternions(transitions, source)


def _check_system(transitions, system, source):
    if transitions.system != system.name:
        raise InputError(f"{source}: recorded on {transitions.system}, expected {system.name}")
    for kind, names, expected in (
        ("states", transitions.state_names, system.State._fields),
        ("actions", transitions.action_names, system.Action._fields),
    ):
        if tuple(names) != tuple(expected):
            raise InputError(f"{source}: {kind} are {', '.join(names)}; expected {', '.join(expected)}")
    if not math.isclose(transitions.dt, system.dt, rel_tol=DT_TOLERANCE):
        raise InputError(
            f"{source}: control period is {transitions.dt:g} s, expected {system.dt:g} s; "
            "resample, or set dt of the system"
        )


def _check_quaternions(transitions, source):
    columns = [transitions.state_names.index(name) for name in QUATERNION]
    for part in ("state", "next_state"):
        length = getattr(transitions, part)[:, columns].norm(dim=-1)
        wrong = ((length - 1).abs() > QUATERNION_TOLERANCE).nonzero()
        if len(wrong):
            row = int(wrong[0])
            said = f"{', '.join(QUATERNION)} of {part} have length {float(length[row]):.4g}"
            raise InputError(f"{source}: transition {row + 1}: {said}, expected a unit quaternion, scalar first")
