"""Named reference shapes, in closed form: circle, lemniscate, line and hover.

Each is a tensor `(1, steps, 12)` of flat points (see `envs.flatness`) from the origin, row k at time k * dt.
"""

import math

import torch
from torch import Tensor

from envs.errors import InputError

Device = torch.device | str | None  # None: the CPU


def circle(
    radius: float = 2.0,
    speed: float = 2.0,
    *,
    steps: int = 111,
    dt: float = 0.1,
    dtype: torch.dtype | None = None,
    device: Device = None,
) -> Tensor:
    """Level circle, counter-clockwise from the origin along x, `(1, steps, 12)`; radius [m], speed [m/s]."""
    _check_positive("circle", radius=radius)
    rate = speed / radius
    phase = rate * sample_times(steps, dt)
    x = _sine(radius, rate, phase)
    y = _sine(radius, rate, phase - math.pi / 2)
    y[:, 0] += radius
    return _assemble(x, y, torch.zeros_like(x), dtype, device)


def lemniscate(
    radius: float = 3.0,
    speed: float = 2.0,
    *,
    steps: int = 111,
    dt: float = 0.1,
    dtype: torch.dtype | None = None,
    device: Device = None,
) -> Tensor:
    """Level figure eight of Gerono, x = r sin(s), y = r/2 sin(2s), `(1, steps, 12)`.

    radius [m] is the half length; speed [m/s] is the top speed, in the crossing, where it begins.
    """
    _check_positive("lemniscate", radius=radius)
    rate = speed / (math.sqrt(2.0) * radius)
    phase = rate * sample_times(steps, dt)
    x, y = _sine(radius, rate, phase), _sine(radius / 2, 2 * rate, 2 * phase)
    return _assemble(x, y, torch.zeros_like(x), dtype, device)


def line(
    speed: float = 2.0,
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0),
    *,
    steps: int = 111,
    dt: float = 0.1,
    dtype: torch.dtype | None = None,
    device: Device = None,
) -> Tensor:
    """Straight line from the origin at constant speed [m/s], `(1, steps, 12)`; direction of any length but 0."""
    length = math.hypot(*direction)
    _check_positive("line", length_of_direction=length)
    times = sample_times(steps, dt)
    axes = []
    for part in direction:
        axis = times.new_zeros(steps, 4)
        axis[:, 1] = speed * part / length
        axis[:, 0] = axis[:, 1] * times
        axes.append(axis)
    return _assemble(*axes, dtype, device)


def hover(*, steps: int = 111, dt: float = 0.1, dtype: torch.dtype | None = None, device: Device = None) -> Tensor:
    """Standing at the origin, `(1, steps, 12)`."""
    still = torch.zeros(len(sample_times(steps, dt)), 4, dtype=torch.float64)
    return _assemble(still, still, still, dtype, device)


NAMED = {"circle": circle, "lemniscate": lemniscate, "line": line, "hover": hover}


def _check_positive(shape: str, **values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise InputError(f"{shape}: {name.replace('_', ' ')} is {value:g}, expected more than 0")


def check_steps(steps: int, dt: float) -> None:
    """Refuse a reference of no length.

    Raises:
        InputError: no step, or a dt that isn't positive.
    """
    if steps < 1 or not 0 < dt < math.inf:
        raise InputError(f"references: steps is {steps} and dt {dt:g} s, expected at least 1 step and a positive dt")


def sample_times(steps: int, dt: float) -> Tensor:
    """Times of the points of a reference `(steps,)` [s], float64.

    Raises:
        InputError: no step, or a dt that isn\'t positive.
    """
    check_steps(steps, dt)
    return dt * torch.arange(steps, dtype=torch.float64)


def _sine(size: float, rate: float, phase: Tensor) -> Tensor:
    """size * sin(phase) and three derivatives by time, phase `(T,)` growing at `rate` [rad/s]: `(T, 4)`."""
    sin, cos = phase.sin(), phase.cos()
    return size * torch.stack((sin, rate * cos, -(rate**2) * sin, -(rate**3) * cos), -1)


def _assemble(x: Tensor, y: Tensor, z: Tensor, dtype: torch.dtype | None, device: Device) -> Tensor:
    """Axes `(T, 4)` (p, v, a, j) to `(1, T, 12)`."""
    flat = torch.stack((x, y, z), -1).flatten(1)[None]
    return flat.to(device or "cpu", dtype or torch.get_default_dtype())
