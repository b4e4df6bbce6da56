"""Logs of topics, PX4 ULog and ROS bags, to one table on one clock.

A robot writes each topic at a rate of its own. The topic of the mapping's time column is the clock: one row a message.
What other topics measure (position, attitude, velocity, rates) is interpolated between the messages before and after a
row. What holds until the next message (commands, battery voltage, flags) is taken from the last one before it. Where no
message is near enough the row is rejected as "no message near enough".
"""

import difflib
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from adapt.log_rows import read_table
from adapt.mappings import choose_mapping, find_mappings
from envs.errors import InputError

KINDS = {".ulg": "ulog", ".bag": "rosbag", ".mcap": "rosbag", ".db3": "rosbag"}  # by suffix; a folder is a rosbag
MEASURED = ("position", "attitude", "velocity", "rates")
STATE_GAP = 1.5  # [control periods] messages of a measurement farther apart than this aren't interpolated between
COMMAND_GAP = 2.5  # [control periods] a command or flag older than this is taken to be lost
VOLTAGE_GAP = 10.0  # [s] a battery changes slowly and is logged slowly
LISTED = 30  # names that an error lists at most


class TopicLog(NamedTuple):
    """What was read of a log of topics."""

    log: str
    messages: dict[str, pd.DataFrame]  # of the topics asked for and there: a column for each field that is there
    fields: dict[str, list[str]]  # all field names of these topics
    topics: list[str]  # all topics of the log
    recorded: tuple[str, float]  # the field that every message has the time of recording in, and its unit [s]
    damaged: bool = False  # parts of the file could not be read

    @property
    def columns(self):
        """All that a mapping can name."""
        return {f"{topic}.{name}" for topic, frame in self.messages.items() for name in frame.columns}

    def lacks(self, columns):
        """What is missing and what there is instead, in words, for the first of `columns`."""
        topic, name = split(columns[0])
        if topic in self.messages:
            known = _nearest(name, self.fields[topic])
            return f"{columns[0]}; topic {topic} has no such field but {known}"
        return f"{columns[0]}; there is no message of topic {topic} but of {_nearest(topic, self.topics) or 'none'}"


class LogTable(NamedTuple):
    """A log as one table, the mapping that reads it, and what became of its topics."""

    table: pd.DataFrame  # (N rows)
    mapping: object
    missed: np.ndarray | None = None  # (N,) bool, whether another topic had no message near enough
    damaged: bool = False


def read_log(path, mapping, dt):
    """A flight log of any kind as one table.

    Args:
        path: CSV, .ulg, .bag, .mcap, .db3, or the folder of a ROS 2 bag.
        mapping: "auto", the name of a built-in mapping, or the path of a TOML file.
        dt: control period [s]; topics must come often enough for it.

    Raises:
        InputError: naming the file, when it can't be read, its reader isn't installed, or the mapping doesn't fit it.
    """
    path = Path(path)
    kind = "rosbag" if path.is_dir() else KINDS.get(path.suffix.lower(), "csv")
    candidates = find_mappings(mapping, kind)
    if kind == "csv":
        table = read_table(path)
        return LogTable(table, choose_mapping(candidates, list(table.columns), path.name))
    wanted = {}
    for candidate in candidates:
        clock = split(candidate.quantities["time"].columns[0])[1]
        for topic, name in map(split, candidate.columns):
            wanted.setdefault(topic, set()).update((name, clock))
    source = _reader(kind)(path, wanted)
    chosen = choose_mapping(candidates, source.columns, source.log, source.lacks)
    table, missed = on_one_clock(source, chosen, dt)
    return LogTable(table, chosen, missed, source.damaged)


def _reader(kind):
    if kind == "ulog":
        from adapt.ulog import read_ulog

        return read_ulog
    from adapt.rosbag import read_rosbag

    return read_rosbag


def split(column):
    """Topic and field of a column such as "vehicle_attitude.q[0]"."""
    topic, _, name = column.partition(".")
    return topic, name


def on_one_clock(source, mapping, dt):
    """The columns of a mapping, a row for each message of the clock's topic.

    Args:
        source: `TopicLog` that holds all columns of the mapping.
        mapping: `Mapping`.
        dt: control period [s].

    Returns:
        The table (N rows), and (N,) bool, whether another topic had no message near enough.

    Raises:
        InputError: when a topic comes too seldom or at other times than the clock, or is of two recordings.
    """
    column = mapping.quantities["time"].columns[0]
    clock_topic, _ = split(column)
    clock = _seconds(source, clock_topic, mapping)
    _check_order(clock, clock_topic, source.log)
    table = {column: source.messages[clock_topic][split(column)[1]].to_numpy(float)}
    missed = np.zeros(len(clock), bool)
    for quantity, topic, names, longest in _parts(mapping, dt):
        values = source.messages[topic][names].to_numpy(float)
        if topic != clock_topic:
            time = _seconds(source, topic, mapping)
            _check_order(time, topic, source.log)
            values, near = _brought(time, values, clock, longest, quantity)
            if not near.any():
                raise InputError(_never_near(source.log, topic, time, clock_topic, clock, longest))
            missed |= ~near
        table |= {f"{topic}.{name}": values[:, i] for i, name in enumerate(names)}
    return pd.DataFrame(table), missed


def _parts(mapping, dt):
    """(quantity, topic, field names, longest time [s] that a message stands for) of all but the time."""
    groups = {name: quantity.columns for name, quantity in mapping.quantities.items() if name != "time"}
    for quantity, columns in (*groups.items(), ("require", mapping.require)):
        gap = STATE_GAP * dt if quantity in MEASURED else VOLTAGE_GAP if quantity == "voltage" else COMMAND_GAP * dt
        for topic in dict.fromkeys(split(column)[0] for column in columns):
            yield quantity, topic, [name for other, name in map(split, columns) if other == topic], gap


def _seconds(source, topic, mapping):
    """Times of a topic's messages [s]: the field that the mapping's clock has, or else the time of recording."""
    time = mapping.quantities["time"]
    frame, name = source.messages[topic], split(time.columns[0])[1]
    recorded, unit = source.recorded
    return frame[name].to_numpy(float) * time.factor if name in frame else frame[recorded].to_numpy(float) * unit


def _check_order(time, topic, log):
    """Refuse two recordings in one: sorted by time, their messages would be mixed. Single wrong times are no matter."""
    order = np.argsort(time, kind="stable")
    if (np.abs(np.diff(order)) > 10).sum() > 10:
        back = int(np.argmin(np.diff(time))) + 1
        raise InputError(
            f"{log}: topic {topic} goes back in time by {time[back - 1] - time[back]:g} s at message {back}, as if the "
            "clock had been set or a simulation restarted; cut the log there, or align it by the time of recording"
        )


def _brought(time, values, clock, longest, quantity):
    """Values (n, k) of messages at `time` (n,), at the times `clock` (N,): (N, k), and where one was near (N,) bool."""
    order = np.argsort(time, kind="stable")
    order = order[np.isfinite(time[order])]
    order = order[np.append(np.diff(time[order]) > 0, [True] * min(1, len(order)))]  # of one time the last
    if not len(order):
        return np.full((len(clock), values.shape[1]), np.nan), np.zeros(len(clock), bool)
    time, values = time[order], values[order]
    if quantity == "attitude" and values.shape[1] == 4:
        values = _one_sign(values)
    before = np.searchsorted(time, clock, side="right") - 1  # -1 where there is none yet
    past = np.maximum(before, 0)
    age = clock - time[past]
    if quantity not in MEASURED:
        near = (before >= 0) & (age <= longest)
        return np.where(near[:, None], values[past], np.nan), near
    after = np.minimum(past + 1, len(time) - 1)
    step = time[after] - time[past]
    near = (before >= 0) & ((age == 0) | ((age <= step) & (step <= longest)))
    share = np.divide(age, step, out=np.zeros(len(clock)), where=near & (age > 0))[:, None]
    between = (1 - share) * values[past] + share * values[after]
    if quantity == "attitude" and values.shape[1] == 4:  # the chord lies inside the sphere of unit quaternions
        size = np.linalg.norm(values, axis=1)
        wanted = (1 - share[:, 0]) * size[past] + share[:, 0] * size[after]
        between *= (wanted / np.linalg.norm(between, axis=1).clip(1e-12))[:, None]
    between = np.where(share > 0, between, values[past])  # at a message its very values, whatever comes next
    return np.where(near[:, None], between, np.nan), near


def _one_sign(quaternion):
    """The same attitudes (n, 4) without changes of sign from one to the next."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(1) < 0, -1.0, 1.0)
    return quaternion * np.cumprod(np.append([1.0], flips))[:, None]


def _never_near(log, topic, time, clock_topic, clock, longest):
    step = np.median(np.diff(time)) if len(time) > 1 else np.inf
    if step > longest:
        return f"{log}: topic {topic} comes every {step:g} s, expected at most {longest:g} s; log it faster"
    return (
        f"{log}: topic {topic} was sent at {np.nanmin(time):.3f} to {np.nanmax(time):.3f} s, {clock_topic} at "
        f"{np.nanmin(clock):.3f} to {np.nanmax(clock):.3f} s, never together; align them by the time of recording"
    )


def _nearest(name, names):
    """The names, the most alike first; of many the first few."""
    alike = sorted(names, key=lambda other: -difflib.SequenceMatcher(None, name, other).ratio())
    more = f" and {len(alike) - LISTED} more" if len(alike) > LISTED else ""
    return ", ".join(alike[:LISTED]) + more


def folded(names):
    """Field names with the elements of an array as one: q[0], q[1], q[2] become q[0..2]."""
    counts = {}
    for name in names:
        stem, number = re.fullmatch(r"(.*?)(?:\[(\d+)\])?", name).groups()
        counts[stem] = max(counts.get(stem, -1), -1 if number is None else int(number))
    return [stem if last < 0 else f"{stem}[0..{last}]" for stem, last in counts.items()]
