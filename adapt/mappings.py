"""Which columns of a flight log hold which quantity, in which unit, frame and order.

A mapping of one's own is a TOML file, one line a quantity. `motors` or `thrust` is needed, and all that is above them:

    axes = "z-up"  # the default; "z-down" is north-east-down with a forward-right-down body
    time = {columns = ["t"], unit = "ms"}
    position = {columns = ["x", "y", "z"], unit = "m"}  # world
    attitude = {columns = ["qx", "qy", "qz", "qw"], order = "xyzw"}  # body to world; the order defaults to "wxyz"
    velocity = {columns = ["u", "v", "w"], unit = "m/s", frame = "body"}  # the frame defaults to "world"
    rates = {columns = ["p", "q", "r"], unit = "deg/s"}  # the frame defaults to "body"
    motors = {columns = ["m1", "m2", "m3", "m4"]}  # commands, made forces by the vehicle's thrust curve
    thrust = {columns = ["T"], unit = "N"}  # collective; N, or m/s^2 per mass
    rate_commands = {columns = ["pd", "qd", "rd"], unit = "deg/s"}  # body
    voltage = {columns = ["vbat"], unit = "V"}
"""

from dataclasses import dataclass
from pathlib import Path

from envs.errors import InputError
from envs.vehicles import conversion, read_toml

KINDS = {  # quantity: (SI units it may be given in, number of columns or None for any, the default frame)
    "time": (("s",), 1, None),
    "position": (("m",), 3, None),
    "attitude": (("",), 4, None),
    "velocity": (("m/s",), 3, "world"),
    "rates": (("rad/s",), 3, "body"),
    "motors": (("",), None, None),
    "thrust": (("N", "m/s^2"), 1, None),
    "rate_commands": (("rad/s",), 3, None),
    "voltage": (("V",), 1, None),
}
NEEDED = ("time", "position", "attitude", "velocity", "rates")
AXES = ("z-up", "z-down")
ORDERS = ("wxyz", "xyzw")


@dataclass(frozen=True)
class Quantity:
    """The columns of one quantity; `factor` takes their unit to the SI unit `unit`."""

    columns: tuple[str, ...]
    unit: str
    factor: float
    frame: str | None = None
    order: str = "wxyz"


@dataclass(frozen=True)
class Mapping:
    """Quantities of a log by name, see the module's text."""

    name: str
    quantities: dict[str, Quantity]
    axes: str = "z-up"

    @property
    def columns(self):
        """Every column that the mapping reads."""
        return [column for quantity in self.quantities.values() for column in quantity.columns]


def parse_mapping(tables, name):
    """A `Mapping` from the tables of its TOML form.

    Raises:
        InputError: naming the mapping and the entry, for unknown or missing entries, units, frames and orders.
    """
    if unknown := [entry for entry in tables if entry not in KINDS and entry != "axes"]:
        raise InputError(f"mapping {name}: unknown entry {unknown[0]!r}; expected axes or some of {', '.join(KINDS)}")
    if missing := [entry for entry in NEEDED if entry not in tables]:
        raise InputError(f"mapping {name}: lacks {', '.join(missing)}")
    if "motors" not in tables and "thrust" not in tables:
        raise InputError(f"mapping {name}: lacks motors or thrust, one of which is needed")
    axes = _one_of(tables.get("axes", AXES[0]), AXES, f"mapping {name}: axes")
    quantities = {entry: _quantity(entry, tables[entry], name) for entry in KINDS if entry in tables}
    return Mapping(name, quantities, axes)


def _quantity(entry, given, name):
    where = f"mapping {name}: {entry}"
    units, width, frame = KINDS[entry]
    if not isinstance(given, dict) or not isinstance(given.get("columns"), list | tuple):
        raise InputError(f'{where} is {given!r}, expected {{columns = [...], unit = "..."}}')
    optional = {"frame": frame is not None, "order": entry == "attitude"}
    allowed = ("columns", "unit", *(key for key, applies in optional.items() if applies))
    if unknown := [key for key in given if key not in allowed]:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; expected some of {', '.join(allowed)}")
    columns = tuple(given["columns"])
    if not columns or not all(isinstance(column, str) for column in columns) or len(columns) != (width or len(columns)):
        raise InputError(f"{where}: columns {list(columns)}, expected {width or 'one or more'} column names")
    unit, factor = _unit(given.get("unit", ""), units, where)
    if frame is not None:
        frame = _one_of(given.get("frame", frame), ("world", "body"), f"{where}: frame")
    order = _one_of(given.get("order", ORDERS[0]), ORDERS, f"{where}: order")
    return Quantity(columns, unit, factor, frame, order)


def _unit(unit, units, where):
    """The SI unit among `units` that `unit` belongs to, and the factor to it."""
    for candidate in units[:-1]:
        try:
            return candidate, conversion(unit, candidate, where)
        except InputError:
            continue
    return units[-1], conversion(unit, units[-1], where)


def _one_of(value, choices, where):
    if value not in choices:
        raise InputError(f"{where} is {value!r}, expected {' or '.join(repr(choice) for choice in choices)}")
    return value


SIMPLE = {
    "time": {"columns": ["t"], "unit": "s"},
    "position": {"columns": ["px", "py", "pz"], "unit": "m"},
    "attitude": {"columns": ["qw", "qx", "qy", "qz"]},
    "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s"},
    "rates": {"columns": ["p", "q", "r"], "unit": "rad/s"},
}
MOTORS = {"motors": {"columns": ["motor1", "motor2", "motor3", "motor4"]}}
THRUST = {"thrust": {"columns": ["thrust"], "unit": "m/s^2"}}
VOLTAGE = {"voltage": {"columns": ["vbat"], "unit": "V"}}
NANOBENCH = {
    "time": {"columns": ["t"], "unit": "s"},
    "position": {"columns": ["px", "py", "pz"], "unit": "m"},
    "attitude": {"columns": [f"att_stateEstimate_q{axis}" for axis in "wxyz"]},
    "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s"},
    "rates": {"columns": [f"imu_gyro_{axis}" for axis in "xyz"], "unit": "rad/s"},
    "motors": {"columns": [f"motor_motor_m{i}" for i in range(1, 5)]},
    "voltage": {"columns": ["pwr_pm_vbat"], "unit": "V"},
}

# Built-in mappings by name; a log without a stated mapping is read by the first that fits its columns.
# NanoBench has two attitudes. The on-board estimate is the default: it is what a policy would see in flight, and on the
# fitting flights it agrees better with gyroscope and acceleration. The motion capture's drifts by up to 0.05 rad from
# flight to flight (markers moved) and jumps.
MAPPINGS = {
    "nanobench": parse_mapping(NANOBENCH, "nanobench"),
    "nanobench_mocap": parse_mapping(
        {**NANOBENCH, "attitude": {"columns": ["qw", "qx", "qy", "qz"]}}, "nanobench_mocap"
    ),
    "motors": parse_mapping({**SIMPLE, **MOTORS, **VOLTAGE}, "motors"),
    "thrust": parse_mapping({**SIMPLE, **THRUST, **VOLTAGE}, "thrust"),
    "motors_only": parse_mapping({**SIMPLE, **MOTORS}, "motors_only"),
    "thrust_only": parse_mapping({**SIMPLE, **THRUST}, "thrust_only"),
}


def find_mapping(name_or_path, columns, log):
    """The mapping that reads a log with these columns.

    Args:
        name_or_path: "auto", the name of a built-in mapping, or the path of a TOML file.
        columns: the column names of the log.
        log: what the log is called in errors.

    Raises:
        InputError: when the mapping is unknown, or columns that it needs are missing.
    """
    text = str(name_or_path)
    if text == "auto":
        return _first_that_fits(columns, log)
    if text in MAPPINGS:
        mapping = MAPPINGS[text]
    elif text.endswith(".toml"):
        mapping = parse_mapping(read_toml(text), Path(text).name)
    else:
        raise InputError(f"--mapping {text}: expected auto, one of {', '.join(MAPPINGS)}, or the path of a .toml file")
    if missing := [column for column in mapping.columns if column not in columns]:
        raise InputError(f"{log}: mapping {mapping.name} needs the columns {', '.join(missing)}, which are missing")
    return mapping


def _first_that_fits(columns, log):
    lacks = {name: [column for column in m.columns if column not in columns] for name, m in MAPPINGS.items()}
    for name, missing in lacks.items():
        if not missing:
            return MAPPINGS[name]
    closest = min(lacks, key=lambda name: len(lacks[name]))
    raise InputError(
        f"{log}: no built-in mapping fits; {closest} is closest and lacks the columns {', '.join(lacks[closest])}; "
        "describe the log in a mapping .toml file"
    )
