"""Transitions: what a robot did, as (state, action, next state) one control period apart.

They come from flying a policy in a target (`collect`) or from a flight log, and are what a residual is fitted to. Rows
stand in order of time, one trajectory after another; two rows of a trajectory are neighbours only in order, so a
transition that was rejected may be missing between them.
"""

import csv
import json
import math
import os
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from envs.errors import InputError

FORMAT = "apg-adapt transitions 1"
QUATERNION = ("qw", "qx", "qy", "qz")
QUATERNION_TOLERANCE = 1e-3  # [-] allowed error of a quaternion's length
DT_TOLERANCE = 1e-6  # [-] relative


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
        write = _by_suffix(path, _write_csv, _write_safetensors)
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
        read = _by_suffix(path, _read_csv, _read_safetensors)
        try:
            transitions = read(cls, path, system)
        except OSError as error:
            raise InputError(
                f"{path}: can't read transitions ({error.strerror or error}); name a file that exists"
            ) from error
        check(transitions, system, minimum, str(path))
        return transitions


def check(transitions, system=None, minimum=1, source="transitions"):
    """Refuse transitions that nothing can be learned from, or that are of another robot than `system`.

    Raises:
        InputError: too few rows, another system, other names, another control period, a number that isn't finite, a
            quaternion that isn't a unit one. Rows count from 1.
    """
    if len(transitions) < minimum:
        raise InputError(f"{source}: {len(transitions)} transitions, at least {minimum} are needed; record more")
    if system is not None:
        _check_system(transitions, system, source)
    for part in ("state", "action", "next_state", "context"):
        values = getattr(transitions, part)
        if values is not None and not torch.isfinite(values).all():
            row = int((~torch.isfinite(values)).any(-1).nonzero()[0]) + 1
            raise InputError(f"{source}: row {row}: {part} is not finite; remove the row")
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
            raise InputError(
                f"{source}: row {row + 1}: {', '.join(QUATERNION)} of {part} have length {float(length[row]):.4g}, "
                "expected a unit quaternion, scalar first"
            )


# --- flying ---------------------------------------------------------------------------------------------------------


def collect(policy, env, n, exploration=0.0, generator=None):
    """Fly a policy in a target until `n` transitions are recorded; no gradient.

    Whole trajectories count one after another, the last one as far as it is needed: 1000 are ten flights of 100 steps,
    30 are the beginning of one. What follows the end of an episode isn't used.

    Args:
        policy: TensorDict module that reads `observation` and `window` and writes `action`.
        env: `TrackingEnv` of the target, or the (dynamics, task, episodes) to make one of. Its episodes are flown in
            random order, each again only after all others.
        exploration: standard deviation of Gaussian noise on the actions, which stay in [-1, 1].
        generator: draws episodes and noise; None is a fresh one with seed 0.

    Raises:
        InputError: `n` below 1, negative exploration, or a policy whose flights aren't finite.
    """
    if n < 1:
        raise InputError(f"collect: {n} transitions asked for, expected at least 1")
    if not 0 <= exploration < math.inf:
        raise InputError(f"collect: exploration is {exploration:g}, expected at least 0")
    if isinstance(env, tuple):
        from envs.env import TrackingEnv

        env = TrackingEnv(*env)
    generator = generator or torch.Generator().manual_seed(0)
    flights, missing, queue = [], n, []
    while missing > 0:
        count = math.ceil(missing / env.task.steps)
        while len(queue) < count:
            queue.extend(torch.randperm(len(env.episodes), generator=generator).tolist())
        flown = _fly(policy, env, queue[:count], min(missing, env.task.steps), exploration, generator)
        queue = queue[count:]
        if not any(len(state) for state, _, _ in flown):
            raise InputError(
                "collect: every flight failed at once; the policy or the target gives numbers that aren't finite"
            )
        for flight in flown:
            flights.append(tuple(part[:missing] for part in flight))
            missing -= len(flights[-1][0])
    return _joined([flight for flight in flights if len(flight[0])], env.dynamics.system)


@torch.no_grad()
def _fly(policy, env, episodes, steps, exploration, generator):
    """Fly episodes side by side: for each, (state, action, next_state) up to its end."""
    from tensordict import TensorDict
    from torchrl.envs.utils import step_mdp

    start = TensorDict({"episode": torch.tensor(episodes).unsqueeze(-1)}, batch_size=len(episodes), device=env.device)
    now, record = env.reset(start), []
    flying = torch.ones(len(episodes), dtype=torch.bool)
    for _ in range(steps):
        now = policy(now)
        noise = exploration * torch.randn(now["action"].shape, generator=generator).to(now["action"])
        now["action"] = (now["action"] + noise).clamp(-1, 1)
        now = env.step(now)
        rows = tuple(part.cpu() for part in (now["state"], now["action"], now["next", "state"]))
        flying = flying & torch.cat(rows, -1).isfinite().all(-1)
        record.append((*rows, flying))
        flying = flying & ~now["next", "done"].squeeze(-1).cpu()
        if not flying.any():
            break
        now = step_mdp(now)
    *parts, valid = (torch.stack(series, 1) for series in zip(*record, strict=True))
    return [tuple(part[i][valid[i]] for part in parts) for i in range(len(episodes))]


def _joined(flights, system):
    state, action, next_state = (torch.cat(parts) for parts in zip(*flights, strict=True))
    trajectory = torch.cat([torch.full((len(flight[0]),), i, dtype=torch.int64) for i, flight in enumerate(flights)])
    names = (system.State._fields, system.Action._fields)
    return Transitions(state, action, next_state, trajectory, system.dt, system.name, *names)


# --- files ----------------------------------------------------------------------------------------------------------


@contextmanager
def replacing(path):
    """A temporary path in the same folder that takes the place of `path` at the end, or disappears on an error.

    Raises:
        InputError: when the file can't be written.
    """
    path, temporary = Path(path), None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        os.close(handle)
        os.chmod(temporary, 0o644)  # mkstemp makes private files
        yield Path(temporary)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise InputError(f"{path}: can't write ({error.strerror or error}); name a writable place") from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def _by_suffix(path, for_csv, for_safetensors):
    table = {".csv": for_csv, ".safetensors": for_safetensors}
    if path.suffix not in table:
        raise InputError(f"{path}: unknown kind of file {path.suffix!r}; expected one of {', '.join(table)}")
    return table[path.suffix]


def _steps(trajectory):
    """Place of each row in its trajectory, from 0."""
    seen, steps = {}, []
    for flight in trajectory.tolist():
        steps.append(seen.get(flight, 0))
        seen[flight] = steps[-1] + 1
    return steps


def _write_csv(transitions, path):
    parts = [transitions.state, transitions.action, transitions.next_state]
    header = ["trajectory", "step", *transitions.state_names]
    header += [f"action_{name}" for name in transitions.action_names]
    header += [f"next_{name}" for name in transitions.state_names]
    if transitions.context is not None:
        parts.append(transitions.context)
        header += [f"context_{name}" for name in transitions.context_names]
    dtype = str(transitions.state.dtype).removeprefix("torch.")
    # A numpy scalar prints the shortest digits that read back as the same number of its type.
    columns = [column.astype(str) for part in parts for column in part.detach().cpu().T.contiguous().numpy()]
    steps = _steps(transitions.trajectory)
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"# {FORMAT}; system={transitions.system}; dt={transitions.dt!r} s; dtype={dtype}; SI units, ")
        file.write("angles in rad, actions in [-1, 1], next_... one dt after the state\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(transitions.trajectory.tolist(), steps, *columns, strict=True))


def _read_csv(cls, path, system):
    comment, names, rows = _csv_rows(path)
    said = dict(item.strip().split("=", 1) for item in comment.split(";") if "=" in item)
    if system is None and not {"system", "dt"} <= said.keys():
        raise InputError(f"{path}: the first line names no system and dt; say which system it is")
    state_names = _names(path, "states", [name for name in names if f"next_{name}" in names], system and system.State)
    action_names = _names(path, "actions", _prefixed(names, "action_"), system and system.Action)
    context_names = _prefixed(names, "context_")
    wanted = [*state_names, *(f"action_{n}" for n in action_names), *(f"next_{n}" for n in state_names)]
    wanted += [f"context_{n}" for n in context_names]
    if missing := [name for name in ("trajectory", *wanted) if name not in names]:
        expected = ", ".join(("trajectory", *wanted))
        raise InputError(f"{path}: no column {', '.join(missing)}; expected {expected}")
    dtype = {"float64": torch.float64}.get(said.get("dtype"), torch.float32)
    places = [names.index(name) for name in wanted]
    flights = _numbers(path, rows, names, [names.index("trajectory")])
    values = torch.tensor(_numbers(path, rows, names, places), dtype=dtype).reshape(len(rows), len(places))
    sizes = [len(state_names), len(action_names), len(state_names), len(context_names)]
    state, action, next_state, context = values.split(sizes, -1)
    trajectory = torch.tensor(flights, dtype=torch.float64).reshape(-1).to(torch.int64)
    dt = _period(path, said.get("dt"), system)
    name = said.get("system", system.name if system else "")
    context = context if context_names else None
    return cls(state, action, next_state, trajectory, dt, name, state_names, action_names, context, context_names)


def _csv_rows(path):
    """First comment line, header, and (line number, cells) of each row."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(number, line) for number, line in enumerate(file, 1) if line.strip()]
        comment = rows[0][1].lstrip("# ").rstrip() if rows and rows[0][1].startswith("#") else ""
        rows = [(number, line) for number, line in rows if not line.startswith("#")]
        cells = list(csv.reader([line for _, line in rows], skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV text file; expected a header and numbers") from error
    if not cells:
        raise InputError(f"{path}: empty; expected a header and one row for each transition")
    numbers = [number for number, _ in rows[1:]]
    return comment, [name.strip() for name in cells[0]], list(zip(numbers, cells[1:], strict=True))


def _prefixed(names, prefix):
    return tuple(name.removeprefix(prefix) for name in names if name.startswith(prefix))


def _names(path, kind, found, expected):
    """Names in a header; those of the expected system where one is given, so that what is missing can be named."""
    if expected is not None:
        return tuple(expected._fields)
    if not found:
        raise InputError(f"{path}: no columns of {kind}; expected such as px, action_thrust, next_px")
    return tuple(found)


def _numbers(path, rows, names, places):
    """The finite numbers in some columns of every row; the line of the file is named in errors."""
    table = []
    for line, cells in rows:
        try:
            values = [float(cells[place]) for place in places]
        except (ValueError, IndexError):
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            raise InputError(f"{path}: row {line}: {_fault(names, cells, places)}, expected a finite number")
        table.append(values)
    return table


def _fault(names, cells, places):
    """Which cell of a row is wrong."""
    for place in places:
        text = cells[place].strip() if place < len(cells) else ""
        try:
            good = math.isfinite(float(text))
        except ValueError:
            good = False
        if not good:
            return f"{names[place]} is {text!r}"
    return "the row is broken"


def _period(path, text, system):
    if text is None:
        return system.dt
    try:
        return float(text.removesuffix("s"))
    except ValueError:
        raise InputError(f"{path}: dt is {text!r} in the first line, expected such as dt=0.1 s") from None


def _write_safetensors(transitions, path):
    from safetensors.torch import save_file

    names = ("state", "action", "next_state", "trajectory", "context")
    tensors = {name: getattr(transitions, name) for name in names if getattr(transitions, name) is not None}
    said = {
        name: getattr(transitions, name) for name in ("dt", "system", "state_names", "action_names", "context_names")
    }
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    save_file(tensors, path, {"format": FORMAT, "transitions": json.dumps(said)})


def _read_safetensors(cls, path, system):
    tensors, said = read_safetensors(path, FORMAT, "transitions")
    names = {name: tuple(said[name]) for name in ("state_names", "action_names", "context_names")}
    parts = {name: tensors[name] for name in ("state", "action", "next_state", "trajectory")}
    return cls(**parts, dt=float(said["dt"]), system=said["system"], context=tensors.get("context"), **names)


def read_safetensors(path, expected, entry):
    """Tensors and the JSON `entry` of the header of a safetensors file of the `expected` format; never runs code.

    Raises:
        InputError: not a safetensors file, or one of another format.
        OSError: when it can't be opened.
    """
    from safetensors import SafetensorError, safe_open

    with Path(path).open("rb"):
        pass  # says why a file can't be opened; safetensors doesn't
    try:
        with safe_open(path, "pt") as file:
            said = file.metadata() or {}
            if said.get("format") != expected:
                raise InputError(f"{path}: holds {said.get('format', 'something else')!r}, expected {expected!r}")
            return {name: file.get_tensor(name) for name in file.keys()}, json.loads(said[entry])  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a safetensors file of {expected!r}, or a damaged one; write it again") from error
