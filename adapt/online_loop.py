"""Flying and learning at the same time, in simulated time.

A lesson that begins at time t is over at t + `latency`, whatever the machine needs for it: the flight waits for a
worker that is later, and a result that is earlier waits for its time. So the same seed gives the same flight on any
machine, and the seconds that lessons really took are told beside it: from when a lesson was asked for to its result,
with the wait for the worker, which carries a lesson that is given up to its end before it begins the next.
"""

import math
import multiprocessing
import os
import signal
import threading
import time as clock
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

from adapt.online_learning import Job, Settings, learn, training_episodes
from adapt.online_window import Window
from adapt.residual import MINIMUM
from envs.dynamics import Dynamics
from envs.errors import InputError

ROUNDING = 1e-9  # [s] by which sums of control periods may be off
KILLED = "the process that lessons run in was killed, perhaps as memory ran out"


@dataclass(frozen=True)
class Timing:
    """When is learned, and from how much [s]."""

    every: float = 0.5
    latency: float = 1.5
    window: float = 4.0

    def __post_init__(self):
        for name, least in (("every", "more than 0"), ("latency", "at least 0"), ("window", "more than 0")):
            value = getattr(self, name)
            if not (0 < value < math.inf or (name == "latency" and value == 0)):
                raise InputError(f"--{name} {value:g}: expected {least} seconds")

    def check(self, system):
        """Refuse a window that is too short for a fit.

        Raises:
            InputError: fewer control periods of the system than a fit needs transitions.
        """
        if self.window < (MINIMUM - 0.5) * system.dt:
            needed = f"a fit needs {MINIMUM} transitions, {MINIMUM * system.dt:g} s of {system.name}"
            raise InputError(f"--window {self.window:g}: {needed}")


class Learner:
    """Gives lessons to the policy that flies; takes each result at its time.

    Args:
        executor: that lessons are submitted to, see `background`.
    """

    def __init__(self, policy, executor, settings=Settings(), timing=Timing()):
        system = policy.task.system
        self.policy, self.executor, self.settings, self.timing = policy, executor, settings, timing
        self.source = Dynamics(system)
        self.window, self.residual, self.fitted_at = Window(system, timing.window), None, 0.0
        self.pending, self.lessons, self._next = None, [], timing.every
        self._asked, self._ended = 0.0, []

    def attend(self, time):
        """Take a result whose time has come, and begin a lesson if it is time for one; the new policy or None.

        A lesson that is under way when a change is noticed is given up: it is about a target that is no more.
        """
        new = self._take(time)
        if time + ROUNDING >= self._next:
            self._next += self.timing.every
            change = self.window.forget(self.residual or self.source)
            if change is not None and self.pending is not None:
                self.pending.cancel()
                self.pending, self.lessons[-1]["reason"] = None, f"given up: a change at {change:.4g} s was noticed"
            if self.pending is None and len(self.window) >= MINIMUM:
                self._begin(time)
        return new

    def _begin(self, time):
        stale = self.window.changed > self.fitted_at
        number = len(self.lessons)
        job = Job(self.policy, self.residual, stale, self.window.transitions(), number)
        self._asked, self._ended = clock.perf_counter(), (ended := [])
        self.pending = self.executor.submit(learn, job, self.settings)
        self.pending.add_done_callback(lambda _: ended.append(clock.perf_counter()))
        since = self.window.changed if self.window.changed > -math.inf else None
        rows = {"transitions": len(self.window), "change": since}
        self.lessons.append({"begun": time, "due": time + self.timing.latency, **rows})

    def _take(self, time):
        if self.pending is None or time + ROUNDING < self.lessons[-1]["due"]:
            return None
        lesson, self.pending = self.pending.result(), None
        seconds = min([*self._ended, clock.perf_counter()]) - self._asked  # a result is there just before its callback
        if lesson.fitted:
            self.residual, self.fitted_at = lesson.residual, self.lessons[-1]["begun"]
        verdict = lesson.verdict
        said = {"found": lesson.found, "accepted": lesson.policy is not None, "reason": lesson.reason}
        sure = {"confidence": verdict and verdict.confidence, "gain": verdict and verdict.gain}
        self.lessons[-1] |= said | sure | {"fitted": lesson.fitted, "seconds": seconds}
        if lesson.policy is None:
            return None
        self.policy = lesson.policy
        return self.policy


def fly(flight, policy, learner=None, stopped=lambda: False, progress=lambda: None, told=lambda lesson: None):
    """Fly to the end, or until `stopped()`, with the policy and what a learner makes of it; returns the last policy.

    Args:
        progress: called after each control period.
        told: called with each row of `learner.lessons` that brought a swap.
    """
    actor = policy.actor()
    while not flight.over and not stopped():
        if learner and (new := learner.attend(flight.time)):
            policy, actor = new, new.actor()
            told(next(row for row in reversed(learner.lessons) if row.get("accepted")))
        time = flight.time
        row = flight.advance(actor)
        if learner:
            learner.window.add(time, row)
        progress()
    return policy


@contextmanager
def background(policy, settings=Settings()):
    """A process that lessons run in, ready: what takes seconds to import, or to draw once, is there.

    Ctrl-C is left to the flight. SIGTERM ends the process, and so does the end of the one that began it.

    Raises:
        InputError: it was killed before it was ready.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _attach) as executor:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited: deaf to Ctrl-C while it still imports, too
        ready = executor.submit(training_episodes, policy.task, settings.episodes)
        signal.signal(signal.SIGINT, before)
        try:
            ready.result()
        except BrokenExecutor:
            raise InputError(f"{KILLED}; nothing was flown") from None
        yield executor


def _attach():
    """Make this process deaf to Ctrl-C, and let it end by SIGTERM or with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_follow, daemon=True).start()


def _follow():
    """Leave when the parent has ended, at once: a lesson would run on, and nobody waits for it."""
    multiprocessing.parent_process().join()
    os._exit(1)
