"""`python -m adapt.online`: flying and learning in one command, and one line for whatever goes wrong."""

import json
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

import pandas as pd
import pytest

from adapt import command, online_loop, online_report
from adapt.online_learning import Lesson
from policies.checkpoints import load_policy

FILES = {"config.json", "metrics.json", "flight.csv", "swaps.csv", "policy.safetensors", "online.png"}


@pytest.fixture(autouse=True)
def lessons_in_this_process(monkeypatch):
    """Another process takes seconds to start, and gives the same."""

    class Here:
        def submit(self, learn, job, settings):
            done = Future()
            done.set_result(learn(job, settings))
            return done

    @contextmanager
    def here(policy, settings):
        yield Here()

    monkeypatch.setattr(online_loop, "background", here)


@pytest.fixture
def quick(quadrotor_file):
    """Options of a short flight of the rough quadrotor policy."""
    targets = ("--target", "mass=x1.2@2", "--target", "push=1")
    return ("--policy", quadrotor_file, *targets, "--seconds", 4, "--updates", 3, "--every", 1, "--latency", 1)


def read(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_it_leaves_everything_that_it_promises_and_nothing_else(call, quick, tmp_path):
    answer = call("online", *quick, "--out", tmp_path / "run")
    assert answer.status == 0, answer
    folder = tmp_path / "run"
    assert {path.name for path in folder.iterdir()} == FILES
    metrics, flight, swaps = read(folder), pd.read_csv(folder / "flight.csv"), pd.read_csv(folder / "swaps.csv")
    assert len(flight) == 40 and metrics["seconds"] == pytest.approx(4)
    assert metrics["target"] == [{"begins": 0, "what": "push=1"}, {"begins": 2, "what": "mass=x1.2"}]
    assert set(metrics["flights"]) == {"adapted", "unadapted", "undisturbed"}
    assert metrics["flights"]["adapted"]["error"] == pytest.approx(flight.error.mean(), rel=1e-6)
    assert metrics["learning"]["swaps"] == (swaps.accepted == True).sum() > 0  # noqa: E712
    assert "push_x" in swaps.found.dropna().iloc[0]
    assert "swapped; found push_x" in answer.out and "results in" in answer.out
    policy = load_policy(folder / "policy.safetensors")
    assert policy.info["finetuned_updates"] % 3 == 0 and policy.task.steps == 100


def test_the_same_seed_gives_the_same_flight(call, quick, tmp_path, monkeypatch):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    for name in "ab":
        call("online", *quick, "--seconds", 2.5, "--exploration", 0.1, "--out", tmp_path / name)
    assert (tmp_path / "a/flight.csv").read_bytes() == (tmp_path / "b/flight.csv").read_bytes()


def test_what_was_flown_is_kept_when_it_is_interrupted(call, quick, tmp_path, monkeypatch):
    @contextmanager
    def soon():
        asked = []
        yield lambda: len(asked) > 25 or asked.append(1)

    monkeypatch.setattr(command, "interrupts_noted", soon)
    answer = call("online", *quick, "--out", tmp_path / "run")
    assert answer.status == command.INTERRUPTED
    assert answer.errors[-1].startswith("online: interrupted; what was flown, 2.6 s, is in ")
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES
    assert len(pd.read_csv(tmp_path / "run/flight.csv")) == 26
    assert set(read(tmp_path / "run")["flights"]) == {"adapted"}


@pytest.fixture
def second_lesson_raises(monkeypatch):
    """Lessons of which the second ends in an error; the first finds nothing."""

    def set_up(error):
        class Fails:
            asked = 0

            def submit(self, learn, job, settings):
                self.asked, future = self.asked + 1, Future()
                if self.asked == 2:
                    future.set_exception(error)
                else:
                    future.set_result(Lesson(None, False, None, "the model explains what is flown"))
                return future

        @contextmanager
        def failing(policy, settings):
            yield Fails()

        monkeypatch.setattr(online_loop, "background", failing)

    return set_up


def test_what_was_flown_is_kept_when_the_process_of_the_lessons_is_killed(
    call, quick, tmp_path, second_lesson_raises, monkeypatch
):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    second_lesson_raises(BrokenProcessPool("gone"))
    answer = call("online", *quick, "--out", tmp_path / "run")
    assert answer.status == 2
    said = "online: the process that lessons run in was killed, perhaps as memory ran out; what was flown, 3 s, is in "
    assert answer.errors[-1].startswith(said)
    assert len(pd.read_csv(tmp_path / "run/flight.csv")) == 30
    metrics = read(tmp_path / "run")
    assert set(metrics["flights"]) == {"adapted"}
    assert (metrics["learning"]["lessons"], metrics["learning"]["unfinished"]) == (1, 1)


def test_what_was_flown_is_kept_when_a_lesson_ends_in_an_error_of_ours(
    call, quick, tmp_path, second_lesson_raises, monkeypatch
):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    second_lesson_raises(ZeroDivisionError("ours"))
    with pytest.raises(ZeroDivisionError, match="ours"):
        call("online", *quick, "--out", tmp_path / "run")
    assert len(pd.read_csv(tmp_path / "run/flight.csv")) == 30


def test_a_target_that_never_changes_is_flown_with_and_without_learning(call, quadrotor_file, tmp_path):
    options = ("--policy", quadrotor_file, "--target", "wind=1", "--seconds", 1)
    assert call("online", *options, "--out", tmp_path / "run").status == 0
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES
    assert set(read(tmp_path / "run")["flights"]) == {"adapted", "unadapted"}
    assert read(tmp_path / "run")["changes"] == []


def test_a_vehicle_says_what_robot_it_is(call, tmp_path, monkeypatch):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    answer = call("online", "--vehicle", "j3cub", "--seconds", 0.2, "--out", tmp_path / "run")
    assert answer.status == 0, answer
    assert json.loads((tmp_path / "run/config.json").read_text())["options"]["system"] == "fixed_wing"


def test_the_default_target_fits_into_any_flight(call, quadrotor_file, tmp_path, monkeypatch):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    options = ("--policy", quadrotor_file, "--seconds", 3, "--updates", 1)
    assert call("online", *options, "--out", tmp_path / "run").status == 0
    assert [one["begins"] for one in read(tmp_path / "run")["changes"]] == pytest.approx([1, 2])


def test_a_cart_that_balances_learns_too(call, tmp_path, monkeypatch):
    monkeypatch.setattr(online_report, "draw", lambda *_: None)
    options = ("--system", "cartpole", "--target", "push=0.5@1", "--updates", 2)
    assert call("online", *options, "--seconds", 3, "--latency", 0.5, "--out", tmp_path / "run").status == 0
    assert read(tmp_path / "run")["unit"] == "m/s"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--target", "mass=x1.2@soon"), "'soon' is no time"),
        (("--target", "mass=x1.2@61"), "begins after the end of the flight"),
        (("--seconds", 0), "--seconds 0: expected more than 0"),
        (("--seconds", 0.01), "--seconds 0.01: less than a control period, 0.1 s"),
        (("--seconds", "nan"), "--seconds nan: expected more than 0"),
        (("--every", 0), "--every 0: expected more than 0 seconds"),
        (("--window", 0.2), "--window 0.2: a fit needs 10 transitions, 1 s of quadrotor"),
        (("--updates", 0), "--updates 0: expected at least 1"),
        (("--exploration", 2), "--exploration 2: expected between 0 and 1"),
        (("--residual", "magic"), "--residual magic: expected one of auto, parameters"),
        (("--system", "boat"), "--system boat: expected one of cartpole"),
        (("--system", "cartpole", "--target", "thrust_loss=0.1@1"), "cartpole has no 'thrust_loss'"),
    ],
)
def test_what_makes_no_sense_is_told_in_one_line_before_anything_is_written(refused, tmp_path, options, said):
    assert said in refused("online", *options, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
