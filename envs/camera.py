"""The camera that watches a robot: geometry of the picture, and how things look in it."""

import math
from dataclasses import dataclass, fields, replace

from envs.errors import InputError

BACKGROUNDS = ("plain", "gradient", "checks")
LARGEST = 2000  # sides of a picture, and what else is counted in pixels
COLOURS = ("cart_colour", "pole_colour", "tip_colour", "rail_colour", "background_colour")


@dataclass(frozen=True)
class Camera:
    """Geometry of the picture, and how things look in it. Colours are red, green, blue in 0 ... 255."""

    height: int = 48  # [px]
    width: int = 144  # [px]
    scale: float = 29.0  # [px/m] the whole rail of 4.8 m is seen
    offset_x: float = 0.0  # [m] position on the rail in the middle of the picture
    offset_z: float = 0.45  # [m] height above the hinge in the middle of the picture
    frames: int = 4  # pictures that a policy sees at once, the newest first
    cart_colour: tuple[float, ...] = (40.0, 70.0, 150.0)
    pole_colour: tuple[float, ...] = (200.0, 110.0, 30.0)
    tip_colour: tuple[float, ...] = (200.0, 110.0, 30.0)
    rail_colour: tuple[float, ...] = (120.0, 120.0, 120.0)
    background_colour: tuple[float, ...] = (235.0, 235.0, 235.0)
    background: str = "plain"  # or "gradient", "checks"
    brightness: float = 1.0  # [-] factor on every pixel
    blur: float = 0.0  # [px] standard deviation of a Gaussian blur
    noise: float = 0.0  # [grey levels] standard deviation of noise on every pixel

    def __post_init__(self):
        for name, least in (("height", 8), ("width", 8), ("frames", 1)):
            if not getattr(self, name) >= least:
                raise InputError(f"camera: {name} is {getattr(self, name)}, expected at least {least}")
        for name in ("height", "width", "frames"):
            if getattr(self, name) > LARGEST:
                raise InputError(f"camera: {name} is {getattr(self, name)}, expected at most {LARGEST}")
        for name in ("scale", "brightness"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"camera: {name} is {getattr(self, name):g}, expected more than 0")
        for name in ("blur", "noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"camera: {name} is {getattr(self, name):g}, expected at least 0")
        for name in ("scale", "blur"):
            if getattr(self, name) > LARGEST:
                raise InputError(f"camera: {name} is {getattr(self, name):g}, expected at most {LARGEST}")
        for name in ("offset_x", "offset_z"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"camera: {name} is {getattr(self, name):g}, expected a number of metres")
        for name in COLOURS:
            if len(getattr(self, name)) != 3 or not all(0 <= part <= 255 for part in getattr(self, name)):
                raise InputError(f"camera: {name} is {getattr(self, name)}, expected red,green,blue in 0 ... 255")
        if self.background not in BACKGROUNDS:
            raise InputError(f"camera: background is {self.background!r}, expected one of {', '.join(BACKGROUNDS)}")

    @property
    def shape(self):
        """Channels, height and width of what a policy sees."""
        return 3 * self.frames, self.height, self.width

    def changed(self, changes):
        """The camera after changes, as (field, text) pairs: a number, `x1.2` to multiply, or red,green,blue.

        Raises:
            InputError: a value that makes no sense.
        """
        return replace(self, **{name: self._value(name, text) for name, text in changes})

    def _value(self, name, text):
        before = getattr(self, name)
        if isinstance(before, str):
            return text
        try:
            if isinstance(before, int):
                return int(text)
            if text.startswith("x") and isinstance(before, float):
                return before * float(text[1:])
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"camera: {name} is {text!r}, expected a number") from None
        if len(numbers) != (3 if isinstance(before, tuple) else 1):
            expected = "red,green,blue" if isinstance(before, tuple) else "one number"
            raise InputError(f"camera: {name} is {text!r}, expected {expected}")
        return numbers if isinstance(before, tuple) else numbers[0]


SETTINGS = tuple(item.name for item in fields(Camera))
CHANGEABLE = tuple(name for name in SETTINGS if name not in ("height", "width", "frames"))  # in a target: not the shape
