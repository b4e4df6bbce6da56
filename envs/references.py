"""Reference trajectories of a quadrotor: random minimum-snap polynomials, named shapes, waypoints from a file.

A reference is a tensor `(N, steps, 12)` of flat points, columns `FLAT`: position [m], velocity [m/s], acceleration
[m/s^2] and jerk [m/s^3] in the world frame, z up. Row k is the point at time k * dt. Random curves
and named shapes begin at the origin.

Mellinger & Kumar (2011), "Minimum snap trajectory generation and control for quadrotors", ICRA: minimum snap, flatness.
Bry, Richter, Bachrach & Roy (2015), "Aggressive flight of fixed-wing and quadrotor aircraft in dense indoor
environments", IJRR 34(7): the closed form with the derivatives at the knots as unknowns.
"""

import csv
import hashlib
import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from envs.errors import InputError

FLAT = ("px", "py", "pz", "vx", "vy", "vz", "ax", "ay", "az", "jx", "jy", "jz")
POSITION, VELOCITY, ACCELERATION, JERK = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)

SPLITS = ("train", "validation", "test")

Device = torch.device | str | None  # None: the CPU


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


# --- what a vehicle can fly ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlightLimits:
    """What a flat curve may ask of a vehicle; the defaults are those of `Quadrotor`."""

    gravity: float = 9.81  # [m/s^2]
    thrust_min: float = 2.31  # [m/s^2] mass-normalised
    thrust_max: float = 17.31  # [m/s^2] mass-normalised
    rate_x: float = 0.5  # [rad/s] largest |body rate|
    rate_y: float = 0.5  # [rad/s]
    rate_z: float = 0.5  # [rad/s]


def flatness(flat: Tensor, gravity: float) -> tuple[Tensor, Tensor, Tensor]:
    """Thrust, attitude and body rates with which a quadrotor flies along flat points, its nose towards world x.

    Mellinger & Kumar (2011), sect. III. Heading as in Faessler, Franchi & Scaramuzza (2018), "Differential flatness of
    quadrotor dynamics subject to rotor drag", without drag: the body x axis stays in the world x-z plane
    (yaw-pitch-roll with yaw 0), and the body z rate is the one that keeps it there, not Mellinger's approximation 0.

    Args:
        flat: `(..., 12)`, columns `FLAT`.
        gravity: [m/s^2].

    Returns:
        thrust `(...)` [m/s^2] mass-normalised; quaternion `(..., 4)` body to world, scalar first, qw >= 0; body rates
        `(..., 3)` [rad/s]. Free fall (acceleration equal to gravity) has no attitude: rates aren't finite there.
    """
    ax, ay, az = flat[..., ACCELERATION].unbind(-1)
    jx, jy, jz = flat[..., JERK].unbind(-1)
    lift = az + gravity
    lift_in_plane = (ax * ax + lift * lift).sqrt()  # the part in the x-z plane
    thrust = (lift_in_plane * lift_in_plane + ay * ay).sqrt()
    # z_b = Ry(pitch) Rx(roll) e_z = (cos(roll) sin(pitch), -sin(roll), cos(roll) cos(pitch))
    sin_roll, cos_roll = -ay / thrust, lift_in_plane / thrust
    sin_pitch, cos_pitch = ax / lift_in_plane, lift / lift_in_plane
    jerk_in_plane = jx * sin_pitch + jz * cos_pitch
    p = -(cos_roll * jy + sin_roll * jerk_in_plane) / thrust  # -(jerk . y_b) / thrust
    q = (jx * cos_pitch - jz * sin_pitch) / thrust  # (jerk . x_b) / thrust
    r = -q * sin_roll / cos_roll  # keeps x_b in the x-z plane
    return (
        thrust,
        _roll_pitch_quaternion(torch.atan2(-ay, lift_in_plane), torch.atan2(ax, lift)),
        torch.stack((p, q, r), -1),
    )


def _roll_pitch_quaternion(roll: Tensor, pitch: Tensor) -> Tensor:
    """Quaternion of Ry(pitch) Rx(roll), angles `(...)` [rad] to `(..., 4)`."""
    sin_r, cos_r = (roll / 2).sin(), (roll / 2).cos()
    sin_p, cos_p = (pitch / 2).sin(), (pitch / 2).cos()
    return torch.stack((cos_p * cos_r, cos_p * sin_r, sin_p * cos_r, -sin_p * sin_r), -1)


def feasible(flat: Tensor, limits: FlightLimits, margin: float = 0.9) -> Tensor:
    """Which curves `(N, T, 12)` stay inside the limits at every point: bool `(N,)`.

    `margin` shrinks each range about its middle: 0.9 leaves the middle 90 % of the thrust range and rates up to 90 %.
    """
    thrust, _, rates = flatness(flat, limits.gravity)
    middle, half = (limits.thrust_max + limits.thrust_min) / 2, (limits.thrust_max - limits.thrust_min) / 2
    rate_limits = rates.new_tensor((limits.rate_x, limits.rate_y, limits.rate_z))
    thrust_fits = (thrust - middle).abs() <= margin * half  # False where not finite
    rates_fit = (rates.abs() <= margin * rate_limits).all(-1)
    return (thrust_fits & rates_fit).all(-1)


# --- minimum snap -------------------------------------------------------------------------------------------------


def _monomials(times: Tensor) -> Tensor:
    """Value and first three derivatives of t^0 ... t^7 at `times` `(T,)`: `(T, 4, 8)`."""
    powers = torch.arange(8, dtype=times.dtype)
    rows = []
    for order in range(4):
        falling = torch.stack([powers - i for i in range(order)]).prod(0) if order else torch.ones_like(powers)
        rows.append(falling * times[:, None] ** (powers - order).clamp(min=0))
    return torch.stack(rows, 1)


def _hermite(dtype: torch.dtype) -> Tensor:
    """`(8, 8)`: from the four derivatives at t = 0 and the four at t = 1 to the coefficients of the polynomial."""
    return torch.linalg.inv(_monomials(torch.tensor([0.0, 1.0], dtype=dtype)).reshape(8, 8))


def _duration_scale(durations: Tensor) -> Tensor:
    """`(M, 8)`: real-time derivatives of orders 0-3 at both ends of a segment to those of a segment of length 1."""
    scale = durations[:, None] ** torch.arange(4, dtype=durations.dtype)
    return torch.cat((scale, scale), -1)


def snap_hessian(knot_times: Tensor) -> Tensor:
    """`(4K, 4K)`: the integral of snap^2 is d' H d, d = (p, v, a, j) at each of the K knots `(K,)` [s], one axis."""
    durations = knot_times.diff()
    powers = torch.arange(8, dtype=knot_times.dtype)
    falling = powers * (powers - 1) * (powers - 2) * (powers - 3)
    gram = falling[:, None] * falling / (powers[:, None] + powers - 7).clamp(min=1)
    hermite, scale = _hermite(knot_times.dtype), _duration_scale(durations)
    unit = hermite.T @ gram @ hermite
    hessian = knot_times.new_zeros(4 * len(knot_times), 4 * len(knot_times))
    for k, duration in enumerate(durations):
        hessian[4 * k : 4 * k + 8, 4 * k : 4 * k + 8] += unit * scale[k] * scale[k, :, None] / duration**7
    return hessian


def knot_map(knot_times: Tensor, *, rest: bool) -> Tensor:
    """`(4K, K)`: from the waypoints of one axis to (p, v, a, j) at each knot on the curve of least snap through them.

    `rest`: velocity, acceleration and jerk are zero at both ends (K >= 2); otherwise they are free (K >= 4).
    """
    count = len(knot_times)
    order = torch.arange(4 * count) % 4
    free = order > 0
    if rest:
        free[:4] = free[-4:] = False
    hessian = snap_hessian(knot_times)
    to_knots = knot_times.new_zeros(4 * count, count)
    to_knots[order == 0] = torch.eye(count, dtype=knot_times.dtype)
    # Cholesky is indifferent to the very different scales of v, a and j on short and long segments
    factor = torch.linalg.cholesky(hessian[free][:, free])
    to_knots[free] = -torch.cholesky_solve(hessian[free][:, order == 0], factor)
    return to_knots


def minimum_snap(knot_times: Tensor, times: Tensor, *, rest: bool) -> Tensor:
    """The curve of least snap through waypoints as one linear map, `(T, 4, K)`: `map @ waypoints` is `(T, 4, axes)`.

    Args:
        knot_times: increasing times of the waypoints `(K,)` [s], float64.
        times: where to sample position, velocity, acceleration and jerk `(T,)` [s], within the knots.
        rest: as in `knot_map`.
    """
    segment = (torch.searchsorted(knot_times, times, right=True) - 1).clamp(0, len(knot_times) - 2)
    duration = knot_times.diff()[segment]
    scaled = _monomials((times - knot_times[segment]) / duration) @ _hermite(knot_times.dtype)
    scaled = scaled * _duration_scale(duration)[:, None] / _duration_scale(duration)[:, :4, None]
    ends = knot_map(knot_times, rest=rest).reshape(len(knot_times), 4, -1)
    return scaled @ torch.cat((ends[segment], ends[segment + 1]), 1)


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
        steps, dt: points in a curve and the time between them [s]. 111: 10 s and a horizon of 10.
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
    _check_steps(steps, dt)


def _check_steps(steps: int, dt: float) -> None:
    if steps < 1 or not 0 < dt < math.inf:
        raise InputError(f"references: steps is {steps} and dt {dt:g} s, expected at least 1 step and a positive dt")


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


# --- named shapes -------------------------------------------------------------------------------------------------


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
    phase = rate * _times(steps, dt)
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
    phase = rate * _times(steps, dt)
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
    times = _times(steps, dt)
    axes = []
    for part in direction:
        axis = times.new_zeros(steps, 4)
        axis[:, 1] = speed * part / length
        axis[:, 0] = axis[:, 1] * times
        axes.append(axis)
    return _assemble(*axes, dtype, device)


def hover(*, steps: int = 111, dt: float = 0.1, dtype: torch.dtype | None = None, device: Device = None) -> Tensor:
    """Standing at the origin, `(1, steps, 12)`."""
    still = torch.zeros(len(_times(steps, dt)), 4, dtype=torch.float64)
    return _assemble(still, still, still, dtype, device)


NAMED = {"circle": circle, "lemniscate": lemniscate, "line": line, "hover": hover}


def _check_positive(shape: str, **values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise InputError(f"{shape}: {name.replace('_', ' ')} is {value:g}, expected more than 0")


def _times(steps: int, dt: float) -> Tensor:
    _check_steps(steps, dt)
    return dt * torch.arange(steps, dtype=torch.float64)


def _sine(size: float, rate: float, phase: Tensor) -> Tensor:
    """size * sin(phase) and three derivatives by time, phase `(T,)` growing at `rate` [rad/s]: `(T, 4)`."""
    sin, cos = phase.sin(), phase.cos()
    return size * torch.stack((sin, rate * cos, -(rate**2) * sin, -(rate**3) * cos), -1)


def _assemble(x: Tensor, y: Tensor, z: Tensor, dtype: torch.dtype | None, device: Device) -> Tensor:
    """Axes `(T, 4)` (p, v, a, j) to `(1, T, 12)`."""
    flat = torch.stack((x, y, z), -1).flatten(1)[None]
    return flat.to(device or "cpu", dtype or torch.get_default_dtype())


# --- waypoints from a file ----------------------------------------------------------------------------------------

COLUMNS = ("t", "x", "y", "z")
WAYPOINTS_MAX = 1000  # the closed form is dense: 1000 take about a second


def read_waypoints(
    path: Path | str, *, steps: int, dt: float, dtype: torch.dtype | None = None, device: Device = None
) -> Tensor:
    """Minimum-snap polynomial through the waypoints of a CSV file, at rest at both ends, `(1, steps, 12)`.

    The file has the columns t [s], x, y, z [m] (world, z up), one waypoint a row at increasing, not necessarily even
    times; other columns are ignored. The reference begins at the first row, wherever its clock starts, and holds the
    last point after the end. Nothing checks that a vehicle can fly it: see `feasible`.

    Raises:
        InputError: no such file, not a CSV, a missing column, a cell that isn't a finite number, time that doesn't
            increase, too few or too many rows, times too uneven to solve.
    """
    times = _times(steps, dt)
    table = _read_table(Path(path))
    knots, waypoints = table[:, 0] - table[0, 0], table[:, 1:]
    flat = (minimum_snap(knots, times.clamp(max=knots[-1]), rest=True) @ waypoints).flatten(1)
    after = times >= knots[-1]
    flat[after, POSITION] = waypoints[-1]
    flat[after, 3:] = 0.0
    return flat[None].to(device or "cpu", dtype or torch.get_default_dtype())


def _read_table(path: Path) -> Tensor:
    """The columns t, x, y, z of a file as `(K, 4)` float64."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            names = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except OSError as error:
        raise InputError(f"{path}: can't read waypoints ({error.strerror}); name a CSV file with t,x,y,z") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV text file; expected a header t,x,y,z and numbers") from error
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}; the first row must name t,x,y,z [s, m]")
    if not 2 <= len(rows) <= WAYPOINTS_MAX:
        raise InputError(f"{path}: {len(rows)} waypoints, expected 2 to {WAYPOINTS_MAX}; add rows or thin the file")
    places = {name: names.index(name) for name in COLUMNS}
    table = [[_number(path, row, name, cells, at) for name, at in places.items()] for row, cells in rows]
    for i in range(1, len(table)):
        if table[i][0] <= table[i - 1][0]:
            raise InputError(
                f"{path}: row {rows[i][0]}: t is {table[i][0]:g} after {table[i - 1][0]:g}; it must increase"
            )
    _check_spacing(path, [here[0] - before[0] for before, here in itertools.pairwise(table)])
    return torch.tensor(table, dtype=torch.float64)


def _check_spacing(path: Path, durations: list[float]) -> None:
    """What is so uneven loses its digits in the solution, whose terms go with the seventh power of a duration."""
    short, long = min(durations), max(durations)
    if short < 1e-6 or long > 1e6 or long > 1e4 * short:
        raise InputError(
            f"{path}: the times between waypoints run from {short:g} to {long:g} s; "
            "expected 1e-6 to 1e6 s, and nowhere 10000 times the shortest: space them more evenly"
        )


def _number(path: Path, row: int, name: str, cells: list[str], at: int) -> float:
    """The finite number in a cell; `row` counts lines of the file, its header is row 1."""
    text = cells[at].strip() if at < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: row {row}: {name} is {text!r}, expected a finite number")
    return value
