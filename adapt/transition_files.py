"""Transitions in files: CSV for people, safetensors to be compact. The formats are described at `Transitions.load`."""

import csv
import json
import math

import torch

from envs.errors import InputError
from policies.files import read_safetensors

FORMAT = "apg-adapt transitions 1"


def by_suffix(path, for_csv, for_safetensors):
    """Which of the two a path asks for.

    Raises:
        InputError: an unknown suffix.
    """
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


def write_csv(transitions, path):
    """Write transitions, with a comment line that names system, control period and dtype."""
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


def read_csv(cls, path, system):
    """Make a `cls` (`Transitions`) of a CSV; `system` says what the first line does not.

    Raises:
        InputError: naming the file, and the row or column that is wrong.
        OSError: when it can\'t be opened.
    """
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


def write_binary(transitions, path):
    """Write transitions as tensors, and their names as JSON in the header."""
    from safetensors.torch import save

    names = ("state", "action", "next_state", "trajectory", "context")
    tensors = {name: getattr(transitions, name) for name in names if getattr(transitions, name) is not None}
    said = {
        name: getattr(transitions, name) for name in ("dt", "system", "state_names", "action_names", "context_names")
    }
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    path.write_bytes(save(tensors, {"format": FORMAT, "transitions": json.dumps(said)}))


def read_binary(cls, path, system):
    """Make a `cls` (`Transitions`) of what `write_binary` wrote; `system` is not needed.

    Raises:
        InputError: not such a file, or a damaged one.
        OSError: when it can't be opened.
    """
    tensors, said = read_safetensors(path, FORMAT, "transitions")
    names = {name: tuple(said[name]) for name in ("state_names", "action_names", "context_names")}
    parts = {name: tensors[name] for name in ("state", "action", "next_state", "trajectory")}
    return cls(**parts, dt=float(said["dt"]), system=said["system"], context=tensors.get("context"), **names)
