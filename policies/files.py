"""Files of ours: written whole or not at all, and tensors read without running code."""

import json
import os
from contextlib import contextmanager
from pathlib import Path

from envs.errors import InputError


@contextmanager
def whole(path):
    """A temporary name beside `path` that takes its place when the block ends well, and vanishes when it doesn't."""
    path = Path(path)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def replacing(path):
    """`whole` for a path that a user names: what can't be written is told in one line.

    Raises:
        InputError: when the file can't be written.
    """
    try:
        with whole(path) as partial:
            yield partial
    except OSError as error:
        raise InputError(f"{path}: can't write ({error.strerror or error}); name a writable place") from error


def read_text_table(path, columns, writer):
    """A CSV as text, so that what is written again is what was read; empty, with these columns, where there is no file.

    Raises:
        InputError: what can't be read, or lacks a column of what `writer` writes.
    """
    import pandas as pd

    if not path.is_file():
        return pd.DataFrame(columns=list(columns), dtype=str)
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: can't be read ({str(error).splitlines()[0]})") from None
    if missing := [column for column in columns if column not in table]:
        raise InputError(f"{path}: has no column {missing[0]}; expected what {writer} writes")
    return table


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
