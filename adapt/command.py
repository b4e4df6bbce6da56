"""What all commands share: options, one-line errors, exit statuses, output folders."""

import contextlib
import errno
import io
import json
import math
import os
import re
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from envs.errors import InputError
from policies.files import whole

USAGE, INTERRUPTED, READER_GONE = 2, 130, 141  # exit statuses
DEFAULT_SYSTEM = "quadrotor"
FULL_OR_FORBIDDEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS, errno.EPERM)


def run(name, options, main):
    """Parse the command line into the dataclass `options` and call `main` with it; ends the process.

    Bad input ends in one line and status 2, Ctrl-C in one line and status 130.
    """
    os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")
    prefix = f"{name.split('.')[-1]}: "
    try:
        main(_parse(name, options))
        sys.stdout.flush()
    except InputError as error:
        sys.exit(_fail(prefix, str(error), USAGE))
    except KeyboardInterrupt as interrupt:
        sys.exit(_fail(prefix, f"interrupted; {interrupt}" if str(interrupt) else "interrupted", INTERRUPTED))
    except BrokenPipeError:  # the reader of what is printed has gone, as `head` does; the interpreter must not flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(READER_GONE)
    except OSError as error:
        if error.filename is None and error.errno not in FULL_OR_FORBIDDEN:  # no path of the user's: a fault of ours
            raise
        sys.exit(_fail(prefix, f"{error.filename or 'output'}: {error.strerror}; nothing half-written is kept", USAGE))


def _fail(prefix, message, status):
    print(prefix + " ".join(message.split()), file=sys.stderr)
    return status


def _parse(name, options):
    """tyro's own parsing, with its framed message folded to one line."""
    import tyro

    message = io.StringIO()
    try:
        with contextlib.redirect_stderr(message):
            return tyro.cli(options, prog=f"python -m {name}", config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as leaving:
        if leaving.code in (0, None):
            raise
    # The title is part of a frame, or in ASCII a line over dashes.
    untitled = re.sub(r"[╭╰][^\n]*|\A[^\n]*\n\s*-{4,}\s*\n", "", message.getvalue())
    paragraphs = re.split(r"[│|]?\s*[─-]{4,}[^\n]*", untitled)
    text = " ".join(re.sub(r"[│╭╮╯╰]", " ", paragraphs[0]).split()) or "bad options"
    raise InputError(f"{text} (see python -m {name} --help)")


def file_name(text, also=""):
    """A text as part of a file's name: what isn't a letter, a digit or one of -_.=, and `also` becomes a dash."""
    return "".join(c if c.isalnum() or c in f"-_.=,{also}" else "-" for c in text)


def output_folder(path, overwrite, outputs=()):
    """Make the folder of a run, or refuse one that already holds something.

    Of an earlier run that is overwritten, the `outputs` are removed: they must not be taken for those of this one.

    Raises:
        InputError: when it is in use and `overwrite` is off, or can't be written to.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file, expected a folder")
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise InputError(f"--out {folder}: already holds results; name another folder or add --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"--out {folder}: can't be written to ({error.strerror})") from None
    for name in outputs:
        (folder / name).unlink(missing_ok=True)
    return folder


def output_file(option, path, overwrite, example):
    """The file that an option names, or None if it names none.

    Raises:
        InputError: when it is a folder, is in use and `overwrite` is off, or its folder doesn't exist.
    """
    if path is None:
        return None
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder, expected a file name such as {path / example}")
    if path.exists() and not overwrite:
        raise InputError(f"{option} {path}: exists; name another file or add --overwrite")
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}")
    return path


def write_json(path, content):
    """Write JSON that people can read; a number that isn't finite becomes null, which JSON has a word for."""
    with whole(path) as partial:
        partial.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(content):
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def with_robot(options):
    """The options with `system` as the vehicle is one, or the quadrotor, where `--system` leaves it open.

    Raises:
        InputError: a vehicle that is unknown or can't be read.
    """
    if options.system is not None:
        return options
    if options.vehicle is None:
        return replace(options, system=DEFAULT_SYSTEM)
    from envs.vehicles import load_vehicle

    return replace(options, system=load_vehicle(options.vehicle).system.name)


def pick_robot(name, vehicle):
    """The system that `--system` and `--vehicle` name, and the vehicle or None.

    Raises:
        InputError: when either is unknown, or the vehicle is another kind of robot.
    """
    from envs.registry import make_system

    system = make_system(name)
    if vehicle is None:
        return system, None
    from envs.vehicles import load_vehicle

    own = load_vehicle(vehicle)
    if own.system.name != system.name:
        raise InputError(
            f"--vehicle {vehicle}: is a {own.system.name}, --system says {system.name}; leave --system out"
        )
    return own.system, own


def filmed(task, settings=()):
    """The task, seen through a camera with settings such as "height=64".

    Raises:
        InputError: a robot that can't be drawn, or a setting that makes no sense.
    """
    from envs.camera import SETTINGS, Camera

    if not task.system.drawn:
        raise InputError(f"--system {task.system.name}: can't be drawn, so no policy can see it; choose cartpole")
    changes = [tuple(item.partition("=")[::2]) for item in settings]
    for name, value in changes:
        if name not in SETTINGS or not value:
            raise InputError(f"--camera {name}: expected NAME=VALUE with one of {', '.join(SETTINGS)}")
    return replace(task, camera=Camera().changed(changes))


def pick_policy(path, system, vehicle, method="apg"):
    """The policy at `path`, or the one that ships for the robot.

    Raises:
        InputError: when there is none, or it was trained for another robot or by another method.
    """
    from policies import METHODS
    from policies.checkpoints import load_policy, pretrained

    if METHODS[method].pixels and not system.drawn:
        raise InputError(f"--system {system.name}: can't be drawn, so no policy can see it; choose cartpole")
    name = vehicle.name if vehicle else system.name
    if path is None and pretrained(name, method) is None:
        same = f"the same --{'vehicle' if vehicle else 'system'}" + ("" if method == "apg" else " and --method")
        advice = f"train one with python -m adapt.pretrain and {same}, then name its policy.safetensors"
        raise InputError(f"--policy: none ships for {name}{'' if method == 'apg' else f' by {method}'}; {advice}")
    return load_policy(path or name, system, method)


@contextlib.contextmanager
def interrupts_noted():
    """Put Ctrl-C and SIGTERM off to where a run is whole: yields a function that says whether one came.

    A second one ends the run where it is.
    """
    came = []

    def note(number, frame):
        if came:
            raise KeyboardInterrupt
        came.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def terminated_as_interrupted():
    """A block in which SIGTERM, which schedulers send before they kill, ends like Ctrl-C."""

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def flags(name, value):
    """An option as it is typed, in words: by its name alone if it is switched on, again for each of several values."""
    flag = f"--{name.replace('_', '-')}"
    return [flag] if value is True else [f"{flag} {part}" for part in (value if isinstance(value, tuple) else (value,))]


def check_seed(seed):
    """Refuse a seed that generators can't take.

    Raises:
        InputError: below 0, or of more than 63 bits.
    """
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed {seed}: expected between 0 and 2^63 - 1")


def set_threads(threads):
    """Threads for torch; small batches run fastest on one.

    Raises:
        InputError: when below 1.
    """
    import torch

    if threads < 1:
        raise InputError(f"--threads {threads}: expected at least 1")
    torch.set_num_threads(threads)


def pick_device(name):
    """A torch device by name.

    Raises:
        InputError: when this machine has none of that name.
    """
    import torch

    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # a device that holds no data, such as meta, fails here
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"--device {name}: not available here ({str(error).splitlines()[0]})") from None
    return device


def environment(seed, threads):
    """What a result depends on beside its options: seed, threads, versions, commit."""
    import platform
    import subprocess
    from importlib.metadata import version

    # The hash alone, even on a tag; "-dirty" where files differ from the commit.
    git = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent)]  # nothing is written to the repository
    command = [*git, "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:  # no git, no commit
        commit = ""
    packages = {name: version(name) for name in ("torch", "torchrl", "tensordict", "casadi")}
    return {"seed": seed, "threads": threads, "python": platform.python_version(), **packages, "commit": commit}
