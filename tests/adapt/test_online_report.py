"""What is told of a flight that learned: errors around each change, lessons, the picture."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from adapt.online_report import around, draw, running_mean, text, timing
from adapt.online_targets import parse_schedule
from envs import make_task

TASK = make_task("quadrotor")
SCHEDULE = parse_schedule(["mass=x1.2@10", "wind=3@20"], 30, TASK)


def table(*levels, seconds=10):
    """A flight whose error has these levels, each for so many seconds."""
    error = np.repeat(np.array(levels, dtype=float), seconds * 10)
    return pd.DataFrame({"time": 0.1 * np.arange(len(error)), "error": error})


def test_the_ratio_is_the_error_from_5_s_after_a_change_on_to_that_before_it():
    flown = table(0.01, 0.02, 0.03, seconds=12)
    flown.loc[:69, "error"] = 0.6  # older than what counts
    flown.loc[120:169, "error"] = 0.5  # 5 s in which it learns
    flown.loc[220:239, "error"] = 0.7  # later than what counts; the 2 s before the next change
    schedule = parse_schedule(["mass=x1.2@12", "wind=3@24"], 36, TASK)
    first, second = around(schedule, {"adapted": flown}, 0.1)
    assert (first["before"], first["after"], first["ratio"]) == pytest.approx((0.01, 0.02, 2.0))
    assert first["worst"] == pytest.approx(0.7)
    before = (3 * 0.02 + 2 * 0.7) / 5
    assert (second["before"], second["ratio"]) == pytest.approx((before, 0.03 / before))


def test_what_the_path_asks_for_is_taken_out_of_the_net_ratio():
    tables = {"adapted": table(0.01, 0.06, 0.06), "unadapted": table(1, 2, 3), "undisturbed": table(0.01, 0.04, 0.01)}
    first, second = around(SCHEDULE, tables, 0.1)
    assert (first["ratio"], first["path"], first["net"]) == pytest.approx((6.0, 4.0, 1.5))
    assert (second["path"], second["net"], second["unadapted"]) == pytest.approx((0.25, 4.0, 3.0))


def test_a_change_that_was_not_flown_long_enough_has_no_ratio():
    (only,) = around(parse_schedule(["mass=x1.2@5"], 30, TASK), {"adapted": table(0.01)}, 0.1)
    assert "ratio" not in only, "10 s are needed, 5 were flown"
    both = around(parse_schedule(["mass=x1.2@5", "wind=3@9"], 30, TASK), {"adapted": table(0.01, 0.02)}, 0.1)
    assert ["ratio" in one for one in both] == [False, True], "the first is followed by another after 4 s"
    assert around(SCHEDULE, {"adapted": table(0.01, seconds=3)}, 0.1)[1]["worst"] is None


def test_the_running_mean_is_that_of_the_last_second():
    mean = running_mean(np.r_[np.zeros(10), np.ones(20)], 0.1)
    assert mean[9:21].tolist() == pytest.approx([*np.arange(0, 1.05, 0.1), 1.0])


def test_lessons_that_took_too_long_are_counted():
    done = [{"accepted": True, "seconds": 1.0, "reason": ""}, {"accepted": False, "seconds": 3.0, "reason": ""}]
    said = timing([*done, {"reason": "given up"}, {"reason": "given up"}, {"due": 31.0}], 2.0)
    assert (said["lessons"], said["given_up"], said["unfinished"]) == (2, 2, 1)
    assert (said["swaps"], said["late"]) == (1, 1)
    assert (said["median_seconds"], said["most_seconds"]) == (2.0, 3.0)
    assert timing([], 2.0)["median_seconds"] is None


def test_the_tables_tell_every_change_and_the_time_that_lessons_took():
    tables = {"adapted": table(0.01, 0.02, 0.03), "unadapted": table(1, 2, 3), "undisturbed": table(0.01, 0.01, 0.01)}
    lessons = [{"accepted": True, "seconds": 1.0}]
    metrics = {
        "trace": "position error",
        "unit": "m",
        "flights": {name: {"error": float(one.error.mean()), "lost": 0} for name, one in tables.items()},
        "changes": around(SCHEDULE, tables, 0.1),
        "learning": timing(lessons, 2.0),
    }
    said = text(metrics)
    assert "mass=x1.2 at 10 s" in said and "wind=3 at 20 s" in said
    assert "1 lessons, 1 swaps; a lesson took 1.00 s in the median" in said
    assert "0 of 1 took longer than the 2 s" in said
    more = text(metrics | {"learning": timing([*lessons, {"reason": "given up"}, {"due": 31.0}], 2.0)})
    assert "1 lessons, 1 swaps, 1 given up, 1 unfinished at the end; a lesson took" in more
    empty = text(metrics | {"changes": [], "learning": timing([], 2.0)})
    assert "no lesson was finished" in empty


def test_a_flight_in_which_nothing_changes_has_no_ratios():
    assert around(parse_schedule(["wind=1"], 30, TASK), {"adapted": table(0.01)}, 0.1) == []


def test_the_picture_shows_the_flights_the_changes_and_the_swaps(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: (drawn.append(self), path.write_bytes(b"x")))
    tables = {"adapted": table(0.01, 0.02, 0.03), "unadapted": table(1, 2, 3)}
    lessons = [{"due": 13.0, "accepted": True}, {"due": 15.0, "accepted": False}, {"due": 31.0}]
    draw(tables, SCHEDULE, lessons, TASK, tmp_path / "online.png")
    (axes,) = drawn[0].axes
    lines = {line.get_label(): line for line in axes.lines}
    assert lines["policy swapped"].get_xdata().tolist() == [13.0]
    assert [one.get_text() for one in axes.texts] == ["mass=x1.2", "wind=3"]
    assert lines["learning"].get_ydata()[150] == pytest.approx(0.02)
    assert axes.get_xlabel() == "time [s]" and "position error [m]" in axes.get_ylabel()


def test_the_picture_is_a_file_even_of_a_flight_without_errors(tmp_path):
    draw({"adapted": table(0.0)}, SCHEDULE, [], TASK, tmp_path / "online.png")
    assert (tmp_path / "online.png").read_bytes().startswith(b"\x89PNG")
