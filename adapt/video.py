"""A film of one flight before and after the adaptation, in real time: an MP4 or GIF drawn with OpenCV.

Both flights of the test episode with the median zero-shot error are seen at the same time from the same place, each
with its trail, the reference, where it should be now, and a close-up that follows the robot.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from adapt import plots
from adapt.plot_style import COLOURS, GREY, LIGHT, number, small
from adapt.report import NAMES
from envs.dynamics import TORCH
from envs.errors import InputError
from policies.files import replacing, whole

PANEL = (640, 540)  # [pixel] width and height of one flight's picture; half as high where flights stand one on another
MARGIN = 50  # [pixel] around the scene
HEADER = 70  # [pixel] for the text
INSET = 180  # [pixel] side of the close-up where there is room for it
CLOSE = 5.0  # [-] magnification of the close-up
ROBOT = 0.05  # [-] size of the robot as a share of the scene
GAP = 12  # [pixel] between close-up and edge
GIF_WIDTH, GIF_COLOURS = 760, 48  # [pixel], [-]
FONT = cv2.FONT_HERSHEY_DUPLEX


@dataclass(frozen=True)
class Camera:
    """An orthographic view: `offset` [pixel] is where the point `centre` [m] appears."""

    right: np.ndarray
    up: np.ndarray
    centre: np.ndarray
    offset: tuple[float, float]
    scale: float  # [pixel/m]

    def __call__(self, points):
        """Pixels (N, 2) of points (N, 3); those with a NaN are left out."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        away = points[np.isfinite(points).all(-1)] - self.centre
        flat = np.stack((away @ self.right, -(away @ self.up)), -1)
        return np.clip(self.offset + self.scale * flat, -30000, 30000)


@dataclass(frozen=True)
class Flight:
    """One flight as it is shown: arrays over the frames."""

    title: str
    colour: tuple[int, int, int]  # blue, green, red
    states: torch.Tensor  # (F, n)
    trail: np.ndarray  # (F, 3) [m]
    errors: list[str]  # (F) in words


def write_video(adaptation, path, fps=30.0):
    """Film the flight before and after the adaptation; the file is there whole or not at all.

    Raises:
        InputError: `path` doesn't end in .mp4 or .gif or can't be written, or `fps` isn't positive.
    """
    if not 0 < fps < float("inf"):
        raise InputError(f"--video {path}: {fps:g} frames per second, expected more than 0")
    write_frames(path, lambda: frames(adaptation, fps), fps)


def write_frames(path, film, fps):
    """Write the pictures (height, width, 3), blue, green, red, that `film()` yields as an MP4 or a GIF.

    Raises:
        InputError: `path` doesn't end in .mp4 or .gif, or can't be written.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise InputError(f"--video {path}: expected a name that ends in {' or '.join(WRITERS)}")
    if not path.parent.is_dir():
        raise InputError(f"--video {path}: there is no folder {path.parent}")
    WRITERS[path.suffix](path, film(), fps)


def _write_gif(path, film, fps):
    """A looped GIF, small enough for a web page. All pictures share one palette, so that nothing flickers."""
    from PIL import Image

    images = []
    for frame in film:
        share = min(1.0, GIF_WIDTH / frame.shape[1])
        small = cv2.resize(frame, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        images.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
    palette = images[len(images) // 2].quantize(GIF_COLOURS)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    with replacing(path) as partial:
        first.save(partial, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)


def _write_mp4(path, film, fps):
    first = next(film)
    with whole(path) as partial:
        writer = cv2.VideoWriter(str(partial), cv2.VideoWriter_fourcc(*"mp4v"), fps, first.shape[1::-1])
        try:
            if not writer.isOpened():
                raise InputError(f"--video {path}: OpenCV can't write an MP4 file there; name a writable place")
            writer.write(first)
            for frame in film:
                writer.write(frame)
        finally:
            writer.release()


WRITERS = {".mp4": _write_mp4, ".gif": _write_gif}


def frames(adaptation, fps):
    """Yield the pictures (height, width, 3), blue, green, red."""
    task, row = adaptation.policy.task, plots.representative(adaptation)
    shown = [adaptation.evaluations[name] for name in ("zero_shot", "few_shot")]
    duration = max(plots.last_steps(task, evaluation)[row] for evaluation in shown) * task.system.dt
    times = np.arange(int(duration * fps + 1e-9) + 1) / fps
    flights = [_flight(adaptation, name, row, times) for name in ("zero_shot", "few_shot")]
    reference = _reference(task, shown[0].episodes[row : row + 1], times)
    size = ROBOT * _extent(np.concatenate([reference, *(flight.trail for flight in flights)]))
    camera, panel, stacked = _camera(task.system, flights, reference, size)
    floor = _floor(task.system, camera, flights, reference, size)
    canvases = [_background(camera, panel, floor, reference) for _ in flights]
    corner = _corner(camera, panel, flights, reference)
    for i, time in enumerate(times):
        pictures = []
        for flight, canvas in zip(flights, canvases, strict=True):
            _line(canvas, camera(flight.trail[max(0, i - 1) : i + 1]), flight.colour, 3)
            outline = task.system.outline(_scalars(task.system, flight.states[i]), size)
            pictures.append(_picture(canvas.copy(), camera, outline, flight, reference, i, corner))
            _text(pictures[-1], f"{time:.1f} s", (panel[0] - 20, 32), _colour(GREY), right=True)
        yield np.concatenate(pictures, 0 if stacked else 1)


# --- what is shown ----------------------------------------------------------------------------------------------------


def _flight(adaptation, name, row, times):
    task, evaluation = adaptation.policy.task, adaptation.evaluations[name]
    last = plots.last_steps(task, evaluation)[row]
    steps = np.minimum(times / task.system.dt, last)
    states = _at(evaluation.states[row].cpu().double(), steps)
    states = TORCH.pack(task.system.project(task.system.State(*states.unbind(-1))))
    trail = np.array([_floats(task.system.place(_scalars(task.system, state))) for state in states])
    error = _at(torch.as_tensor(plots.traces(task, evaluation)[row]).nan_to_num(), steps).numpy()
    factor, unit = small([error.max()], task.trace_unit)
    title = f"{NAMES[name]}, mean of all: {plots.score(evaluation, plots.score_scale(adaptation))}"
    errors = [f"{task.trace_name} {number(value)} {unit}" for value in factor * error]
    return Flight(title, _colour(COLOURS[name]), states, trail, errors)


def _at(series, steps):
    """Values of a series (T + 1, ...) between its steps (F,), interpolated linearly."""
    before = torch.as_tensor(np.minimum(steps.astype(int), len(series) - 2))
    share = torch.as_tensor(steps) - before
    share = share.reshape(-1, *[1] * (series.dim() - 1))
    return series[before] + share * (series[before + 1] - series[before])


def _reference(task, episode, times):
    """Where the robot should be (F, 3); NaN where nothing is prescribed."""
    with torch.no_grad():
        path = _at(task.path(episode)[0].cpu().double(), np.minimum(times / task.system.dt, task.steps))
    columns = dict(zip(task.reference_names, path.unbind(-1), strict=True))
    nothing = torch.full((len(times),), torch.nan)
    states = torch.stack([columns.get(name, nothing) for name in task.system.State._fields], -1)
    return np.array([_floats(task.system.place(_scalars(task.system, state))) for state in states])


def _scalars(system, state):
    return system.State(*state.tolist())


def _floats(point):
    return tuple(float(c) for c in point)


def _extent(points):
    """Diagonal [m] of the box around points (N, 3)."""
    points = points[np.isfinite(points).all(-1)]
    return max(float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0, 0.2)


# --- camera -----------------------------------------------------------------------------------------------------------


def _camera(system, flights, reference, size):
    """The view that holds everything, its panel's size, and whether flights stand one on another."""
    azimuth, elevation = np.radians(system.filmed_from)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([-np.cos(azimuth) * np.sin(elevation), -np.sin(azimuth) * np.sin(elevation), np.cos(elevation)])
    points = _seen(system, flights, reference, size)
    across, high = points @ right, points @ up
    width, height = max(np.ptp(across), 1e-3), max(np.ptp(high), 1e-3)
    middle = (across.max() + across.min()) / 2 * right + (high.max() + high.min()) / 2 * up
    options = []
    for stacked, panel in ((False, PANEL), (True, (2 * PANEL[0], PANEL[1] // 2 + HEADER))):
        room = panel[0] - 2 * MARGIN, panel[1] - MARGIN - HEADER
        options.append((min(room[0] / width, room[1] / height), stacked, panel))
    scale, stacked, panel = max(options, key=lambda option: (option[0], not option[1]))
    offset = panel[0] / 2, HEADER + (panel[1] - MARGIN - HEADER) / 2
    return Camera(right, up, middle, offset, scale), panel, stacked


def _seen(system, flights, reference, size):
    """All points (N, 3) that must fit into the picture."""
    points = [reference, *(flight.trail for flight in flights)]
    for flight in flights:
        for state in flight.states[:: max(1, len(flight.states) // 20)]:
            points += [np.array(line, dtype=float) for line in system.outline(_scalars(system, state), size)]
    points = np.concatenate(points)
    return points[np.isfinite(points).all(-1)]


def _floor(system, camera, flights, reference, size):
    """Lines of a grid under everything, 1, 2 or 5 times a power of ten metres apart."""
    points = _seen(system, flights, reference, size)
    low, high = points.min(0), points.max(0)
    raw = _extent(points) / 8
    power = 10.0 ** np.floor(np.log10(raw))
    spacing = power * next(m for m in (1, 2, 5, 10) if m * power >= raw)
    (x0, y0), (x1, y1) = np.floor(low[:2] / spacing) * spacing, np.ceil(high[:2] / spacing) * spacing
    xs, ys = np.arange(x0, x1 + spacing / 2, spacing), np.arange(y0, y1 + spacing / 2, spacing)
    z = low[2]
    lines = [((x, y0, z), (x, y1, z)) for x in xs] + [((x0, y, z), (x1, y, z)) for y in ys]
    return [camera(line) for line in lines], z


# --- drawing ----------------------------------------------------------------------------------------------------------


def _background(camera, panel, floor, reference):
    canvas = np.full((panel[1], panel[0], 3), 255, np.uint8)
    lines, z = floor
    for line in lines:
        _line(canvas, line, _colour("#DADADA"), 1)
    shadow = reference.copy()
    shadow[:, 2] = z
    _line(canvas, camera(shadow), _colour("#E0E0E0"), 3)
    _line(canvas, camera(reference), _colour(LIGHT), 7)
    return canvas


def _picture(canvas, camera, outline, flight, reference, i, corner):
    """One flight in one frame: robot, close-up and text on a canvas that has the rest."""
    _robot(canvas, camera, outline, flight, reference[i], i)
    if np.isfinite(reference[i]).all() and np.isfinite(flight.trail[i]).all():
        _close_up(canvas, camera, outline, flight, reference, i, corner)
    _text(canvas, flight.title, (20, 32), flight.colour)
    _text(canvas, flight.errors[i], (20, 60), _colour(GREY))
    return canvas


def _robot(canvas, camera, outline, flight, goal, i):
    for point in camera(goal):
        cv2.circle(canvas, _pixel(point), 6, _colour(GREY), 2, cv2.LINE_AA)
    for line in outline:
        pixels = camera(line)
        if len(pixels) > 2 and np.array_equal(line[0], line[-1]):
            cv2.fillPoly(canvas, [np.round(16 * pixels).astype(np.int32)], _colour("#D0D0D0"), cv2.LINE_AA, shift=4)
        _line(canvas, pixels, (0, 0, 0), 2)
    for point in camera(flight.trail[i]):
        cv2.circle(canvas, _pixel(point), 4, flight.colour, -1, cv2.LINE_AA)


def _close_up(canvas, camera, outline, flight, reference, i, corner):
    """A magnified view around the robot, which stays as small as it is."""
    x, y, side = corner
    inset = np.full((side, side, 3), 255, np.uint8)
    centre = flight.trail[i]
    near = Camera(camera.right, camera.up, centre, (side / 2, side / 2), CLOSE * camera.scale)
    _line(inset, near(reference), _colour(LIGHT), 9)
    _line(inset, near(flight.trail[: i + 1]), flight.colour, 4)
    shrunk = [centre + (np.array(line) - centre) / CLOSE for line in outline]
    _robot(inset, near, shrunk, flight, reference[i], i)
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), _colour(GREY), 2)
    canvas[y : y + side, x : x + side] = inset


def _corner(camera, panel, flights, reference):
    """Where the close-up hides least of the paths: its left upper corner and its side [pixel]."""
    pixels = camera(np.concatenate([reference, *(flight.trail for flight in flights)]))
    side = min(INSET, (panel[1] - HEADER) // 2)
    xs, ys = (panel[0] - side - GAP, GAP, (panel[0] - side) // 2), (panel[1] - side - GAP, HEADER)

    def hidden(place):
        away = np.abs(pixels - (np.array(place) + side / 2)).max(-1)
        return int((away < side / 2 + GAP).sum())

    return (*min(((x, y) for y in ys for x in xs), key=hidden), side)


def _line(canvas, pixels, colour, width):
    if len(pixels) > 1:
        cv2.polylines(canvas, [np.round(16 * pixels).astype(np.int32)], False, colour, width, cv2.LINE_AA, shift=4)


def _text(canvas, text, place, colour, right=False):
    text = text.replace("–", "-")  # OpenCV's letters are ASCII
    if right:
        place = place[0] - cv2.getTextSize(text, FONT, 0.75, 1)[0][0], place[1]
    cv2.putText(canvas, text, place, FONT, 0.75, colour, 1, cv2.LINE_AA)


def _pixel(point):
    return tuple(round(c) for c in point)


def _colour(text):
    """Blue, green, red of "#RRGGBB"."""
    return tuple(int(text[i : i + 2], 16) for i in (5, 3, 1))
