"""Sweeps: what is needed comes first, one failure costs no other run, parts of an array cover everything once."""

import threading
import time
from pathlib import Path

import pytest

from adapt import sweep
from adapt.experiment_table import EXPERIMENTS

NAMES = ("apg-quadrotor", "drag-apg-quadrotor-30", "drag-mpc-quadrotor-30")
CHAIN = {(NAMES[0], 0): [], (NAMES[1], 0): [(NAMES[0], 0)], (NAMES[2], 0): [(NAMES[1], 0)]}


class Recorded:
    """An engine that writes down when runs begin and end, and fails where it is told to."""

    def __init__(self, fails=(), seconds=0.01):
        self.events, self.fails, self.seconds, self.stopped = [], fails, seconds, False

    def __call__(self, name, seed, root):
        self.events.append(("begin", name, seed))
        time.sleep(self.seconds)
        if name in self.fails:
            raise RuntimeError(f"{name}: broken")
        self.events.append(("end", name, seed))
        return {"error": 1.0}

    def stop(self):
        self.stopped = True


def carried_out(tasks, engine, jobs=2):
    rows = []
    failed = sweep.sweep(tasks, Path("x"), engine, jobs, lambda one, row: rows.append(one))
    return rows, failed


def test_a_planner_without_chance_has_one_seed():
    assert sweep.chosen(["mpc-cartpole", "apg-cartpole"], (0, 1, 2)) == [
        ("mpc-cartpole", 0),
        ("apg-cartpole", 0),
        ("apg-cartpole", 1),
        ("apg-cartpole", 2),
    ]


def test_what_others_need_is_done_first():
    engine = Recorded()
    rows, failed = carried_out(CHAIN, engine)
    assert rows == [(name, 0) for name in NAMES] and not failed
    assert [event[:2] for event in engine.events] == [(what, name) for name in NAMES for what in ("begin", "end")]


def test_independent_runs_go_on_side_by_side_up_to_the_number_of_jobs():
    tasks = {("apg-cartpole", seed): [] for seed in range(6)}
    most, going, lock = 0, 0, threading.Lock()

    def engine(name, seed, root):
        nonlocal most, going
        with lock:
            going += 1
            most = max(most, going)
        time.sleep(0.05)
        with lock:
            going -= 1
        return {"error": 0.0}

    rows, _ = carried_out(tasks, engine, jobs=3)
    assert sorted(rows) == sorted(tasks) and most == 3


def test_a_failure_leaves_out_what_needs_it_and_nothing_else():
    tasks = CHAIN | {("apg-cartpole", 0): []}
    rows, failed = carried_out(tasks, Recorded(fails=(NAMES[1],)))
    assert set(rows) == {(NAMES[0], 0), ("apg-cartpole", 0)}
    assert failed[NAMES[1], 0] == f"{NAMES[1]}: broken"
    assert failed[NAMES[2], 0] == f"{NAMES[2]} seed 0: left out, as {NAMES[1]} failed"


def test_an_interrupt_stops_the_engine_and_begins_nothing_more():
    tasks = {("apg-cartpole", seed): [] for seed in range(20)}
    engine = Recorded(seconds=0.02)

    def interrupt(one, row):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep.sweep(tasks, Path("x"), engine, 2, interrupt)
    assert engine.stopped
    assert len([event for event in engine.events if event[0] == "begin"]) < 10


def test_a_row_that_cannot_be_kept_ends_the_sweep():
    engine = Recorded(seconds=0.02)

    def full(one, row):
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        sweep.sweep({("apg-cartpole", seed): [] for seed in range(50)}, Path("x"), engine, 2, full)
    assert engine.stopped
    assert len([event for event in engine.events if event[0] == "begin"]) < 10


def test_the_plan_holds_what_is_not_done_and_what_it_needs():
    runs = [(name, 0) for name in NAMES]
    everything = sweep.plan(runs, lambda one: False, lambda one: False)
    assert everything == CHAIN
    done = {(NAMES[0], 0)}
    rest = sweep.plan(runs, lambda one: one in done, lambda one: one in done)
    assert rest == {(NAMES[1], 0): [], (NAMES[2], 0): [(NAMES[1], 0)]}


def test_a_policy_that_is_gone_is_trained_again_although_its_row_is_there():
    plan = sweep.plan([(NAMES[1], 0)], lambda one: one[0] == NAMES[0], lambda one: False)
    assert plan == {(NAMES[1], 0): [(NAMES[0], 0)], (NAMES[0], 0): []}


def test_nothing_is_planned_where_all_is_done():
    assert sweep.plan([(name, 0) for name in NAMES], lambda one: True, lambda one: False) == {}


def test_the_parts_of_an_array_cover_all_runs_once_and_keep_chains_together():
    runs = sweep.chosen([name for name in EXPERIMENTS if "drag" in name or "quadrotor" in name], range(3))
    parts = [sweep.part(runs, index, 4, lambda one: 1.0 + len(one[0]) / 7) for index in range(4)]
    assert sorted(one for part in parts for one in part) == sorted(runs)
    where = {one: index for index, part in enumerate(parts) for one in part}
    for name, seed in runs:
        for other in EXPERIMENTS[name].needs:
            if (other, seed) in where:
                assert where[other, seed] == where[name, seed], (name, other)


def test_the_parts_of_an_array_take_about_as_long():
    runs = [("apg-cartpole", seed) for seed in range(12)]
    minutes = lambda one: 1.0 + one[1]  # noqa: E731
    loads = [sum(map(minutes, sweep.part(runs, index, 3, minutes))) for index in range(3)]
    assert loads == [26, 26, 26]
