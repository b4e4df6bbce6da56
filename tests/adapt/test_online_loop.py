"""Flying and learning at the same time: when lessons begin, and when their results are flown."""

import copy
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import pytest

from adapt import online_loop
from adapt.online_flight import ContinuousFlight
from adapt.online_learning import Lesson, Settings
from adapt.online_loop import Learner, Timing, background, fly
from adapt.online_targets import parse_schedule
from envs.errors import InputError


class Scripted:
    """An executor that keeps the jobs it gets and answers with prepared lessons."""

    def __init__(self, answer):
        self.answer, self.jobs = answer, []

    def submit(self, learn, job, settings):
        self.jobs.append(job)
        done = Future()
        done.set_result(self.answer(job))
        return done


def refused(job):
    return Lesson(None, False, None, "the model explains what is flown")


def still(policy):
    """The policy with all weights at zero, whose action is always the same."""
    network = copy.deepcopy(policy.network)
    for weights in network.parameters():
        weights.data.zero_()
    return replace(policy, network=network)


@pytest.fixture
def run(rough_quadrotor):
    def fly_with(answer, items=(), periods=60, seed=0, **timing):
        flight = ContinuousFlight(rough_quadrotor.task, parse_schedule(items, 1e3, rough_quadrotor.task), periods)
        executor = Scripted(answer)
        learner = Learner(rough_quadrotor, executor, Settings(), Timing(**timing))
        last = fly(flight, rough_quadrotor, learner)
        return flight, learner, executor, last

    return fly_with


def test_lessons_begin_every_so_often_and_none_before_the_last_is_over(run):
    assert [one["begun"] for one in run(refused, every=1.0, latency=0.5)[1].lessons] == pytest.approx([1, 2, 3, 4, 5])
    assert [one["begun"] for one in run(refused, every=1.0, latency=2.0)[1].lessons] == pytest.approx([1, 3, 5])
    assert [one["begun"] for one in run(refused, every=2.5, latency=0.5)[1].lessons] == pytest.approx([2.5, 5])


def test_a_lesson_has_the_newest_window_and_a_first_one_waits_for_enough_transitions(run):
    _, learner, executor, _ = run(refused, every=0.5, latency=0.5, window=2.0)
    assert [one["begun"] for one in learner.lessons][:3] == pytest.approx([1, 1.5, 2])
    assert [len(job.window) for job in executor.jobs][:4] == [10, 15, 20, 20]


def test_a_new_policy_flies_from_the_end_of_its_lesson_on_and_not_before(run, rough_quadrotor):
    zero = still(rough_quadrotor)
    flight, learner, executor, last = run(lambda job: Lesson(None, False, zero, "better"), latency=2.0)
    plain = run(refused)[0].table()
    table = flight.table()
    assert table[:30].equals(plain[:30])
    assert (table.action_thrust[30:] == table.action_thrust[30]).all(), "the still policy flies from 3 s on"
    assert not (plain.action_thrust[30:] == plain.action_thrust[30]).all()
    assert last.network is zero.network and learner.lessons[0]["accepted"]
    assert executor.jobs[1].flying.network is zero.network


def test_a_lesson_under_way_when_a_change_is_noticed_is_given_up(run):
    _, learner, executor, _ = run(refused, ["mass=x1.2@3.0"], every=1.0, latency=2.0)
    assert [one["begun"] for one in learner.lessons] == pytest.approx([1, 3, 4])
    assert learner.lessons[1]["reason"] == "given up: a change at 3 s was noticed"
    assert learner.lessons[2]["change"] == pytest.approx(3.0) and len(executor.jobs[2].window) == 10
    assert [job.stale for job in executor.jobs] == [False, False, True]


def test_the_seconds_of_a_lesson_are_those_from_when_it_was_asked_for_to_its_result(rough_quadrotor):
    class Busy:
        """An executor whose worker is busy for 0.2 s before it begins, as with a lesson that was given up."""

        def submit(self, learn, job, settings):
            future = Future()
            threading.Timer(0.2, lambda: future.set_result(refused(job))).start()
            return future

    flight = ContinuousFlight(rough_quadrotor.task, parse_schedule([], 10, rough_quadrotor.task), 25)
    learner = Learner(rough_quadrotor, Busy(), Settings(), Timing(every=1.0, latency=0.5))
    fly(flight, rough_quadrotor, learner, progress=lambda: time.sleep(0.1) if 15 > flight.period > 10 else None)
    assert 0.2 <= learner.lessons[0]["seconds"] < 0.38, "0.4 s were flown before the result was taken"


def test_a_residual_from_after_the_change_is_not_stale(run, rough_quadrotor):
    from adapt.parameter_residual import ParameterResidual
    from adapt.residual_dynamics import ResidualConfig
    from envs.dynamics import Dynamics

    config = ResidualConfig("parameters", 0, parameters=("mass",), factors=())
    heavy = ParameterResidual(Dynamics(rough_quadrotor.task.system), config)
    heavy.values[:] = 1.2 * 0.723
    jobs = run(lambda job: Lesson(heavy, job.residual is None, None, ""), ["mass=x1.2@2.0"], latency=1.0)[2].jobs
    assert [job.stale for job in jobs][-1] is False and jobs[-1].residual is heavy


def test_a_flight_can_be_stopped(rough_quadrotor):
    flight = ContinuousFlight(rough_quadrotor.task, parse_schedule([], 10, rough_quadrotor.task), 100)
    fly(flight, rough_quadrotor, stopped=lambda: flight.period == 7)
    assert len(flight.table()) == 7


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"every": 0.0}, "--every 0: expected more than 0 seconds"),
        ({"latency": -1.0}, "--latency -1: expected at least 0 seconds"),
        ({"window": float("inf")}, "--window inf: expected more than 0 seconds"),
    ],
)
def test_times_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(InputError) as error:
        Timing(**settings)
    assert str(error.value) == said


def test_a_window_too_short_for_a_fit_is_refused(rough_quadrotor):
    system = rough_quadrotor.task.system
    Timing(window=1.0).check(system)
    with pytest.raises(InputError, match=r"--window 0.9: a fit needs 10 transitions, 1 s of quadrotor"):
        Timing(window=0.9).check(system)


PARENT = """
import multiprocessing, time
from adapt import online_loop

def work(pipe):
    online_loop._attach()
    pipe.send("ready")
    time.sleep(60)

def begun():
    here, there = multiprocessing.Pipe()
    process = context.Process(target=work, args=(there,))
    process.start()
    here.recv()
    print(process.pid, flush=True)
    return process

context = multiprocessing.get_context("fork")
first = begun()
input()
first.join(10)
print(first.exitcode, flush=True)
begun()
time.sleep(60)
"""


def test_a_worker_leaves_ctrl_c_to_the_flight_and_ends_by_sigterm_or_with_its_parent():
    pipes = {
        "stdin": subprocess.PIPE,
        "stdout": subprocess.PIPE,
        "text": True,
        "cwd": Path(online_loop.__file__).parents[1],
    }
    with subprocess.Popen([sys.executable, "-c", PARENT], **pipes) as parent:
        first = int(parent.stdout.readline())
        os.kill(first, signal.SIGINT)
        time.sleep(0.2)
        os.kill(first, signal.SIGTERM)
        print(file=parent.stdin, flush=True)
        assert int(parent.stdout.readline()) == -signal.SIGTERM
        second = int(parent.stdout.readline())
        parent.kill()
        try:
            parent.communicate(timeout=10)  # ends when nobody can write any more
        except subprocess.TimeoutExpired:
            os.kill(second, signal.SIGKILL)
            pytest.fail("the worker outlived its parent")


@pytest.mark.slow
def test_another_process_gives_the_same_flight_as_this_one(rough_quadrotor):
    settings = Settings(updates=3, episodes=20, tests=4, periods=20)

    class Here:
        def submit(self, learn, job, settings):
            done = Future()
            done.set_result(learn(job, settings))
            return done

    def flown(executor):
        schedule = parse_schedule(["mass=x1.2@1"], 10, rough_quadrotor.task)
        flight = ContinuousFlight(rough_quadrotor.task, schedule, 60)
        learner = Learner(rough_quadrotor, executor, settings, Timing(latency=1.0))
        fly(flight, rough_quadrotor, learner)
        return flight.table(), [one.get("accepted") for one in learner.lessons]

    with background(rough_quadrotor, settings) as executor:
        there, accepted = flown(executor)
    here, same = flown(Here())
    assert there.equals(here)
    assert accepted == same and any(accepted)
