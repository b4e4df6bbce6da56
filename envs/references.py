"""Reference trajectories of a quadrotor: random minimum-snap polynomials, drawn by split.

A reference is a tensor `(N, steps, 12)` of flat points (see `envs.flatness`). Row k is the point at time k * dt. All
begin at the origin. Other references: named shapes (`envs.shapes`) and waypoints from a file (`envs.waypoints`).
"""

import hashlib
import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.errors import InputError
from envs.flatness import VELOCITY, FlightLimits, feasible
from envs.minimum_snap import minimum_snap
from envs.shapes import check_steps

SPLITS = ("train", "validation", "test")


# --- who may see what ----------------------------------------------------------------------------------------------


def split_generator(split: str, seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """The random stream of one split: what is drawn for "test" is never drawn for training, whatever the seeds.

    The stream's seed is a 64-bit BLAKE2b hash of the user's seed with its two lowest bits replaced by the place of the
    split in `SPLITS`. So two splits differ for any two seeds, also on the CPU, whose generator uses only 32 bits.

    Raises:
        InputError: unknown split.
    """
    if split not in SPLITS:
        raise InputError(f"split {split!r}: no such split, take one of {', '.join(SPLITS)}")
    mixed = int.from_bytes(hashlib.blake2b(str(int(seed)).encode(), digest_size=8).digest(), "little")
    return torch.Generator(device=device).manual_seed(mixed & ~0b11 | SPLITS.index(split))


# --- random polynomials -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpeedSet:
    """A set of random curves: the speeds that each curve must have over its first 10 s, and how it is drawn."""

    mean: tuple[float, float]  # [m/s] range of the mean speed of each curve
    peak: tuple[float, float]  # [m/s] range of the top speed of each curve
    segment: tuple[float, float]  # [s] range of the time between waypoints
    variation: float  # [-] standard deviation of the log of the speed from segment to segment
    turn: float  # [rad] standard deviation of the change of heading from segment to segment
    climb: float  # [rad] standard deviation of the slope of a segment


RANDOM_SETS = {
    "paper": SpeedSet(mean=(1.0, 2.0), peak=(3.0, 5.0), segment=(1.2, 3.0), variation=1.0, turn=1.4, climb=0.5),
    "fast": SpeedSet(mean=(2.5, 3.5), peak=(0.0, math.inf), segment=(1.5, 3.0), variation=0.25, turn=1.0, climb=0.4),
}

STATISTICS_TIME = 10.0  # [s] the speeds of a set hold over the first 10 s; steps behind them are horizon
CHECK_DT = 0.05  # [s] finer than a control period, so that curves stay inside between the points too
LAYOUTS = 64  # different knot times in a call; one linear map each, solved once
CANDIDATES = 32  # candidates in each layout in a batch
BATCHES, ACCEPTANCE = 10, 0.01  # gives up where, after so many batches, less than this share can be flown


def random_polynomials(
    n: int,
    *,
    kind: str = "paper",
    steps: int = 111,
    dt: float = 0.1,
    speed: float = 1.0,
    limits: FlightLimits = FlightLimits(),
    generator: torch.Generator,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Random minimum-snap polynomials (order 7, through random waypoints) that the vehicle can fly.

    Each curve has the speeds of its set over its first 10 s at full speed, and stays inside 90 % of the limits over its
    whole length, `steps` at full speed. Candidates that don't are rejected. The same generator state gives the same
    curves, and the first curves of a longer call.

    Args:
        n: number of curves.
        kind: a name in `RANDOM_SETS`.
        steps: points in a curve. 111: 10 s and a horizon of 10.
        dt: time between them [s].
        speed: in (0, 1], plays the same curve slower (velocity times speed, jerk times speed^3), so less of it.
        generator: the only source of randomness; its device is where the curves are made.
        dtype: default torch's default.

    Returns:
        `(n, steps, 12)`, columns `FLAT`, each from the origin.

    Raises:
        InputError: an argument out of range, or limits within which hardly any curve of the set can be flown.
    """
    _check_random(n, kind, steps, dt, speed)
    speed_set, dtype = RANDOM_SETS[kind], dtype or torch.get_default_dtype()
    length = max(STATISTICS_TIME, (steps - 1) * dt)
    durations, knots = _layouts(speed_set, length, generator)
    check_times = torch.arange(0, length + CHECK_DT / 2, CHECK_DT, dtype=torch.float64).clamp(max=length)
    check = torch.stack([_leg_map(layout_knots, check_times) for layout_knots in knots]).to(durations.device, dtype)
    legs, layout = [], []
    for batch in itertools.count(1):
        drawn = _random_legs(speed_set, durations.to(dtype), generator)
        curves = _flat(check, drawn)
        scale = _speed_scale(curves, speed_set, generator)
        good = (feasible(curves * scale[:, None, None], limits, margin=0.9) & (scale > 0)).nonzero()[:, 0]
        legs.append(drawn.permute(3, 0, 1, 2).flatten(0, 1)[good] * scale[good, None, None])
        layout.append(good % LAYOUTS)
        count = sum(map(len, layout))
        if count >= n:
            break
        if batch >= BATCHES and count < ACCEPTANCE * batch * LAYOUTS * CANDIDATES:
            raise InputError(
                f"random references {kind!r}: only {count} of {batch * LAYOUTS * CANDIDATES} curves can be flown "
                f"within {limits}; raise the thrust or rate limits, or take a slower set"
            )
    times = (speed * dt * torch.arange(steps, dtype=torch.float64)).clamp(max=length)
    return _slower(_play(knots, times, torch.cat(legs)[:n], torch.cat(layout)[:n]), speed)


def _check_random(n: int, kind: str, steps: int, dt: float, speed: float) -> None:
    if kind not in RANDOM_SETS:
        raise InputError(f"random references {kind!r}: no such set, take one of {', '.join(RANDOM_SETS)}")
    if n < 1:
        raise InputError(f"random references: n is {n}, ask for at least 1")
    if not 0 < speed <= 1:
        raise InputError(f"random references: speed is {speed:g}, expected more than 0 and at most 1")
    check_steps(steps, dt)


def _rand(low: float, high: float, shape: tuple[int, ...], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator, device=generator.device, dtype=dtype)


def _layouts(speed_set: SpeedSet, length: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Segment durations `(L, M)` [s] on the generator's device, knot times `(L, M + 1)` on the CPU, float64.

    The curve is cut out of the middle, because the free ends fling: it begins somewhere in the second segment, and a
    segment follows it.
    """
    shape = (LAYOUTS, math.ceil(length / speed_set.segment[0]) + 3)
    durations = _rand(*speed_set.segment, shape, generator, torch.float64)
    begin = durations[:, :1] + _rand(0.0, 1.0, (LAYOUTS, 1), generator, torch.float64) * durations[:, 1:2]
    knots = torch.cat((-begin, durations.cumsum(-1) - begin), -1)
    return durations, knots.cpu()


def _leg_map(knots: Tensor, times: Tensor) -> Tensor:
    """From the legs of one layout to flat points as `(T * 4, M)`, positions relative to the first time."""
    to_flat = minimum_snap(knots, times, rest=False)
    to_flat[:, 0] -= to_flat[:1, 0].clone()
    legs_to_waypoints = torch.ones(len(knots), len(knots) - 1, dtype=knots.dtype).tril(-1)
    return (to_flat @ legs_to_waypoints).flatten(0, 1)


def _random_legs(speed_set: SpeedSet, durations: Tensor, generator: torch.Generator) -> Tensor:
    """Way from waypoint to waypoint `(L, M, 3, CANDIDATES)`: heading walks at random, slope and speed don't."""
    shape = (*durations.shape, CANDIDATES)
    pace, turn, climb = (
        torch.randn(shape, generator=generator, device=durations.device, dtype=durations.dtype) for _ in range(3)
    )
    first = _rand(0.0, 2 * math.pi, (LAYOUTS, 1, CANDIDATES), generator, durations.dtype)
    heading, slope = first + (speed_set.turn * turn).cumsum(1), speed_set.climb * climb
    direction = torch.stack((slope.cos() * heading.cos(), slope.cos() * heading.sin(), slope.sin()), 2)
    return direction * ((speed_set.variation * pace).exp() * durations[..., None])[:, :, None]


def _flat(maps: Tensor, legs: Tensor) -> Tensor:
    """Flat points `(CANDIDATES * L, T, 12)`; neighbours come from different layouts."""
    layouts, rows, _ = maps.shape
    points = (maps @ legs.flatten(2)).view(layouts, rows // 4, 4, 3, CANDIDATES)
    return points.permute(4, 0, 1, 2, 3).reshape(CANDIDATES * layouts, rows // 4, 12)


def _speed_scale(curves: Tensor, speed_set: SpeedSet, generator: torch.Generator) -> Tensor:
    """Size `(N,)` that gives each curve a random mean speed with mean and peak both in range; 0 if there is none."""
    speeds = curves[:, : round(STATISTICS_TIME / CHECK_DT) + 1, VELOCITY].norm(dim=-1)
    mean, peak = speeds.mean(-1), speeds.amax(-1)
    low = (speed_set.peak[0] / peak).maximum(speed_set.mean[0] / mean)
    high = (speed_set.peak[1] / peak).minimum(speed_set.mean[1] / mean)
    scale = low + (high - low) * torch.rand(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
    return torch.where(high > low, scale, torch.zeros_like(scale))


def _play(knots: Tensor, times: Tensor, legs: Tensor, layout: Tensor) -> Tensor:
    """Curves with these legs `(N, M, 3)`, each in its layout `(N,)`, at `times` `(T,)`: `(N, T, 12)`."""
    flat = legs.new_empty(len(legs), len(times), 12)
    for index in layout.unique().tolist():
        here = layout == index
        flat[here] = (_leg_map(knots[index], times).to(legs) @ legs[here]).reshape(-1, len(times), 12)
    return flat


def _slower(flat: Tensor, speed: float) -> Tensor:
    """The derivatives of a curve played at `speed` times its speed."""
    return flat * flat.new_tensor([speed**order for order in range(4) for _ in range(3)])
