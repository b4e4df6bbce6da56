"""Topics of different rates on one clock: what is interpolated, what is held, and what is told."""

import numpy as np
import pandas as pd
import pytest

from adapt.log_topics import TopicLog, folded, on_one_clock
from adapt.mappings import parse_mapping
from envs.errors import InputError

DT = 0.1
TABLES = {
    "time": {"columns": ["clock.t"], "unit": "s"},
    "position": {"columns": ["place.x", "place.y", "place.z"], "unit": "m"},
    "attitude": {"columns": [f"turn.q[{i}]" for i in range(4)]},
    "velocity": {"columns": ["clock.vx", "clock.vy", "clock.vz"], "unit": "m/s"},
    "rates": {"columns": ["clock.p", "clock.q", "clock.r"], "unit": "rad/s"},
    "motors": {"columns": ["motors.m"]},
    "voltage": {"columns": ["battery.v"], "unit": "V", "optional": True},
    "require": {"place.good": [1]},
}
MAPPING = parse_mapping(TABLES, "own")


def frame(time, **columns):
    columns = {name: np.broadcast_to(values, np.shape(time)) for name, values in columns.items()}
    return pd.DataFrame({"t": np.asarray(time, float), **columns})


def turned(angle):
    """Turned by angles (n,) about the vertical, as columns."""
    return {"q[0]": np.cos(angle / 2), "q[1]": 0.0, "q[2]": 0.0, "q[3]": np.sin(angle / 2)}


def source(clock=None, **given):
    """A log of 1 s: the clock at 100 Hz, places at 20 Hz, attitudes at 25 Hz, motors at 10 Hz, a battery once."""
    clock = np.arange(101) / 100 if clock is None else clock
    at = {"place": np.arange(21) / 20, "turn": np.arange(26) / 25, "motors": np.arange(11) / 10, "battery": [0.0]}
    messages = {
        "clock": frame(clock, **dict.fromkeys(("vx", "vy", "vz", "p", "q", "r"), 0.5)),
        "place": frame(at["place"], x=3 * at["place"], y=1.0, z=2.0, good=1),
        "turn": frame(at["turn"], **turned(8 * at["turn"])),
        "motors": frame(at["motors"], m=np.arange(11.0)),
        "battery": frame(at["battery"], v=3.7),
    } | given
    fields = {topic: list(table.columns) for topic, table in messages.items()}
    return TopicLog("a.log", messages, fields, list(messages), ("t", 1.0))


def test_measurements_are_interpolated_and_commands_are_held():
    table, missed = on_one_clock(source(), MAPPING, DT)
    time = table["clock.t"].to_numpy()
    assert len(table) == 101 and not missed.any()
    np.testing.assert_allclose(table["place.x"], 3 * time, atol=1e-12)
    np.testing.assert_array_equal(table["motors.m"], np.floor(time * 10 + 1e-9))
    assert (table["battery.v"] == 3.7).all()


def test_attitudes_between_messages_are_of_unit_length_and_on_the_way_whatever_the_sign():
    log = source()
    table, _ = on_one_clock(log, MAPPING, DT)
    attitude = table[[f"turn.q[{i}]" for i in range(4)]].to_numpy()
    np.testing.assert_allclose(np.linalg.norm(attitude, axis=1), 1, atol=1e-12)
    angle = 2 * np.arctan2(attitude[:, 3], attitude[:, 0])
    wanted = (8 * table["clock.t"] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(np.abs(np.exp(1j * angle) - np.exp(1j * wanted)), 0, atol=1e-3)  # 0.32 rad apart
    names = ["q[0]", "q[1]", "q[2]", "q[3]"]
    log.messages["turn"].loc[::3, names] *= -1
    other = on_one_clock(log, MAPPING, DT)[0][[f"turn.{name}" for name in names]].to_numpy()
    np.testing.assert_allclose(np.abs((attitude * other).sum(1)), 1, atol=1e-12)


def test_a_quaternion_of_wrong_length_keeps_it_so_that_it_is_rejected():
    log = source(turn=frame(np.arange(26) / 25, **{name: 0.5 * q for name, q in turned(np.zeros(26)).items()}))
    assert (on_one_clock(log, MAPPING, DT)[0]["turn.q[0]"] == 0.5).all()


def test_columns_of_the_clock_s_own_topic_stay_as_they_are():
    clock = np.arange(101) / 100
    clock[50], clock[70] = clock[49], 1e9  # a duplicate, and a wrong time
    log = source(clock)
    log.messages["clock"]["vx"] = np.arange(101.0)
    table, missed = on_one_clock(log, MAPPING, DT)
    np.testing.assert_array_equal(table["clock.vx"], np.arange(101.0))
    np.testing.assert_array_equal(table["clock.t"], clock)
    assert np.flatnonzero(missed).tolist() == [70]
    assert table["place.x"][50] == table["place.x"][49]


@pytest.mark.parametrize(
    ("topic", "rate", "again", "missed"),
    [
        ("place", 20, 1510, range(0)),
        ("place", 20, 1520, range(1501, 1520)),  # nothing to interpolate with
        ("motors", 10, 1520, range(0)),
        ("motors", 10, 1530, range(1526, 1530)),  # older than 2.5 control periods
        ("battery", 1, 2400, range(0)),
        ("battery", 1, 2600, range(2501, 2600)),  # older than 10 s
    ],
)
def test_rows_are_missed_where_a_topic_is_silent_from_15_s_on(topic, rate, again, missed):
    def messages(name):
        at = np.arange(0, 4001, 100 // (rate if name == topic else 25))
        at = at[(at <= 1500) | (at >= again)] if name == topic else at
        values = {"place": {"x": 1.0, "y": 1.0, "z": 1.0, "good": 1}, "motors": {"m": 1.0}, "battery": {"v": 3.7}}
        return frame(at / 100, **values.get(name, turned(np.zeros(len(at)))))

    topics = {name: messages(name) for name in ("place", "turn", "motors", "battery")}
    _, found = on_one_clock(source(np.arange(4001) / 100, **topics), MAPPING, DT)
    assert np.flatnonzero(found).tolist() == list(missed)


def test_rows_before_the_first_and_after_the_last_message_of_a_measurement_are_missed():
    place = np.arange(2, 19) / 20
    _, missed = on_one_clock(source(place=frame(place, x=1, y=1, z=1, good=1)), MAPPING, DT)
    assert np.flatnonzero(missed).tolist() == [*range(10), *range(91, 101)]


def test_messages_out_of_order_are_put_in_order():
    log = source()
    log.messages["place"]["x"] = np.arange(21.0) ** 2
    swapped = log.messages["place"].iloc[[1, 0, 2, *range(3, 21)]]
    one, other = (on_one_clock(s, MAPPING, DT)[0] for s in (log, source(place=swapped)))
    pd.testing.assert_frame_equal(one, other)


def test_no_number_beside_a_message_does_not_spoil_it():
    log = source()
    log.messages["place"].loc[5, "x"] = np.nan  # at 0.25 s
    x = on_one_clock(log, MAPPING, DT)[0]["place.x"]
    assert np.flatnonzero(np.isnan(x)).tolist() == list(range(21, 30))


def test_a_topic_that_comes_too_seldom_is_told():
    slow = frame(np.arange(6) * 0.2 + 0.001, x=1, y=1, z=1, good=1)
    with pytest.raises(
        InputError, match=r"a.log: topic place comes every 0.2 s, expected at most 0.15 s; log it faster"
    ):
        on_one_clock(source(place=slow), MAPPING, DT)


def test_topics_of_different_clocks_are_told():
    late = frame(np.arange(11) * 0.1 + 1.7e9, m=1)
    line = "topic motors was sent at 1700000000.000 to 1700000001.000 s, clock at 0.000 to 1.000 s, never together"
    with pytest.raises(InputError, match=line):
        on_one_clock(source(motors=late), MAPPING, DT)


@pytest.mark.parametrize("topic", ["clock", "place"])
def test_two_recordings_in_one_are_told_not_mixed(topic):
    log = source()
    again = log.messages[topic].assign(t=log.messages[topic]["t"] + 0.003)
    longer = {topic: pd.concat([log.messages[topic], again] * 2, ignore_index=True)}
    with pytest.raises(InputError, match=f"a.log: topic {topic} goes back in time by .* s at message"):
        on_one_clock(source()._replace(messages=log.messages | longer), MAPPING, DT)


def test_names_of_arrays_are_folded():
    assert folded(["t", "q[0]", "q[1]", "q[2]", "a.b"]) == ["t", "q[0..2]", "a.b"]
