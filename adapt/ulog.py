"""PX4 flight logs (ULog), read by pyulog: https://docs.px4.io/main/en/dev_log/ulog_file_format.html"""

import contextlib
import io

import pandas as pd

from adapt.log_topics import TopicLog, folded
from envs.errors import InputError

RECORDED = ("timestamp", 1e-6)  # every message has it, microseconds since the start of the system


class _Asked:
    """The topics to keep, as pyulog asks for them; notes the names of all that were logged."""

    def __init__(self, names):
        self.names, self.met = names, set()

    def __contains__(self, name):
        self.met.add(name)
        return name in self.names


def read_ulog(path, wanted):
    """Some topics of a ULog file.

    Args:
        path: of the file.
        wanted: {topic: field names}; a topic is a name, or "name[1]" for its second instance.

    Returns:
        `TopicLog`.

    Raises:
        InputError: when pyulog isn't installed, or the file can't be read or is no ULog file.
    """
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(
            f"{path.name}: pyulog, which reads it, is not installed; pip install 'apg-adapt[ulog]'"
        ) from None
    asked = _Asked({topic.partition("[")[0] for topic in wanted})
    try:
        # pyulog prints what it thinks of a damaged file.
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
            content = ULog(file, message_name_filter_list=asked)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give the path of a ULog file") from None
    except Exception as error:  # from damaged bytes a parser gets into whatever trouble
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a ULog file, or damaged ({reason})") from None
    messages, fields = {}, {}
    for data in content.data_list:
        topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        if topic in wanted:
            fields[topic] = folded(data.data)
            names = [name for name in data.data if name in wanted[topic] or name == RECORDED[0]]
            messages[topic] = pd.DataFrame({name: data.data[name] for name in names})
    return TopicLog(path.name, messages, fields, sorted(asked.met), RECORDED, bool(content.file_corruption))
