"""The CartPole as a fixed camera sees it, drawn by OpenCV.

Nothing in a picture is placed by the state other than cart and pole themselves: the camera doesn't follow the cart.
Edges are anti-aliased and placed at a 256th of a pixel, so that a motion of a millimetre changes the picture.
"""

from functools import lru_cache

import cv2
import numpy as np
import torch

SHIFT = 8  # fractional bits of the coordinates that OpenCV gets
CART, POLE, HINGE, TIP = (0.32, 0.18), 0.07, 0.035, 0.045  # [m] cart width and height, pole width, radii
RAIL, TICKS = 2.4, 0.5  # [m] half length of the rail, and between its ticks
BLACK = (30, 30, 30)


def draw(camera, system, state, generator=None):
    """Pictures (N, 3, height, width), uint8, of states (N, 4) of a `CartPole`.

    Args:
        camera: `Camera`.
        system: says how long the pole is.
        generator: numpy's, draws the noise; None is a fresh one with seed 0.
    """
    drawn = np.empty((len(state), 3, camera.height, camera.width), np.uint8)
    empty, frame = _empty(camera), np.empty((camera.height, camera.width, 3), np.uint8)
    cart, pole, tip = camera.cart_colour, camera.pole_colour, camera.tip_colour
    radii = [round(radius * camera.scale * 2**SHIFT) for radius in (HINGE, TIP)]
    outlines = _outlines(camera, system, state.detach().cpu().double().numpy())
    for i, (body, rod, hinge, end) in enumerate(zip(*outlines, strict=True)):
        np.copyto(frame, empty)
        cv2.fillConvexPoly(frame, body, cart, cv2.LINE_AA, SHIFT)
        cv2.fillConvexPoly(frame, rod, pole, cv2.LINE_AA, SHIFT)
        cv2.circle(frame, hinge, radii[0], BLACK, cv2.FILLED, cv2.LINE_AA, SHIFT)
        cv2.circle(frame, end, radii[1], tip, cv2.FILLED, cv2.LINE_AA, SHIFT)
        if camera.blur:
            cv2.GaussianBlur(frame, (0, 0), camera.blur, dst=frame)
        cv2.split(frame, list(drawn[i]))
    return torch.from_numpy(_exposed(camera, drawn, generator))


def _exposed(camera, drawn, generator):
    """Brightness and noise of the sensor."""
    if camera.brightness == 1 and not camera.noise:
        return drawn
    levels = camera.brightness * drawn.astype(np.float32)
    if camera.noise:
        generator = generator or np.random.default_rng(0)
        levels += camera.noise * generator.standard_normal(levels.shape, np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _pixels(camera, x, z):
    """Where points of the world (...) are in the picture (..., 2), in fixed point; pixel centres are whole numbers."""
    column = (x - camera.offset_x) * camera.scale + (camera.width - 1) / 2
    row = (camera.height - 1) / 2 - (z - camera.offset_z) * camera.scale
    far = 4 * max(camera.width, camera.height)  # what left the picture long ago must not overflow
    points = np.nan_to_num(np.stack((column, row), -1), nan=far).clip(-far, far)
    return np.rint(points * 2**SHIFT).astype(np.int32)


def _outlines(camera, system, state):
    """Corners of cart (N, 4, 2) and pole (N, 4, 2), and the places of hinge and tip as lists of tuples."""
    x, angle = state[:, 0], state[:, 2]
    corners = np.array([(-0.5, 0), (0.5, 0), (0.5, -1), (-0.5, -1)]) * CART
    cart = _pixels(camera, x[:, None] + corners[:, 0], 0 * x[:, None] + corners[:, 1])
    along, across = np.stack((np.sin(angle), np.cos(angle)), -1), np.stack((np.cos(angle), -np.sin(angle)), -1)
    length = 2 * system.pole_half_length
    ends = ((0, -0.5), (length, -0.5), (length, 0.5), (0, 0.5))
    points = np.stack([a * along + b * POLE * across for a, b in ends], 1)
    pole = _pixels(camera, x[:, None] + points[..., 0], points[..., 1])
    hinge = _pixels(camera, x, 0 * x)
    tip = _pixels(camera, x + length * along[:, 0], length * along[:, 1])
    return cart, pole, list(map(tuple, hinge.tolist())), list(map(tuple, tip.tolist()))


@lru_cache(maxsize=16)
def _empty(camera):
    """The picture (height, width, 3) without cart and pole: background, rail and its ticks."""
    picture = np.empty((camera.height, camera.width, 3), np.float32)
    picture[:] = camera.background_colour
    row, column = np.mgrid[: camera.height, : camera.width]
    if camera.background == "gradient":
        picture *= (0.6 + 0.4 * row / camera.height)[..., None]
    elif camera.background == "checks":
        picture *= np.where((row // 8 + column // 8) % 2, 1.0, 0.75)[..., None]
    picture = np.rint(picture).astype(np.uint8)
    colour, drop = camera.rail_colour, -CART[1]
    left, right = _pixels(camera, np.array([-RAIL, RAIL]), np.array([drop, drop])).tolist()
    cv2.line(picture, left, right, colour, 1, cv2.LINE_AA, SHIFT)
    for place in np.arange(-2.0, RAIL, TICKS):
        ends = _pixels(camera, np.array([place, place]), np.array([drop, drop - 0.1])).tolist()
        cv2.line(picture, *ends, colour, 1, cv2.LINE_AA, SHIFT)
    picture.setflags(write=False)
    return picture
