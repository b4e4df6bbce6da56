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
    voltage = {columns = ["vbat"], unit = "V", optional = true}  # optional: left out where the log has no such column
    require = {estimate_valid = [1]}  # rows in which a column has another value are rejected

A column of a CSV is the name in its header. One of a PX4 ULog is `topic.field`, such as `vehicle_attitude.q[0]`, or
`battery_status[1].voltage_v` for the second instance of a topic; one of a ROS bag is `/topic.field`, such as
`/odometry.pose.pose.position.x`. The topic of the time column is the clock to which the others are brought, see
`adapt.log_topics`. In a ROS bag `/topic.recorded` is the time of recording, and times are in seconds.

Files to copy are in `adapt/mapping_data/`: `csv.toml`, and the shipped mappings of topics.
"""

from dataclasses import dataclass, field, replace
from importlib import resources
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
OPTIONAL = ("rate_commands", "voltage")
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
    optional: bool = False


@dataclass(frozen=True)
class Mapping:
    """Quantities of a log by name, see the module's text."""

    name: str
    quantities: dict[str, Quantity]
    axes: str = "z-up"
    require: dict[str, tuple] = field(default_factory=dict)  # {column: the values that a row may have there}

    @property
    def columns(self):
        """Every column that the mapping reads."""
        return [column for quantity in self.quantities.values() for column in quantity.columns] + list(self.require)

    def missing(self, columns):
        """What the mapping needs and is not among `columns`."""
        needed = [quantity for quantity in self.quantities.values() if not quantity.optional]
        return [c for q in needed for c in q.columns if c not in columns] + [
            c for c in self.require if c not in columns
        ]

    def fitted(self, columns):
        """The same without the optional quantities that `columns` don't hold."""
        kept = {name: q for name, q in self.quantities.items() if all(column in columns for column in q.columns)}
        return replace(self, quantities=kept)


def parse_mapping(tables, name):
    """A `Mapping` from the tables of its TOML form.

    Raises:
        InputError: naming the mapping and the entry, for unknown or missing entries, units, frames and orders.
    """
    if unknown := [entry for entry in tables if entry not in (*KINDS, "axes", "require")]:
        known = ", ".join(KINDS)
        raise InputError(f"mapping {name}: unknown entry {unknown[0]!r}; expected axes, require or some of {known}")
    if missing := [entry for entry in NEEDED if entry not in tables]:
        raise InputError(f"mapping {name}: lacks {', '.join(missing)}")
    if "motors" not in tables and "thrust" not in tables:
        raise InputError(f"mapping {name}: lacks motors or thrust, one of which is needed")
    axes = _one_of(tables.get("axes", AXES[0]), AXES, f"mapping {name}: axes")
    quantities = {entry: _quantity(entry, tables[entry], name) for entry in KINDS if entry in tables}
    if optional := [entry for entry in quantities if entry not in OPTIONAL and quantities[entry].optional]:
        raise InputError(f"mapping {name}: {optional[0]}: optional applies to {' and '.join(OPTIONAL)} only")
    return Mapping(name, quantities, axes, _require(tables.get("require", {}), name))


def _require(given, name):
    if not isinstance(given, dict) or not all(isinstance(values, list) and values for values in given.values()):
        raise InputError(f"mapping {name}: require is {given!r}, expected {{column = [values that are good]}}")
    return {column: tuple(values) for column, values in given.items()}


def _quantity(entry, given, name):
    where = f"mapping {name}: {entry}"
    units, width, frame = KINDS[entry]
    if not isinstance(given, dict) or not isinstance(given.get("columns"), list | tuple):
        raise InputError(f'{where} is {given!r}, expected {{columns = [...], unit = "..."}}')
    applies = {"frame": frame is not None, "order": entry == "attitude"}
    allowed = ("columns", "unit", "optional", *(key for key in applies if applies[key]))
    if unknown := [key for key in given if key not in allowed]:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; expected some of {', '.join(allowed)}")
    columns = tuple(given["columns"])
    if not columns or not all(isinstance(column, str) for column in columns) or len(columns) != (width or len(columns)):
        raise InputError(f"{where}: columns {list(columns)}, expected {width or 'one or more'} column names")
    unit, factor = _unit(given.get("unit", ""), units, where)
    if frame is not None:
        frame = _one_of(given.get("frame", frame), ("world", "body"), f"{where}: frame")
    order = _one_of(given.get("order", ORDERS[0]), ORDERS, f"{where}: order")
    optional = _one_of(given.get("optional", False), (True, False), f"{where}: optional")
    return Quantity(columns, unit, factor, frame, order, optional)


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


# What "auto" tries for a kind of file, in this order; beside tables these are TOML files.
KINDS_OF_FILE = {
    "csv": tuple(MAPPINGS),
    "ulog": ("px4_odometry", "px4", "px4_outputs"),
    "rosbag": ("ros",),
}


def find_mappings(name_or_path, kind="csv"):
    """The mappings that a name stands for: one, or for "auto" all built-in ones for that kind of file, best first.

    Args:
        name_or_path: "auto", the name of a built-in mapping, or the path of a TOML file.
        kind: of file, one of `KINDS_OF_FILE`.

    Raises:
        InputError: when the mapping is unknown or wrong.
    """
    text = str(name_or_path)
    if text == "auto":
        return [_shipped(name) for name in KINDS_OF_FILE[kind]]
    shipped = [name for names in KINDS_OF_FILE.values() for name in names]
    if text in shipped:
        return [_shipped(text)]
    if text.endswith(".toml"):
        return [parse_mapping(read_toml(text), Path(text).name)]
    raise InputError(f"--mapping {text}: expected auto, one of {', '.join(shipped)}, or the path of a .toml file")


def _shipped(name):
    if name in MAPPINGS:
        return MAPPINGS[name]
    with resources.as_file(resources.files("adapt") / "mapping_data" / f"{name}.toml") as path:
        return parse_mapping(read_toml(path), name)


def _columns_are_missing(columns):
    return f"the columns {', '.join(columns)}, which are missing"


def choose_mapping(mappings, columns, log, lacks=_columns_are_missing):
    """The first of the mappings that reads a log with these columns, less its optional quantities that they lack.

    Args:
        mappings: of `find_mappings`.
        columns: the column names of the log.
        log: what the log is called in errors.
        lacks: from missing columns to words that follow "needs".

    Raises:
        InputError: when columns that are needed are missing.
    """
    missing = {mapping.name: mapping.missing(columns) for mapping in mappings}
    for mapping in mappings:
        if not missing[mapping.name]:
            return mapping.fitted(columns)
    closest = min(missing, key=lambda name: len(missing[name]))
    if len(mappings) == 1:
        raise InputError(f"{log}: mapping {closest} needs {lacks(missing[closest])}")
    raise InputError(
        f"{log}: no built-in mapping fits; {closest} is closest and needs {lacks(missing[closest])}; "
        f"copy a file of {resources.files('adapt') / 'mapping_data'}, put your names in, and give it with --mapping"
    )
