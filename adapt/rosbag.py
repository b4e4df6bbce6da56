"""ROS bags, read by rosbags without ROS: .bag of ROS 1; folder, .mcap or .db3 of ROS 2."""

import re
from dataclasses import fields as fields_of
from dataclasses import is_dataclass

import numpy as np
import pandas as pd

from adapt.log_topics import TopicLog, folded
from envs.errors import InputError

RECORDED = ("recorded", 1.0)  # [s] when the recorder got the message


def read_rosbag(path, wanted):
    """Some topics of a bag.

    Args:
        path: of the file, or of the folder with metadata.yaml.
        wanted: {topic: field names}, such as {"/odometry": {"pose.pose.position.x", "header.stamp"}}.

    Returns:
        `TopicLog`.

    Raises:
        InputError: when rosbags isn't installed, or the bag can't be read, is damaged, or doesn't define its messages.
    """
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError(f"{path}: cannot be read (a folder without metadata.yaml); give a log file or a ROS 2 bag")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        advice = "pip install 'apg-adapt[rosbag]'"
        raise InputError(f"{path.name}: rosbags, which reads it, is not installed; {advice}") from None
    try:
        if not path.is_dir():
            path.open("rb").close()
        # Bags of ROS 2 before Iron don't define their messages; the usual ones are known.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            return _read(bag, path, wanted)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give the path of a ROS bag") from None
    except Exception as error:  # from damaged bytes a parser gets into whatever trouble
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a ROS bag, or damaged ({reason})") from None


def _read(bag, path, wanted):
    connections = [one for one in bag.connections if one.topic in wanted]
    if unknown := [one for one in connections if one.msgtype not in bag.typestore.fielddefs]:
        raise InputError(
            f"{path.name}: topic {unknown[0].topic} is of type {unknown[0].msgtype}, which the bag doesn't define; "
            "record it as .mcap, or convert it with its message definitions"
        )
    paths = {topic: {name: _steps(name) for name in names} for topic, names in wanted.items()}
    found, fields = {}, {}
    for connection, nanoseconds, raw in bag.messages(connections) if connections else ():
        message, topic = bag.deserialize(raw, connection.msgtype), connection.topic
        if topic not in found:
            found[topic] = {name: [] for name in ("recorded", *sorted(wanted[topic] - {"recorded"}))}
            fields[topic] = folded(["recorded", *_leaves(message)])
        for name, values in found[topic].items():
            values.append(nanoseconds / 10**9 if name == "recorded" else _number(message, paths[topic][name]))
    messages = {topic: pd.DataFrame(columns, dtype=float).dropna(axis=1, how="all") for topic, columns in found.items()}
    return TopicLog(path.name, messages, fields, sorted({one.topic for one in bag.connections}), RECORDED)


def _steps(name):
    """The way to a field: "a.b[2]" is ("a", "b", 2)."""
    return tuple(int(number) if number else word for number, word in re.findall(r"\[(\d+)\]|([^.\[\]]+)", name))


def _number(message, path):
    """The number at the end of a path, of a stamp its seconds; NaN where there is none, as in a shorter array."""
    try:
        for step in path:
            message = message[step] if isinstance(step, int) else getattr(message, step)
        if hasattr(message, "nanosec"):
            return (message.sec * 10**9 + message.nanosec) / 10**9
        return float(message)
    except (AttributeError, IndexError, TypeError, ValueError):
        return np.nan


def _leaves(message, above=""):
    """Names of all numbers in a message, arrays by their elements."""
    for entry in fields_of(message):
        name, value = f"{above}{entry.name}", getattr(message, entry.name)
        if hasattr(value, "nanosec"):
            yield name
        elif is_dataclass(value):
            yield from _leaves(value, f"{name}.")
        elif isinstance(value, np.ndarray):
            yield from ((f"{name}[{i}]" for i in (0, len(value) - 1)) if len(value) else (name,))
        elif not isinstance(value, str | list) and not entry.name.startswith("__"):
            yield name
