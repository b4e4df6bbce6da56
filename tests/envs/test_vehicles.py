"""Vehicles from TOML files: units, limits, and one clear line for what is wrong."""

import math

import pytest
import torch

from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.fixed_wing import FixedWing
from envs.quadrotor import Quadrotor
from envs.vehicles import CONVERSIONS, load_vehicle, quantity, shipped_vehicles

VEHICLE = """
name = "box"
system = "quadrotor"
[parameters]
mass = "500 g"
inertia_x = "0.002 kg m^2"
inertia_y = "20 kg cm^2"
inertia_z = "0.003 kg m^2"
rate_gain_x = "12 1/s"
rate_gain_y = "12 1/s"
rate_gain_z = "4 1/s"
thrust_min = "2 m/s^2"
thrust_max = "2 g"
rate_limit_x = "90 deg/s"
rate_limit_y = "1.5 rad/s"
rate_limit_z = "1 rad/s"
dt = "50 ms"
[motors]
thrust_curve = ["0 N", "2.5 N"]
command_max = "1"
thrust_delay = "20 ms"
[sensors]
rate_max = "1000 deg/s"
voltage_min = "9000 mV"
"""


def written(tmp_path, text):
    path = tmp_path / "box.toml"
    path.write_text(text)
    return path


def test_a_file_in_any_units_gives_si_parameters(tmp_path):
    vehicle = load_vehicle(written(tmp_path, VEHICLE))
    system = vehicle.system
    assert vehicle.name == "box"
    assert system.mass == pytest.approx(0.5)
    assert system.inertia_x == pytest.approx(system.inertia_y)
    assert system.thrust_max == pytest.approx(2 * 9.80665)
    assert system.rate_limit_x == pytest.approx(math.pi / 2)
    assert system.dt == pytest.approx(0.05)
    assert system.gravity == Quadrotor().gravity
    assert vehicle.motors.thrust_delay == pytest.approx(0.02)
    assert vehicle.motors.force(0.5) == pytest.approx(1.25)
    assert vehicle.sensors.rate_max == pytest.approx(1000 * math.pi / 180)
    assert (vehicle.sensors.voltage_min, vehicle.sensors.voltage_max) == (pytest.approx(9), math.inf)


def test_g_is_a_gram_for_a_mass_and_a_gravity_for_an_acceleration():
    assert quantity("34 g", "kg", "f") == pytest.approx(0.034)
    assert quantity("1 g", "m/s^2", "f") == pytest.approx(9.80665)


@pytest.mark.parametrize("expected", CONVERSIONS)
def test_every_si_unit_converts_to_itself(expected):
    assert quantity(f"2.5 {expected}", expected, "f") == 2.5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"500 g"', '"500 m"', r"box.toml: \[parameters\] mass: unit 'm', expected 'kg' or 'g'"),
        ('"500 g"', "0.5", r"\[parameters\] mass: unit '', expected 'kg' or 'g'"),
        ('"500 g"', '"heavy"', r"\[parameters\] mass: 'heavy', expected a number and a unit"),
        ('"500 g"', '"nan kg"', r"\[parameters\] mass: 'nan kg', expected a finite number"),
        ('"500 g"', "true", r"\[parameters\] mass: True, expected a number and a unit"),
        ('"500 g"', '["1 g", "2 g"]', r"\[parameters\] mass: a list, expected one value"),
        ('"500 g"', '"-500 g"', r"box.toml: \[parameters\] .*mass is -0.5"),
        ('mass = "500 g"', "", r"box.toml: \[parameters\] lacks mass"),
        ("mass =", 'weight = "1 kg"\nmass =', r"\[parameters\]: unknown field 'weight'"),
        ("[motors]", '[wings]\nspan = "1 m"\n[motors]', r"box.toml: unknown field 'wings'"),
        ('"quadrotor"', '"submarine"', r"box.toml: system 'submarine', expected 'quadrotor' or 'fixed_wing'"),
        ('"2 m/s^2"', '"30 m/s^2"', r"box.toml: \[parameters\] .*thrust_min 30 is not below thrust_max"),
        ('thrust_curve = ["0 N", "2.5 N"]', "", r"\[motors\] lacks thrust_curve"),
        ('["0 N", "2.5 N"]', '["0 N", "2.5 V"]', r"\[motors\] thrust_curve: unit 'V', expected 'N'"),
        ('["0 N", "2.5 N"]', '["1 N", "-2.5 N"]', r"\[motors\] thrust_curve does not grow"),
        ('command_max = "1"', 'command_max = "-1"', r"\[motors\] command_min 0 is not below command_max -1"),
        ('"20 ms"', '"-20 ms"', r"\[motors\] thrust_delay is -0.02 s"),
        ('"1000 deg/s"', '"0 deg/s"', r"\[sensors\] rate_max is 0, expected more than zero"),
        ('"9000 mV"', '"9 V"\nvoltage_max = "8 V"', r"\[sensors\] voltage_min 9 V is not below voltage_max 8 V"),
        ("[sensors]", "[sensors", r"box.toml: not a TOML file"),
    ],
)
def test_a_wrong_file_is_one_line_with_file_and_field(tmp_path, old, new, message):
    assert old in VEHICLE
    with pytest.raises(InputError, match=message) as caught:
        load_vehicle(written(tmp_path, VEHICLE.replace(old, new, 1)))
    assert "\n" not in str(caught.value)


def test_an_unknown_name_and_a_missing_file_say_what_there_is(tmp_path):
    with pytest.raises(InputError, match="--vehicle zeppelin: expected one of crazyflie"):
        load_vehicle("zeppelin")
    with pytest.raises(InputError, match=r"none.toml: cannot be read \(No such file"):
        load_vehicle(tmp_path / "none.toml")


QUADROTORS = [name for name in shipped_vehicles() if isinstance(load_vehicle(name).system, Quadrotor)]


@pytest.mark.parametrize("name", QUADROTORS)
def test_a_shipped_vehicle_hovers_at_its_trim(name):
    system = load_vehicle(name).system
    hover = torch.zeros(13, dtype=torch.float64)
    hover[3] = 1.0
    trim = torch.tensor(system.trim_action, dtype=torch.float64)
    torch.testing.assert_close(Dynamics(system)(hover, trim), hover, atol=1e-12, rtol=0)
    assert trim.abs().max() < 0.5  # there is room to climb and to sink


@pytest.mark.parametrize("name", QUADROTORS)
def test_one_rk4_step_follows_the_rate_loop_of_a_shipped_vehicle(name):
    system = load_vehicle(name).system
    spinning = torch.tensor([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 1, 1], dtype=torch.float64)
    after = Dynamics(system)(spinning, torch.zeros(4, dtype=torch.float64))[10:]
    assert ((after > 0) & (after < 0.65)).all()
    exact = Dynamics(system, substeps=50)(spinning, torch.zeros(4, dtype=torch.float64))[10:]
    assert (after - exact).abs().max() < 0.1


WING = """
system = "fixed_wing"
[parameters]
mass = "1.5 kg"
inertia_x = "500 g cm^2"
inertia_y = "0.05 kg m^2"
inertia_z = "0.09 kg m^2"
inertia_xz = "-0.001 kg m^2"
wing_area = "30 dm^2"
chord = "20 cm"
span = "1.5 m"
thrust_angle = "0 deg"
thrust_max = "6 N"
elevator_limit = "20 deg"
aileron_limit = "0.05 rad"
rudder_limit = "20 deg"
lift = ["0.4", "4.5", "0.3", "0.5"]
drag = ["0.08", "0.3", "0", "0"]
pitch = ["0", "-1.4", "-0.1", "-0.4"]
side = ["0", "-0.1", "0", "0", "0.2"]
roll = ["-0.08", "-0.5", "0.2", "-0.4", "0"]
yaw = ["0.2", "-0.1", "-0.9", "0", "-0.1"]
"""


def test_a_fixed_wing_is_read_with_its_lists_of_coefficients(tmp_path):
    vehicle = load_vehicle(written(tmp_path, WING))
    system = vehicle.system
    assert (vehicle.name, system.name, vehicle.motors) == ("box", "fixed_wing", None)
    assert system.inertia_x == pytest.approx(5e-5)
    assert (system.wing_area, system.chord) == (pytest.approx(0.3), pytest.approx(0.2))
    assert system.elevator_limit == pytest.approx(math.radians(20))
    assert system.roll == (-0.08, -0.5, 0.2, -0.4, 0.0)
    assert system.air_density == FixedWing().air_density


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('lift = ["0.4", "4.5", "0.3", "0.5"]', 'lift = ["0.4"]', r"\[parameters\] lift: 1 values, expected 4"),
        ('lift = ["0.4", "4.5", "0.3", "0.5"]', 'lift = "0.4"', r"\[parameters\] lift: 1 values, expected 4"),
        ('"4.5", "0.3"', '"4.5", "x"', r"\[parameters\] lift: 'x', expected a number and a unit"),
        ('mass = "1.5 kg"', 'mass = ["1.5 kg"]', r"\[parameters\] mass: a list, expected one value"),
        ('mass = "1.5 kg"', 'mass = "-1.5 kg"', r"\[parameters\] fixed_wing: mass is -1.5, expected more than 0"),
        ('span = "1.5 m"', "", r"\[parameters\] lacks span"),
        ('span = "1.5 m"', 'span = "1.5 m"\nrate_gain_x = "1 1/s"', r"\[parameters\]: unknown field 'rate_gain_x'"),
        (
            "[parameters]",
            "[motors]\n[parameters]",
            r"box.toml: \[motors\] are those of a quadrotor, this is a fixed_wing",
        ),
    ],
)
def test_a_wrong_fixed_wing_is_one_line_with_file_and_field(tmp_path, old, new, message):
    assert old in WING
    with pytest.raises(InputError, match=message) as caught:
        load_vehicle(written(tmp_path, WING.replace(old, new, 1)))
    assert "\n" not in str(caught.value)


def test_the_small_cub_flies_level_within_its_limits():
    """Lift, pitch moment and thrust balance at 11.5 m/s with an angle of attack below 3 degrees."""
    system = load_vehicle("j3cub").system
    pressure = 0.5 * system.air_density * system.wing_area * 11.5**2
    needed = torch.tensor((system.mass * system.gravity / pressure - system.lift[0], -system.pitch[0]))
    slopes = torch.tensor(((system.lift[1], system.lift[3]), (system.pitch[1], system.pitch[3])))
    alpha, elevator = torch.linalg.solve(slopes, needed).tolist()
    assert abs(math.degrees(alpha)) < 3
    assert abs(elevator) < system.elevator_limit / 2
    drag = pressure * (system.drag[0] + system.drag[1] * alpha)
    assert 0.3 * system.thrust_max < drag < 0.7 * system.thrust_max


def test_the_crazyflie_cannot_be_asked_for_more_than_its_motors_give():
    vehicle = load_vehicle("crazyflie")
    full = 4 * vehicle.motors.force(vehicle.motors.command_max) / vehicle.system.mass
    assert vehicle.system.thrust_max <= full < 1.05 * vehicle.system.thrust_max


def test_the_crazyflie_is_in_si_units():
    system = load_vehicle("crazyflie").system
    assert system.mass == 0.034
    assert load_vehicle("crazyflie").motors.thrust_delay == 0.05
    assert load_vehicle("crazyflie").sensors.rate_max == pytest.approx(34.9066, abs=1e-3)
