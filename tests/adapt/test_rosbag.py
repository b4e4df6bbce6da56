"""ROS bags: what a CSV log gives, the same flight as a bag of any kind gives; the child frame, clocks, damage."""

import warnings
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from adapt.log_rows import rotation_matrices
from adapt.logs import read_flight
from adapt.rosbag import read_rosbag
from envs.errors import InputError
from envs.vehicles import load_vehicle

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

VEHICLE = load_vehicle("crazyflie")
REAL = Path(__file__).parents[3] / "shared" / "data" / "nanobench"
ROS = Path(__file__).parents[2] / "adapt" / "mapping_data" / "ros.toml"
needs_real_flights = pytest.mark.skipif(not REAL.is_dir(), reason="the NanoBench flights are not here")
ACTUATORS = "std_msgs/Header header\nfloat64[] position\nfloat64[] velocity\nfloat64[] normalized\n"
KINDS = ["bag", "folder", "db3", "mcap"]
START = 1_772_422_003  # [s] since 1970


def flight(seconds=3.0):
    """A made-up flight at 100 Hz in our own names, stamps to the nanosecond."""
    time = np.arange(0, seconds, 0.01)
    angle = 0.3 * np.sin(2 * time)
    columns = {"px": np.sin(time), "py": 0.4 * time, "pz": 1 + 0.1 * time}
    columns |= {"qw": np.cos(angle / 2), "qx": np.sin(angle / 2) * 0.6, "qy": np.sin(angle / 2) * 0.8, "qz": 0 * time}
    columns |= {"vx": np.cos(time), "vy": 0.4 + 0 * time, "vz": 0.1 + 0 * time}
    columns |= {"p": 0.36 * np.cos(2 * time), "q": 0.48 * np.cos(2 * time), "r": 0 * time}
    columns |= {f"motor{i}": 40000 + 2000 * np.sin(5 * time + i) for i in range(1, 5)} | {"vbat": 3.9 - 0.01 * time}
    table = pd.DataFrame(columns)
    table.insert(0, "t", START + time)
    return table


def in_nanoseconds(seconds):
    """As written in decimals: in binary, seconds since 1970 are good to a quarter of a microsecond."""
    return round(Decimal(repr(float(seconds))) * 10**9)


class Bag:
    """Writes bags of odometry, motors and battery, of ROS 1 or ROS 2."""

    def __init__(self, kind):
        self.one, self.kind = kind == "bag", kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg(ACTUATORS, "actuator_msgs/msg/Actuators"))

    def header(self, seconds, frame=""):
        nanoseconds = in_nanoseconds(seconds)
        number = {"seq": 0} if self.one else {}
        stamp = self.make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **number)

    def make(self, kind, **fields):
        return self.store.types[kind](**fields)

    def xyz(self, kind, values):
        return self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))

    def odometry(self, stamp, position, quaternion, body_velocity, rates):
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.xyz("Point", position),
            orientation=self.xyz("Quaternion", quaternion),
        )
        twist = self.make(
            "geometry_msgs/msg/Twist", linear=self.xyz("Vector3", body_velocity), angular=self.xyz("Vector3", rates)
        )
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp, "map"),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def actuators(self, stamp, commands):
        empty = np.zeros(0)
        return self.make(
            "actuator_msgs/msg/Actuators",
            header=self.header(stamp),
            position=empty,
            velocity=empty,
            normalized=np.asarray(commands, float),
        )

    def battery(self, stamp, voltage):
        kind = self.store.types["sensor_msgs/msg/BatteryState"]
        numbers = dict.fromkeys(("temperature", "current", "charge", "capacity", "design_capacity", "percentage"), 0.0)
        codes = dict.fromkeys(("power_supply_status", "power_supply_health", "power_supply_technology"), 0)
        empty = np.zeros(0, np.float32)
        return kind(
            header=self.header(stamp),
            voltage=voltage,
            present=True,
            cell_voltage=empty,
            cell_temperature=empty,
            location="",
            serial_number="",
            **numbers,
            **codes,
        )

    def messages(self, table):
        """(topic, time of recording [s], message) of a flight."""
        velocity = np.einsum(
            "nji,nj->ni",
            rotation_matrices(table[["qw", "qx", "qy", "qz"]].to_numpy()),
            table[["vx", "vy", "vz"]].to_numpy(),
        )
        for row, body in zip(table.itertuples(), velocity, strict=True):
            quaternion = (row.qx, row.qy, row.qz, row.qw)
            odometry = self.odometry(row.t, (row.px, row.py, row.pz), quaternion, body, (row.p, row.q, row.r))
            yield "/odometry", row.t, odometry
            yield "/motors", row.t, self.actuators(row.t, (row.motor1, row.motor2, row.motor3, row.motor4))
            if "vbat" in table:
                yield "/battery", row.t, self.battery(row.t, row.vbat)

    def write(self, folder, messages):
        """The path of a bag of (topic, time of recording [s], message)."""
        path = folder / ("flight.bag" if self.one else "flight")
        plugin = rosbag2.StoragePlugin.MCAP if self.kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag1.Writer(path) if self.one else rosbag2.Writer(path, version=9, storage_plugin=plugin)
        serialize = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        with writer:
            connections = {}
            for topic, time, message in messages:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], in_nanoseconds(time), serialize(message, kind))
        return path if self.kind in ("bag", "folder") else next(path.glob(f"*.{self.kind}"))


def write_csv(path, table):
    table.to_csv(path, index=False)
    return path


def same(one, other, atol):
    for part in ("state", "action", "next_state", "context"):
        np.testing.assert_allclose(getattr(one, part), getattr(other, part), atol=atol)
    assert one.context_names == other.context_names
    np.testing.assert_array_equal(one.trajectory, other.trajectory)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_transitions_of_the_same_flight_as_csv(tmp_path, kind):
    table = flight()
    bag, csv = Bag(kind), read_flight(write_csv(tmp_path / "flight.csv", table.drop(columns="vbat")), VEHICLE)
    read = read_flight(bag.write(tmp_path, bag.messages(table.drop(columns="vbat"))), VEHICLE)
    assert read.report.mapping == "ros"
    assert read.report.transitions == csv.report.transitions > 20
    same(read, csv, 1e-9)


@needs_real_flights
def test_a_real_flight_gives_the_same_transitions_and_report_as_a_bag_as_it_does_as_csv(tmp_path):
    names = ["t", "px", "py", "pz", *(f"att_stateEstimate_q{axis}" for axis in "wxyz"), "vx", "vy", "vz"]
    names += [*(f"imu_gyro_{axis}" for axis in "xyz"), *(f"motor_motor_m{i}" for i in range(1, 5)), "pwr_pm_vbat"]
    name = "B6_linear_ramp_rep4"  # with impossible motor commands
    table = pd.read_csv(REAL / f"{name}.csv")[names].set_axis(flight().columns, axis=1)
    bag = Bag("mcap")
    read = read_flight(bag.write(tmp_path, bag.messages(table)), VEHICLE)
    csv = read_flight(REAL / f"{name}.csv", VEHICLE)
    assert read.report.rejected == csv.report.rejected
    assert read.report.rejected["motor command out of range"] == 910
    assert (read.report.transitions, read.report.ground) == (csv.report.transitions, csv.report.ground)
    np.testing.assert_allclose(read.state, csv.state, atol=1e-6)
    np.testing.assert_allclose(read.action, csv.action, atol=1e-6)
    np.testing.assert_allclose(read.context, csv.context, atol=1e-5)  # a battery's message is of single precision


def test_the_twist_of_odometry_is_in_body_axes(tmp_path):
    bag, half = Bag("mcap"), np.sqrt(0.5)

    def messages():
        for time in np.arange(0, 1, 0.01):  # yawed to the left by 90 degrees: forward is along y
            yield "/odometry", time, bag.odometry(time, (0, 0, 1), (0, 0, half, half), (1, 0, 0), (0.1, 0.2, 0.3))
            yield "/motors", time, bag.actuators(time, [40000.0] * 4)

    path = bag.write(tmp_path, messages())
    state = read_flight(path, VEHICLE).state[0]
    np.testing.assert_allclose(state[3:], [half, 0, 0, half, 0, 1, 0, 0.1, 0.2, 0.3], atol=1e-9)
    (tmp_path / "own.toml").write_text(
        ROS.read_text().replace('unit = "m/s", frame = "body"', 'unit = "m/s", frame = "world"')
    )
    np.testing.assert_allclose(read_flight(path, VEHICLE, tmp_path / "own.toml").state[0, 7:10], [1, 0, 0], atol=1e-9)


def late(bag, delay, stamps):
    """A flight recorded with a delay, the commands as plain arrays without a header, or with an unset stamp."""
    store = bag.store
    table = flight().drop(columns="vbat")
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    for topic, time, message in bag.messages(table):
        if topic == "/motors" and stamps is None:
            data = np.array(message.normalized)
            message = store.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=data)
        elif topic == "/motors":
            message = bag.actuators(stamps, message.normalized)
        yield topic, time + delay, message


def test_a_message_without_header_is_placed_by_its_time_of_recording(tmp_path):
    bag = Bag("folder")
    (tmp_path / "own.toml").write_text(ROS.read_text().replace("/motors.normalized", "/motors.data"))
    csv = read_flight(write_csv(tmp_path / "flight.csv", flight().drop(columns="vbat")), VEHICLE)
    path = bag.write(tmp_path, late(bag, 0.0, None))
    same(read_flight(path, VEHICLE, tmp_path / "own.toml"), csv, 1e-9)


def test_stamps_that_were_never_set_are_told_and_the_time_of_recording_helps(tmp_path):
    bag = Bag("mcap")
    path = bag.write(tmp_path, late(bag, 0.5, 0.0))
    line = r"topic /motors was sent at 0.000 to 0.000 s, /odometry at 1772422003.* align them by the time of recording"
    with pytest.raises(InputError, match=line) as caught:
        read_flight(path, VEHICLE)
    assert "\n" not in str(caught.value)
    (tmp_path / "own.toml").write_text(ROS.read_text().replace("/odometry.header.stamp", "/odometry.recorded"))
    csv = read_flight(write_csv(tmp_path / "flight.csv", flight().drop(columns="vbat")), VEHICLE)
    same(read_flight(path, VEHICLE, tmp_path / "own.toml"), csv, 1e-4)  # 0.5 s later, rounded at 2e-7 s


def test_missing_topics_and_fields_are_one_line_that_says_what_there_is(tmp_path):
    bag = Bag("mcap")
    path = bag.write(tmp_path, bag.messages(flight(0.5)))
    listed = "no message of topic /cmd but of /motors, /odometry, /battery"
    fields = r"topic /motors has no such field but header.stamp, normalized\[0..3\], recorded"
    for old, new, line in (
        ("/motors.", "/cmd.", rf"mapping own.toml needs /cmd.normalized\[0\]; there is {listed}"),
        ("normalized[0]", "thrust[0]", fields),
        ("normalized[0]", "normalized[7]", r"/motors.normalized\[7\]; topic /motors has no such field"),
        ("/odometry.header.stamp", "/odometry.child_frame_id", "/odometry has no such field"),  # text
    ):
        (tmp_path / "own.toml").write_text(ROS.read_text().replace(old, new))
        with pytest.raises(InputError, match=line) as caught:
            read_flight(path, VEHICLE, tmp_path / "own.toml")
        assert "\n" not in str(caught.value)


def test_only_the_topics_that_are_asked_for_are_unpacked(tmp_path, monkeypatch):
    from rosbags.highlevel import AnyReader

    bag, unpacked = Bag("mcap"), []
    path = bag.write(tmp_path, bag.messages(flight(0.5)))
    original = AnyReader.deserialize

    def spying(self, raw, kind):
        unpacked.append(kind)
        return original(self, raw, kind)

    monkeypatch.setattr(AnyReader, "deserialize", spying)
    source = read_rosbag(path, {"/motors": {"normalized[1]"}})
    assert set(unpacked) == {"actuator_msgs/msg/Actuators"}
    assert list(source.messages["/motors"].columns) == ["recorded", "normalized[1]"]
    assert source.topics == ["/battery", "/motors", "/odometry"]


def test_a_shorter_array_is_no_number(tmp_path):
    bag = Bag("mcap")
    messages = [("/motors", time, bag.actuators(time, [1.0] * (4 if time < 3 else 2))) for time in range(1, 5)]
    values = read_rosbag(bag.write(tmp_path, messages), {"/motors": {"normalized[3]"}}).messages["/motors"]
    np.testing.assert_array_equal(values["normalized[3]"], [1, 1, np.nan, np.nan])


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_is_damaged_anywhere_is_one_line_or_is_read(tmp_path, kind):
    bag, generator = Bag(kind), np.random.default_rng(0)
    path = bag.write(tmp_path, bag.messages(flight(0.5)))
    file = next(path.glob("*.db3")) if kind == "folder" else path
    content, refused = file.read_bytes(), 0
    cut = [content[: len(content) // n] for n in (2, 3, 100)]
    hit = [content[:n] + generator.bytes(50) + content[n + 50 :] for n in generator.integers(0, len(content), 12)]
    for given in (b"", b"text", bytes(1000), *cut, *hit):
        file.write_bytes(given)
        try:
            with warnings.catch_warnings(action="ignore"):  # numpy, of numbers that the damage made huge
                read_flight(path, VEHICLE)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
            assert "flight" in str(error)
    assert refused >= 5


def test_what_is_no_bag_or_not_there_is_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "yaml").mkdir()
    (tmp_path / "yaml" / "metadata.yaml").write_text("a: [1\n")
    for path, line in (
        (tmp_path / "none.mcap", r"none.mcap: cannot be read \("),
        (tmp_path / "none.bag", r"none.bag: cannot be read \("),
        (tmp_path / "empty", "a folder without metadata.yaml"),
        (tmp_path / "yaml", "yaml: not a ROS bag, or damaged"),
    ):
        with pytest.raises(InputError, match=line) as caught:
            read_flight(path, VEHICLE)
        assert "\n" not in str(caught.value)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    (tmp_path / "a.mcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"not installed; pip install 'apg-adapt\[rosbag\]'"):
        read_flight(tmp_path / "a.mcap", VEHICLE)
