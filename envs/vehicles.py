"""A vehicle of one's own: a small TOML file of parameters with units, from which limits and trim follow.

    name = "crazyflie"
    system = "quadrotor"
    [parameters]            # fields of the system; other units of the same kind are converted
    mass = "34 g"
    [motors]                # optional, of a quadrotor: what turns logged motor commands into thrust
    thrust_curve = ["5.48e-4 N", "1.03e-6 N", "2.13e-11 N"]
    [sensors]               # optional: what a measurement can be at most

`vehicle_data/crazyflie.toml` and, of a fixed wing, `j3cub.toml` are complete examples, found by their names. A field
with several values, such as the coefficients of lift, is a list.
"""

import math
import tomllib
from dataclasses import MISSING, dataclass, fields
from importlib import resources
from pathlib import Path

from envs.errors import InputError
from envs.fixed_wing import FixedWing
from envs.quadrotor import Quadrotor
from envs.system import System

CONVERSIONS = {  # {SI unit: {unit that may be given: factor}}; "g" is grams for a mass, gravities for an acceleration
    "": {"": 1.0},
    "kg": {"kg": 1.0, "g": 1e-3},
    "kg/m^3": {"kg/m^3": 1.0, "g/m^3": 1e-3},
    "m^2": {"m^2": 1.0, "dm^2": 1e-2, "cm^2": 1e-4},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "kg m^2": {"kg m^2": 1.0, "kg mm^2": 1e-6, "kg cm^2": 1e-4, "g m^2": 1e-3, "g cm^2": 1e-7, "g mm^2": 1e-9},
    "1/s": {"1/s": 1.0, "1/ms": 1e3, "Hz": 1.0},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "m/s^2": {"m/s^2": 1.0, "cm/s^2": 1e-2, "g": 9.80665, "mg": 9.80665e-3},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "V": {"V": 1.0, "mV": 1e-3},
}

QUADROTOR_UNITS = {
    "dt": "s",
    **dict.fromkeys(("mass", "controller_mass"), "kg"),
    **{f"{owner}inertia_{axis}": "kg m^2" for owner in ("", "controller_") for axis in "xyz"},
    **{f"rate_gain_{axis}": "1/s" for axis in "xyz"},
    **{f"rate_limit_{axis}": "rad/s" for axis in "xyz"},
    **dict.fromkeys(("gravity", "thrust_min", "thrust_max"), "m/s^2"),
    "thrust_loss": "",
}
FIXED_WING_UNITS = {
    **{"dt": "s", "mass": "kg", "gravity": "m/s^2", "air_density": "kg/m^3", "wing_area": "m^2", "thrust_max": "N"},
    **{f"inertia_{axes}": "kg m^2" for axes in ("x", "y", "z", "xz")},
    **dict.fromkeys(("chord", "span"), "m"),
    **{f"{part}_limit": "rad" for part in ("elevator", "aileron", "rudder", "incidence")},
    "thrust_angle": "rad",
    **dict.fromkeys(("lift", "drag", "pitch", "side", "roll", "yaw", "thrust_loss"), ""),
}
UNITS = {Quadrotor: QUADROTOR_UNITS, FixedWing: FIXED_WING_UNITS}
# What every airframe has alike, or has no need to tell; other values of another one are never a sensible stand-in.
OPTIONAL = ("dt", "gravity", "air_density", "incidence_limit", "thrust_loss", "controller_mass") + tuple(
    f"controller_inertia_{axis}" for axis in "xyz"
)


@dataclass(frozen=True)
class Motors:
    """What the motor commands of a log mean."""

    thrust_curve: tuple[float, ...]  # [N] force of one motor: sum of coefficient i times command^i
    command_max: float  # [-] largest command that a motor can be given
    command_min: float = 0.0  # [-]
    thrust_delay: float = 0.0  # [s] from the logged command to the thrust that it makes

    def force(self, command):
        """Force [N] of motors at commands (...), an array or tensor."""
        return sum(coefficient * command**power for power, coefficient in enumerate(self.thrust_curve))


@dataclass(frozen=True)
class Sensors:
    """What a measurement can be at most; a log's row beyond it is rejected."""

    rate_max: float = 2000 * math.pi / 180  # [rad/s] full scale of common gyroscopes
    speed_max: float = 40.0  # [m/s]
    voltage_min: float = 0.0  # [V]
    voltage_max: float = math.inf  # [V]


@dataclass(frozen=True)
class Vehicle:
    """A robot of one's own: its model, and what is needed to read its logs."""

    name: str
    system: System
    motors: Motors | None = None
    sensors: Sensors = Sensors()


MOTOR_UNITS = {"thrust_curve": "N", "command_max": "", "command_min": "", "thrust_delay": "s"}
SENSOR_UNITS = {"rate_max": "rad/s", "speed_max": "m/s", "voltage_min": "V", "voltage_max": "V"}


def conversion(unit, expected, where):
    """Factor from `unit` to the SI unit `expected`.

    Raises:
        InputError: when `unit` is not of that kind; `where` names the file and field.
    """
    known = CONVERSIONS[expected]
    if unit not in known:
        wanted = " or ".join(repr(name) for name in known) if expected else "a plain number"
        raise InputError(f"{where}: unit {unit!r}, expected {wanted}")
    return known[unit]


def quantity(text, expected, where):
    """A "number unit" such as "34 g" in the SI unit `expected`."""
    if isinstance(text, int | float) and not isinstance(text, bool):
        text = str(text)  # a bare number is allowed where no unit is expected
    number, _, unit = text.strip().partition(" ") if isinstance(text, str) else ("", "", "")
    try:
        value = float(number)
    except ValueError:
        raise InputError(f'{where}: {text!r}, expected a number and a unit such as "1.5 {expected}"') from None
    if not math.isfinite(value):
        raise InputError(f"{where}: {text!r}, expected a finite number")
    return value * conversion(unit.strip(), expected, where)


def read_toml(path):
    """The tables of a TOML file.

    Raises:
        InputError: when it is missing, unreadable or not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the path of a TOML file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not a TOML file ({error})") from None


def shipped_vehicles():
    """Names of the vehicles that come with the package."""
    return sorted(entry.name[:-5] for entry in _shipped().iterdir() if entry.name.endswith(".toml"))


def _shipped():
    return resources.files("envs") / "vehicle_data"


def load_vehicle(name_or_path):
    """A `Vehicle` by the name of a shipped one or from the path of a TOML file.

    Raises:
        InputError: naming file and field, for an unknown vehicle or field, a wrong unit, or an impossible value.
    """
    text = str(name_or_path)
    if text in shipped_vehicles():
        with resources.as_file(_shipped() / f"{text}.toml") as path:
            return _vehicle(read_toml(path), f"{text}.toml")
    if not text.endswith(".toml"):
        known = ", ".join(shipped_vehicles())
        raise InputError(f"--vehicle {text}: expected one of {known}, or the path of a .toml file")
    return _vehicle(read_toml(text), text)


def _vehicle(tables, where):
    _known(tables, ("name", "system", "parameters", "motors", "sensors"), where)
    kinds = {kind.name: kind for kind in UNITS}
    if (kind := kinds.get(found := tables.get("system", Quadrotor.name))) is None:
        raise InputError(f"{where}: system {found!r}, expected {' or '.join(repr(name) for name in kinds)}")
    name = tables.get("name", Path(where).stem)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: name {name!r}, expected a word")
    if "motors" in tables and kind is not Quadrotor:
        raise InputError(f"{where}: [motors] are those of a {Quadrotor.name}, this is a {kind.name}; leave them out")
    units = UNITS[kind]
    series = {field: len(default) for field in units if isinstance(default := getattr(kind, field), tuple)}
    required = [field for field in units if field not in OPTIONAL]
    parameters = _values(tables, "parameters", units, required, where, series)
    try:
        system = kind(**parameters)
    except InputError as error:
        raise InputError(f"{where}: [parameters] {error}") from None
    motors = _motors(tables, where) if "motors" in tables else None
    return Vehicle(name, system, motors, _sensors(tables, where))


def _motors(tables, where):
    motors = Motors(**_values(tables, "motors", MOTOR_UNITS, _required(Motors), where, {"thrust_curve": None}))
    if not motors.command_min < motors.command_max:
        low, high = motors.command_min, motors.command_max
        raise InputError(f"{where}: [motors] command_min {low:g} is not below command_max {high:g}")
    if not motors.force(motors.command_min) < motors.force(motors.command_max):
        raise InputError(f"{where}: [motors] thrust_curve does not grow between command_min and command_max")
    if motors.thrust_delay < 0:
        raise InputError(f"{where}: [motors] thrust_delay is {motors.thrust_delay:g} s, expected zero or more")
    return motors


def _sensors(tables, where):
    sensors = Sensors(**_values(tables, "sensors", SENSOR_UNITS, (), where)) if "sensors" in tables else Sensors()
    for name in ("rate_max", "speed_max"):
        if getattr(sensors, name) <= 0:
            raise InputError(f"{where}: [sensors] {name} is {getattr(sensors, name):g}, expected more than zero")
    if not sensors.voltage_min < sensors.voltage_max:
        low, high = sensors.voltage_min, sensors.voltage_max
        raise InputError(f"{where}: [sensors] voltage_min {low:g} V is not below voltage_max {high:g} V")
    return sensors


def _values(tables, table, units, required, where, series=()):
    """The quantities of one table in SI units, as keyword arguments.

    Args:
        series: {field: how many values it has, or None if that is open} of the fields that are lists.
    """
    given = tables.get(table, {})
    where = f"{where}: [{table}]"
    if not isinstance(given, dict):
        raise InputError(f"{where} is {given!r}, expected a table")
    _known(given, units, where)
    if missing := [name for name in required if name not in given]:
        raise InputError(f"{where} lacks {', '.join(missing)}")
    values = {}
    for name, text in given.items():
        place = f"{where} {name}"
        if name in series:
            values[name] = _series(text, units[name], place, series[name])
        elif isinstance(text, list):
            raise InputError(f"{place}: a list, expected one value")
        else:
            values[name] = quantity(text, units[name], place)
    return values


def _series(entries, unit, where, count):
    """The values of a list, which may be written without brackets if it is one value."""
    values = tuple(quantity(entry, unit, where) for entry in (entries if isinstance(entries, list) else [entries]))
    if count is not None and len(values) != count:
        raise InputError(f"{where}: {len(values)} values, expected {count}")
    return values


def _known(given, names, where):
    if unknown := [name for name in given if name not in names]:
        raise InputError(f"{where}: unknown field {unknown[0]!r}; expected some of {', '.join(names)}")


def _required(kind):
    return [field.name for field in fields(kind) if field.default is MISSING]
