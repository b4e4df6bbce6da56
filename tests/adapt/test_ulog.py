"""PX4 logs: what a CSV log gives, the same flight as a ULog file gives; axes, flags, rates, damage."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from adapt.log_rows import rotation_matrices
from adapt.log_topics import folded
from adapt.logs import read_flight
from adapt.ulog import read_ulog
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.vehicles import Motors, load_vehicle

pytest.importorskip("pyulog")
VEHICLE = load_vehicle("crazyflie")
REAL = Path(__file__).parents[3] / "shared" / "data" / "nanobench"
needs_real_flights = pytest.mark.skipif(not REAL.is_dir(), reason="the NanoBench flights are not here")
NED = np.array([1.0, -1.0, -1.0])
TYPES = {"float32": "float", "float64": "double", "uint64": "uint64_t", "uint8": "uint8_t", "int64": "int64_t"}


def message(kind, content):
    return struct.pack("<HB", len(content), ord(kind)) + content


def write_ulog(path, topics):
    """A ULog file of {topic or (topic, instance): table}, messages in the order of their timestamps [us].

    Columns q[0], q[1], ... become one array field.
    """
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    subscriptions, data = [], []
    for number, (key, table) in enumerate(topics.items()):
        name, instance = key if isinstance(key, tuple) else (key, 0)
        fields = []
        for field in folded(table.columns):
            stem, _, last = field.rstrip("]").partition("[0..")
            kind = TYPES[str(table[f"{stem}[0]" if last else stem].dtype)]
            fields.append(f"{kind}[{int(last) + 1}] {stem}" if last else f"{kind} {stem}")
        parts.append(message("F", f"{name}:{';'.join(fields)};".encode()))
        subscriptions.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
        for time, row in zip(table.timestamp, table.to_records(index=False), strict=True):
            data.append((time, message("D", struct.pack("<H", number) + row.tobytes())))
    path.write_bytes(b"".join(parts + subscriptions + [content for _, content in sorted(data, key=lambda one: one[0])]))
    return path


def topic(time, fields):
    """Messages at `time` [s]: {field: (N,) or (N, k)}, as PX4 logs them, in single precision."""
    columns = {"timestamp": np.round(time * 1e6).astype(np.uint64)}
    for name, values in fields.items():
        values = np.asarray(values)
        values = values.astype(np.float32) if values.dtype == float else values
        columns |= (
            {name: values} if values.ndim == 1 else {f"{name}[{i}]": values[:, i] for i in range(values.shape[1])}
        )
    return pd.DataFrame(columns)


def flight(seconds=4.0):
    """A made-up flight at 100 Hz in our own names, of numbers that single precision holds."""
    time = np.round(np.arange(0, seconds, 0.01) * 1e6) * 1e-6
    angle = 0.3 * np.sin(2 * time)
    columns = {"px": np.sin(time), "py": 0.4 * time, "pz": 1 + 0.1 * time}
    columns |= {"qw": np.cos(angle / 2), "qx": np.sin(angle / 2) * 0.6, "qy": np.sin(angle / 2) * 0.8, "qz": 0 * time}
    columns |= {"vx": np.cos(time), "vy": 0.4 + 0 * time, "vz": 0.1 + 0 * time}
    columns |= {"p": 0.36 * np.cos(2 * time), "q": 0.48 * np.cos(2 * time), "r": 0 * time}
    columns |= {f"motor{i}": 40000 + 2000 * np.sin(5 * time + i) for i in range(1, 5)} | {"vbat": 3.9 - 0.01 * time}
    table = pd.DataFrame(columns).astype(np.float32).astype(float)
    table.insert(0, "t", time)
    return table


def px4_topics(table, valid=1):
    """The same flight as the topics of PX4's default logger, all at the rate of the table."""
    time, ones = table.t.to_numpy(), np.full(len(table), valid, np.uint8)
    position, velocity = table[["px", "py", "pz"]].to_numpy() * NED, table[["vx", "vy", "vz"]].to_numpy() * NED
    flags = {f"{name}_valid": ones for name in ("xy", "z", "v_xy", "v_z")}
    places = dict(zip(("x", "y", "z", "vx", "vy", "vz"), np.concatenate((position, velocity), 1).T, strict=True))
    return {
        "vehicle_local_position": topic(time, places | flags),
        "vehicle_attitude": topic(time, {"q": table[["qw", "qx", "qy", "qz"]].to_numpy() * [1, 1, -1, -1]}),
        "vehicle_angular_velocity": topic(time, {"xyz": table[["p", "q", "r"]].to_numpy() * NED}),
        "actuator_motors": topic(time, {"control": table[[f"motor{i}" for i in range(1, 5)]].to_numpy()}),
        "battery_status": topic(time, {"voltage_v": table.vbat.to_numpy()}),
        "sensor_gps": topic(time[::10], {"lat": np.full(len(time[::10]), 47.0)}),
    }


def odometry(table, frame=1):
    """The same flight with vehicle_odometry."""
    topics, time = px4_topics(table), table.t.to_numpy()
    measured = {
        "pose_frame": np.full(len(time), 1, np.uint8),
        "position": table[["px", "py", "pz"]].to_numpy() * NED,
        "q": table[["qw", "qx", "qy", "qz"]].to_numpy() * [1, 1, -1, -1],
        "velocity_frame": np.full(len(time), frame, np.uint8),
        "velocity": table[["vx", "vy", "vz"]].to_numpy() * NED,
        "angular_velocity": table[["p", "q", "r"]].to_numpy() * NED,
    }
    return {name: topics[name] for name in ("actuator_motors", "battery_status")} | {
        "vehicle_odometry": topic(time, measured)
    }


def write_csv(path, table):
    table.to_csv(path, index=False)
    return path


def same(one, other, atol=1e-9):
    for part in ("state", "action", "next_state", "context"):
        np.testing.assert_allclose(getattr(one, part), getattr(other, part), atol=atol)
    assert one.context_names == other.context_names
    np.testing.assert_array_equal(one.trajectory, other.trajectory)


def outputs(table):
    """The same flight by firmware without actuator_motors."""
    topics = px4_topics(table)
    motors = topics.pop("actuator_motors")
    return topics | {"actuator_outputs": motors.rename(columns=lambda name: name.replace("control", "output"))}


@pytest.mark.parametrize(
    ("topics", "mapping"), [(px4_topics, "px4"), (odometry, "px4_odometry"), (outputs, "px4_outputs")]
)
def test_a_flight_logged_by_px4_gives_the_transitions_of_the_same_flight_as_csv(tmp_path, topics, mapping):
    table = flight()
    csv = read_flight(write_csv(tmp_path / "flight.csv", table), VEHICLE)
    ulog = read_flight(write_ulog(tmp_path / "flight.ULG", topics(table)), VEHICLE)
    assert ulog.report.mapping == mapping
    assert ulog.report.transitions == csv.report.transitions > 30
    same(ulog, csv)


@needs_real_flights
def test_a_real_flight_gives_the_same_transitions_and_the_same_report_as_ulog_as_it_does_as_csv(tmp_path):
    names = ["t", "px", "py", "pz", *(f"att_stateEstimate_q{axis}" for axis in "wxyz"), "vx", "vy", "vz"]
    names += [*(f"imu_gyro_{axis}" for axis in "xyz"), *(f"motor_motor_m{i}" for i in range(1, 5)), "pwr_pm_vbat"]
    for name in ("B2_circle_slow_rep1", "B6_linear_ramp_rep4"):  # a clean one, and one with impossible motor commands
        raw = pd.read_csv(REAL / f"{name}.csv")[names].set_axis(flight().columns, axis=1)
        table = raw.astype(np.float32).astype(float)
        table["t"] = np.round((raw.t - raw.t[0]) * 1e6) * 1e-6
        csv = read_flight(write_csv(tmp_path / "flight.csv", table), VEHICLE)
        ulog = read_flight(write_ulog(tmp_path / "flight.ulg", px4_topics(table)), VEHICLE)
        same(ulog, csv)
        assert replace(ulog.report, log="", mapping="") == replace(csv.report, log="", mapping="")
        same(ulog, read_flight(REAL / f"{name}.csv", VEHICLE), atol=2e-3)  # single precision, microseconds


def test_axes_of_px4_become_z_up_as_computed_by_hand(tmp_path):
    table, still = flight(1.0), np.zeros((100, 3))
    half = np.radians(15)
    topics = px4_topics(table) | {
        # Rolled to the right by 30 degrees, nose to the north: the body's upward axis leans to the east.
        "vehicle_attitude": topic(table.t, {"q": np.tile([np.cos(half), np.sin(half), 0, 0], (100, 1))}),
        "vehicle_angular_velocity": topic(table.t, {"xyz": still + [0.1, 0.2, 0.3]}),
    }
    topics["vehicle_local_position"] = topics["vehicle_local_position"].assign(
        **{name: np.float32(value) for name, value in (("x", 4), ("y", 5), ("z", -6), ("vx", 1), ("vy", 2), ("vz", -3))}
    )
    state = read_flight(write_ulog(tmp_path / "flight.ulg", topics), VEHICLE).state[0]
    up = rotation_matrices(state[None, 3:7])[0, :, 2]
    np.testing.assert_allclose(up, [0, -0.5, np.sqrt(3) / 2], atol=1e-6)  # x north, y west, z up
    np.testing.assert_allclose(state[:3], [4, -5, 6], atol=1e-6)
    np.testing.assert_allclose(state[7:10], [1, -2, 3], atol=1e-6)
    np.testing.assert_allclose(state[10:], [0.1, -0.2, -0.3], atol=1e-6)
    # Nose to the east, level: forward is east, which is -y.
    east = topic(table.t, {"q": np.tile([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (100, 1))})
    state = read_flight(write_ulog(tmp_path / "east.ulg", topics | {"vehicle_attitude": east}), VEHICLE).state[0]
    np.testing.assert_allclose(rotation_matrices(state[None, 3:7])[0, :, 0], [0, -1, 0], atol=1e-6)


def test_the_model_predicts_the_flight_that_it_flew_from_px4_s_axes_and_default_rates(tmp_path):
    system, generator = VEHICLE.system, np.random.default_rng(0)
    fine = Dynamics(replace(system, dt=0.01), substeps=2)
    wanted = np.array(system.trim_action) + generator.uniform(-0.25, 0.25, (40, 4))
    actions = np.repeat(wanted, 10, 0)  # each for a control period
    states = [torch.tensor([0.0, 0, 1, 1, 0, 0, 0, 0.3, 0, 0, 0, 0, 0], dtype=torch.float64)]
    for action in torch.tensor(actions[:-1]):
        states.append(fine(states[-1], action))
    time, limits = np.arange(400) * 0.01, [system.rate_limit_x, system.rate_limit_y, system.rate_limit_z]
    table = pd.DataFrame(torch.stack(states).numpy(), columns=flight().columns[1:14])
    table.insert(0, "t", time)
    thrust = (system.thrust_max + system.thrust_min) / 2 + (system.thrust_max - system.thrust_min) / 2 * actions[:, 0]
    prompt = replace(VEHICLE, motors=Motors((0.0, system.mass * 20 / 4), 1.0))  # command 1 gives 20 m/s^2
    table = table.assign(**{f"motor{i}": thrust / 20 for i in range(1, 5)}, vbat=3.9)
    commands = dict(zip(("roll", "pitch", "yaw"), (actions[:, 1:] * limits * NED).T, strict=True))
    topics = px4_topics(table) | {"vehicle_rates_setpoint": topic(time, commands)}
    steps = {"vehicle_local_position": 5, "vehicle_attitude": 5, "vehicle_angular_velocity": 2}
    topics = {name: messages.iloc[:: steps.get(name, 1)] for name, messages in topics.items()}
    log = read_flight(write_ulog(tmp_path / "flight.ulg", topics), prompt)
    predicted = Dynamics(system, substeps=10)(torch.tensor(log.state), torch.tensor(log.action)).numpy()
    flown, miss = log.next_state - log.state, predicted - log.next_state
    assert np.abs(flown[:, 7:10]).max() > 0.15 and np.abs(flown[:, 3:7]).max() > 0.02
    assert np.abs(miss[:, 7:10]).max() < 0.05  # [m/s]: a step of thrust of 4 m/s^2, seen as a ramp of 0.02 s
    assert np.sqrt((miss[:, 7:10] ** 2).mean()) < 0.01
    assert np.abs(miss[:, 3:7]).max() < 0.01
    assert np.abs(miss[:, :3]).max() < 0.003


def test_topics_at_the_rates_of_the_default_logger_give_nearly_the_states_of_full_rates(tmp_path):
    table = flight()
    taken = dict.fromkeys(px4_topics(table), slice(None, None, 20)) | {
        "vehicle_local_position": slice(4, None, 10),
        "vehicle_attitude": slice(7, None, 5),
        "vehicle_angular_velocity": slice(11, None, 2),  # the clock: 0.11 to 3.99 s
        "actuator_motors": slice(3, None, 10),
    }
    topics = {name: messages.iloc[taken[name]] for name, messages in px4_topics(table).items()}
    slow = read_flight(write_ulog(tmp_path / "slow.ulg", topics), VEHICLE)
    full = read_flight(write_ulog(tmp_path / "full.ulg", px4_topics(table.iloc[11:])), VEHICLE)
    assert slow.report.rejected["no message near enough"] == 3  # after the last position: 3.95 to 3.99 s
    assert slow.report.transitions == full.report.transitions == 35
    assert np.abs(slow.state - full.state).max() > 1e-4
    # h^2 / 8 times the largest second derivative: 1 m/s^3 over 0.1 s.
    np.testing.assert_allclose(slow.state[:, :10], full.state[:, :10], atol=1.3e-3)
    assert np.abs(np.linalg.norm(slow.state[:, 3:7], axis=1) - 1).max() < 1e-12


def test_rows_that_the_estimator_calls_invalid_are_rejected(tmp_path):
    topics = px4_topics(flight())
    topics["vehicle_local_position"].loc[100:149, "v_xy_valid"] = np.uint8(0)
    report = read_flight(write_ulog(tmp_path / "flight.ulg", topics), VEHICLE).report
    assert {reason: n for reason, n in report.rejected.items() if n} == {"not valid by its own flags": 50}
    assert report.trajectories == 2
    assert "rejected: not valid by its own flags" in str(report)


def test_a_silent_topic_breaks_the_run(tmp_path):
    topics = px4_topics(flight())
    topics["vehicle_attitude"] = topics["vehicle_attitude"].drop(index=range(150, 200))
    report = read_flight(write_ulog(tmp_path / "flight.ulg", topics), VEHICLE).report
    assert {reason: n for reason, n in report.rejected.items() if n} == {"no message near enough": 50}


def test_logged_rate_commands_are_the_actions(tmp_path):
    table = flight()
    wanted = {"roll": np.full(len(table), 0.5), "pitch": np.full(len(table), 0.4), "yaw": np.full(len(table), -0.3)}
    topics = px4_topics(table) | {"vehicle_rates_setpoint": topic(table.t, wanted)}
    action = read_flight(write_ulog(tmp_path / "flight.ulg", topics), VEHICLE).action
    np.testing.assert_allclose(action[:, 1:], np.tile([0.25, -0.2, 0.3], (len(action), 1)), atol=1e-6)


def test_a_second_instance_is_named_by_its_number_and_a_missing_optional_topic_is_left_out(tmp_path):
    table = flight()
    topics = px4_topics(table)
    del topics["battery_status"]
    assert read_flight(write_ulog(tmp_path / "a.ulg", topics), VEHICLE).context_names[0] == "force_x"
    topics["battery_status"] = topic(table.t, {"voltage_v": np.full(len(table), 3.0)})
    topics["battery_status", 1] = topic(table.t, {"voltage_v": np.full(len(table), 4.0)})
    text = (Path(__file__).parents[2] / "adapt/mapping_data/px4.toml").read_text()
    (tmp_path / "own.toml").write_text(text.replace("battery_status.", "battery_status[1]."))
    path = write_ulog(tmp_path / "b.ulg", topics)
    assert (read_flight(path, VEHICLE, tmp_path / "own.toml").context[:, 0] == 4).all()
    assert (read_flight(path, VEHICLE).context[:, 0] == 3).all()


def test_only_what_is_asked_for_is_kept(tmp_path):
    path = write_ulog(tmp_path / "flight.ulg", px4_topics(flight()))
    source = read_ulog(path, {"vehicle_attitude": {"q[0]", "nothing"}, "no_such_topic": {"x"}})
    assert {name: list(table.columns) for name, table in source.messages.items()} == {
        "vehicle_attitude": ["timestamp", "q[0]"]
    }
    assert source.fields == {"vehicle_attitude": ["timestamp", "q[0..3]"]}
    assert "sensor_gps" in source.topics


def test_a_missing_topic_or_field_is_one_line_that_says_what_there_is(tmp_path):
    def line(topics, mapping="px4"):
        with pytest.raises(InputError) as caught:
            read_flight(write_ulog(tmp_path / "flight.ulg", topics), VEHICLE, mapping)
        return str(caught.value)

    topics = px4_topics(flight())
    less = {name: table for name, table in topics.items() if name != "vehicle_attitude"}
    assert line(less) == (
        "flight.ulg: mapping px4 needs vehicle_attitude.q[0]; there is no message of topic vehicle_attitude but of "
        "vehicle_local_position, vehicle_angular_velocity, battery_status, actuator_motors, sensor_gps"
    )
    assert line(less, "auto").startswith("flight.ulg: no built-in mapping fits; px4 is closest and needs vehicle_att")
    flat = topics | {"vehicle_attitude": topics["vehicle_attitude"].drop(columns="q[3]")}
    assert line(flat) == (
        "flight.ulg: mapping px4 needs vehicle_attitude.q[3]; topic vehicle_attitude has no such field but q[0..2], "
        "timestamp"
    )
    wrong = topics | {"vehicle_local_position": topics["vehicle_local_position"].assign(z_valid=np.uint8(0))}
    assert line(wrong) == "flight.ulg: vehicle_local_position.z_valid is 0 in all rows, mapping px4 requires 1"


def test_velocity_in_body_axes_is_not_taken_for_velocity_in_the_world(tmp_path):
    path = write_ulog(tmp_path / "flight.ulg", odometry(flight(), frame=3))
    with pytest.raises(InputError, match="velocity_frame is 3 in all rows, mapping px4_odometry requires 1 or 2"):
        read_flight(path, VEHICLE)


def test_a_log_cut_off_in_flight_is_read_up_to_there(tmp_path):
    path = write_ulog(tmp_path / "flight.ulg", px4_topics(flight()))
    whole = read_flight(path, VEHICLE)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    half = read_flight(path, VEHICLE)
    assert 0.3 < half.report.transitions / whole.report.transitions < 0.6
    np.testing.assert_array_equal(half.state, whole.state[: len(half.state)])


def test_damage_within_a_log_is_told_in_the_report(tmp_path, capsys):
    path = write_ulog(tmp_path / "flight.ulg", px4_topics(flight(8.0)))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    report = read_flight(path, VEHICLE).report
    assert report.damaged
    assert "damaged" in str(report)
    assert capsys.readouterr().out == ""
    assert "damaged" not in str(replace(report, damaged=False))


def test_a_file_that_is_no_ulog_or_damaged_anywhere_is_one_line_or_is_read(tmp_path, capsys):
    path = write_ulog(tmp_path / "flight.ulg", px4_topics(flight()))
    content, generator = path.read_bytes(), np.random.default_rng(0)
    for given in (b"", b"text", bytes(1000), content[:40], content[:600]):
        path.write_bytes(given)
        with pytest.raises(InputError, match=r"flight.ulg: ") as caught:
            read_flight(path, VEHICLE)
        assert "\n" not in str(caught.value)
    read = 0
    for start in generator.integers(0, 3000, 20):
        path.write_bytes(content[:start] + generator.bytes(20) + content[start + 20 :])
        try:
            read += read_flight(path, VEHICLE).report.transitions > 0
        except InputError as error:
            assert "\n" not in str(error)
    assert read < 20
    assert capsys.readouterr().out == ""
    with pytest.raises(InputError, match=r"none.ulg: cannot be read \(No such file"):
        read_flight(tmp_path / "none.ulg", VEHICLE)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyulog", None)
    with pytest.raises(InputError, match=r"not installed; pip install 'apg-adapt\[ulog\]'"):
        read_flight(write_ulog(tmp_path / "flight.ulg", px4_topics(flight())), VEHICLE)
