"""A target that changes in mid-flight: `mass=x1.2@20` begins after 20 s, `wind=3` with the flight."""

import math
from dataclasses import dataclass
from itertools import groupby

from envs.domains import parse_target
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.registry import make_dynamics

DEFAULT = (("mass=x1.2", 1 / 3), ("wind=3", 2 / 3))  # what begins, and at which share of the flight


@dataclass(frozen=True)
class Phase:
    """From `begins` [s] on the robot is flown in `dynamics`; `items` are what changes then, as they were typed."""

    begins: float
    items: tuple[str, ...]
    dynamics: Dynamics

    @property
    def text(self):
        """What changes, in words."""
        return " ".join(self.items)


@dataclass(frozen=True)
class Schedule:
    """The phases of a flight one after another; the first begins with it."""

    phases: tuple[Phase, ...]

    def at(self, time):
        """The dynamics at a time [s]."""
        return [phase for phase in self.phases if phase.begins <= time + 1e-9][-1].dynamics

    @property
    def changes(self):
        """The phases that begin in mid-flight."""
        return self.phases[1:]


def default_items(seconds):
    """A payload and later a wind, each after a third of the flight: at 20 s and 40 s of a minute."""
    return tuple(f"{item}@{share * seconds:g}" for item, share in DEFAULT)


def parse_schedule(items, seconds, task):
    """Read `NAME=VALUE@SECONDS`, several, for a flight of so many seconds.

    What has begun stays, and each item is read as one that follows those before it: `mass=x1.2` twice is a factor of
    1.44, and a `wind=-3` takes a `wind=3` back.

    Raises:
        InputError: a time that is no number, below 0 or not within the flight; a target that can't be read; one that
            changes a picture, which a policy that sees the state has no use for.
    """
    timed = sorted((_timed(item, seconds) for item in items), key=lambda one: one[0])
    if not timed or timed[0][0] > 0:
        timed = [(0.0, ""), *timed]
    phases, begun = [], []
    for begins, group in groupby(timed, key=lambda one: one[0]):
        new = [item for _, item in group if item]
        begun += new
        domain = parse_target(begun, task.system)
        domain.seen(task)
        phases.append(Phase(begins, tuple(new), make_dynamics(task.system, domain)))
    return Schedule(tuple(phases))


def _timed(item, seconds):
    """(time [s], NAME=VALUE) of an item."""
    if "@" not in item:
        return 0.0, item
    name, _, text = item.rpartition("@")
    try:
        begins = float(text)
    except ValueError:
        begins = math.nan
    if not 0 <= begins < math.inf:
        raise InputError(f"--target {item}: {text!r} is no time; expected seconds from 0 on, such as {name}@20")
    if begins >= seconds:
        advice = f"expected less than --seconds {seconds:g}"
        raise InputError(f"--target {item}: begins after the end of the flight; {advice}")
    return begins, name
