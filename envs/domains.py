"""Source and target domains: how the robot differs from its model.

A `Domain` changes parameters (a payload, a longer pole) and adds disturbances (drag, wind, a push). The empty domain is
the source. On the command line a domain is written `drag=0.3`, `mass=x1.2`, `push=0.5,0,0.2`; several combine. Its
sensors may err: `noise=1` is the noise of `NOISE` on every measured state, `noise=0.5` half of it. Where a camera
watches the robot, its picture may differ too: `brightness=0.7`, `cart_colour=200,40,40`, `camera_noise=4`.
"""

import math
from dataclasses import dataclass, fields, replace
from functools import partial

from envs.camera import CHANGEABLE, Camera
from envs.errors import InputError

WIND_DRAG = 0.3  # [1/s] rotor drag through which a disturbance `wind` is felt


def drag(system, x, u, strength):
    """Linear drag: v' <- v' - strength v, strength in 1/s (Faessler et al. 2017)."""
    return system.accelerate(x, tuple(-strength[0] * v for v in system.velocity(x)))


def quadratic_drag(system, x, u, strength):
    """Drag that grows with the square of the speed: v' <- v' - strength |v| v, strength in 1/m."""
    velocity = system.velocity(x)
    speed = (sum(v * v for v in velocity) + 1e-12).sqrt()  # the small number keeps the gradient finite at rest
    return system.accelerate(x, tuple(-strength[0] * speed * v for v in velocity))


def push(system, x, u, strength):
    """A constant force per mass in world axes [m/s^2]; a single number pushes along x."""
    return system.accelerate(x, strength)


def wind(system, x, u, strength):
    """Steady wind [m/s] on a robot with rotor drag of 0.3 1/s: what it adds to the drag in still air."""
    return system.accelerate(x, tuple(WIND_DRAG * w for w in strength))


DISTURBANCES = {"drag": drag, "quadratic_drag": quadratic_drag, "push": push, "wind": wind}
# Standard deviation of what sensors say of each kind of state; white, independent for each entry, state and step.
NOISE = {
    "position": 0.001,  # [m]
    "velocity": 0.02,  # [m/s]
    "attitude": math.radians(0.5),  # [rad] about each axis
    "rates": 0.05,  # [rad/s]
}
SCALAR = ("drag", "quadratic_drag")  # disturbances whose strength has no direction and can't be negative
# The camera's settings as a target names them; its noise goes by another name than that of the measured states.
PICTURE = {"camera_noise" if name == "noise" else name: name for name in CHANGEABLE}


@dataclass(frozen=True)
class Domain:
    """How a target differs: parameters, disturbances, what a camera sees, and how far sensors err.

    Parameter changes are (field, value) pairs, disturbances (name, strength) with a strength in x, y, z, and changes of
    the picture (field, text), see `Camera.changed`; `noise` is a factor on `NOISE`.
    """

    changes: tuple[tuple[str, float], ...] = ()
    disturbances: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    picture: tuple[tuple[str, str], ...] = ()
    noise: float = 0.0

    def __post_init__(self):
        if not 0 <= self.noise < math.inf:
            raise InputError(f"noise is {self.noise:g}, expected a factor of at least 0")

    def apply(self, system):
        """The changed system; its low-level controller keeps the beliefs of the source."""
        return replace(system.configured(), **dict(self.changes)) if self.changes else system

    def forces(self):
        """The disturbances as functions (system, x, u) -> {state name: extra rate}."""
        return tuple(partial(DISTURBANCES[name], strength=strength) for name, strength in self.disturbances)

    def deviations(self, system):
        """Standard deviations of a system's measured states, in the order of `System.difference`; empty without noise.

        Raises:
            InputError: noise, but a system that doesn't say what its states are.
        """
        if self.noise and not system.quantities:
            raise InputError(f"noise: {system.name} doesn't say what its states are; give its class `quantities`")
        return tuple(self.noise * NOISE[kind] for kind in system.quantities) if self.noise else ()

    def seen(self, task):
        """The task, through the changed camera.

        Raises:
            InputError: the picture differs, but the task is one whose policies see the state.
        """
        if not self.picture:
            return task
        if task.camera is None:
            field, value = self.picture[0]
            name = next(name for name in PICTURE if PICTURE[name] == field)
            raise InputError(
                f"--target {name}={value}: changes the picture, but this policy sees the state; leave it out"
            )
        return replace(task, camera=task.camera.changed(self.picture))


def parse_target(text, system):
    """Read `drag=0.3` or several, separated by spaces or given as a sequence, for a system.

    Raises:
        InputError: on an unknown name, a value that isn't a number, or one that makes no physical sense.
    """
    items = text.split() if isinstance(text, str) else [item for part in text for item in part.split()]
    changes, disturbances, picture, noise = {}, [], [], 0.0
    for item in items:
        name, sign, value = item.partition("=")
        if not sign or not name or not value:
            raise InputError(f"--target {item}: expected NAME=VALUE, such as drag=0.3 or mass=x1.2")
        if name in _parameters(system):
            changes.update(_changes(item, name, value, system, changes))
        elif name in DISTURBANCES:
            disturbances.append((name, _strength(item, name, value)))
        elif name == "noise":
            noise = _amount(item, name, value)
        elif system.drawn and name in PICTURE:
            picture.append((PICTURE[name], value))
        else:
            known = ", ".join([*DISTURBANCES, "noise", *_parameters(system), *(PICTURE if system.drawn else ())])
            raise InputError(f"--target {item}: {system.name} has no {name!r}; expected one of {known}")
    domain = Domain(tuple(changes.items()), tuple(disturbances), tuple(picture), noise)
    try:
        domain.apply(system)  # all changes at once: one alone may make no sense yet
        domain.deviations(system)
        Camera().changed(domain.picture)
    except InputError as error:
        raise InputError(f"--target {' '.join(items)}: {error}") from None
    return domain


def _parameters(system):
    """Names that a target may change: numeric fields and groups of them; the control period belongs to the task."""
    own = [f.name for f in fields(system) if isinstance(getattr(system, f.name), float) and f.name != "dt"]
    return [*own, *system.groups]


def _changes(item, name, value, system, earlier):
    """The new value of each field that `name` stands for; `x1.2` multiplies, and later items see earlier ones."""
    members = system.groups.get(name, (name,))
    if value.startswith("x"):
        factor = _number(item, value[1:])
        if not any(getattr(system, field) for field in members):
            raise InputError(f"--target {item}: {name} is 0, which no factor changes; give a value such as {name}=0.1")
        return {field: factor * earlier.get(field, getattr(system, field)) for field in members}
    if len(members) > 1:
        raise InputError(f"--target {item}: {name} stands for {', '.join(members)}; give a factor such as {name}=x1.2")
    return {members[0]: _number(item, value)}


def _strength(item, name, value):
    if name in SCALAR:
        return _amount(item, name, value), 0.0, 0.0
    numbers = tuple(_number(item, part) for part in value.split(","))
    if len(numbers) not in (1, 3):
        raise InputError(f"--target {item}: expected one number (along x) or three (x,y,z)")
    return (*numbers, 0.0, 0.0)[:3]


def _amount(item, name, value):
    numbers = [_number(item, part) for part in value.split(",")]
    if len(numbers) != 1 or numbers[0] < 0:
        raise InputError(f"--target {item}: expected one number of at least 0, such as {name}=0.3")
    return numbers[0]


def _number(item, text):
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"--target {item}: {text!r} is not a number") from None
    if value != value or abs(value) == float("inf"):
        raise InputError(f"--target {item}: {text!r} is not a finite number")
    return value
