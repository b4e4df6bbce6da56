"""The drawn CartPole: where things are in the picture, how finely it moves, and what the look of it changes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from envs import make_system
from envs.camera import Camera
from envs.drawing import CART, draw

SYSTEM = make_system("cartpole")
CAMERA = Camera()


def state(x=0.0, theta=0.0, v=0.0, omega=0.0):
    return torch.tensor([[x, v, theta, omega]])


def moving_part(camera=CAMERA, system=SYSTEM, **at):
    """How much each pixel (H, W) differs from the scene without a robot."""
    far = draw(camera, system, state(x=1000.0))
    return (draw(camera, system, state(**at))[0].float() - far[0].float()).abs().sum(0)


def centre(strength):
    """Column and row of the centre of mass."""
    rows, columns = torch.meshgrid(*(torch.arange(float(n)) for n in strength.shape), indexing="ij")
    total = strength.sum()
    return float((strength * columns).sum() / total), float((strength * rows).sum() / total)


def test_a_picture_has_three_colours_of_uint8():
    seen = draw(CAMERA, SYSTEM, torch.zeros(5, 4))
    assert seen.shape == (5, 3, CAMERA.height, CAMERA.width)
    assert seen.dtype == torch.uint8


def test_the_cart_stands_where_the_geometry_of_the_camera_says():
    blue = draw(CAMERA, SYSTEM, state(x=0.7))[0]
    column = round((CAMERA.width - 1) / 2 + 0.7 * CAMERA.scale)
    row = round((CAMERA.height - 1) / 2 + (CAMERA.offset_z + CART[1] / 2) * CAMERA.scale)
    assert tuple(blue[:, row, column].tolist()) == CAMERA.cart_colour


def test_the_pole_points_up_at_angle_zero_and_leans_to_larger_x_at_a_positive_angle():
    upright, leaning = (centre(moving_part(theta=theta)) for theta in (0.0, 0.3))
    assert upright[0] == pytest.approx((CAMERA.width - 1) / 2, abs=0.05)
    assert leaning[0] > upright[0] + 1


def test_the_picture_follows_the_cart_by_the_scale_within_a_fiftieth_of_a_pixel():
    places = np.linspace(-0.05, 0.05, 41)
    columns = [centre(moving_part(x=x))[0] for x in places]
    slope, middle = np.polyfit(places, columns, 1)
    assert slope == pytest.approx(CAMERA.scale, rel=0.01)
    assert np.std(columns - (slope * places + middle)) < 0.02


def test_a_millimetre_changes_the_picture_wherever_the_cart_is():
    places = torch.arange(0, 2 / CAMERA.scale, 0.001)
    states = torch.zeros(len(places), 4)
    states[:, 0] = places
    seen = draw(CAMERA, SYSTEM, states).float()
    assert ((seen[1:] - seen[:-1]).abs().sum((1, 2, 3)) > 0).all()


def test_speeds_are_not_seen_in_a_single_picture():
    assert torch.equal(draw(CAMERA, SYSTEM, state(v=1.0, omega=-2.0)), draw(CAMERA, SYSTEM, state()))


def test_the_camera_stands_still_while_the_cart_moves():
    one, other = (draw(CAMERA, SYSTEM, state(x=x))[0] for x in (-1.0, 1.0))
    rail = round((CAMERA.height - 1) / 2 + (CAMERA.offset_z + CART[1]) * CAMERA.scale)
    middle = slice(CAMERA.width // 2 - 10, CAMERA.width // 2 + 10)
    assert torch.equal(one[:, rail:, middle], other[:, rail:, middle])
    assert not torch.equal(one, other)


def test_the_mirror_image_is_the_picture_of_the_mirrored_state():
    states = torch.tensor([[0.3, 0.0, 0.1, 0.0], [-1.2, 0.5, -0.2, 0.1]])
    seen, mirrored = draw(CAMERA, SYSTEM, states).float(), draw(CAMERA, SYSTEM, SYSTEM.mirrored(states)).float()
    apart = (seen.flip(-1) - mirrored).abs()
    assert apart.max() < 60  # OpenCV rounds edges towards one side
    assert apart.mean() < 0.1
    assert (seen - mirrored).abs().mean() > 1


def test_a_longer_pole_reaches_higher():
    rows = [int(moving_part(system=replace(SYSTEM, pole_half_length=h)).sum(1).nonzero()[0]) for h in (0.4, 0.5)]
    assert rows[0] - rows[1] == pytest.approx(0.2 * CAMERA.scale, abs=1)


def test_offset_and_scale_move_the_scene():
    moved = centre(moving_part(replace(CAMERA, offset_x=0.5)))
    assert moved[0] == pytest.approx((CAMERA.width - 1) / 2 - 0.5 * CAMERA.scale, abs=0.1)
    assert moving_part(replace(CAMERA, scale=15.0)).gt(0).sum() < 0.5 * moving_part().gt(0).sum()


def test_brightness_scales_every_pixel():
    plain, dark = draw(CAMERA, SYSTEM, state()), draw(replace(CAMERA, brightness=0.5), SYSTEM, state())
    assert (dark.float() - 0.5 * plain.float()).abs().max() <= 0.5


def test_noise_has_the_spread_that_was_asked_for_and_is_drawn_from_the_generator():
    grey = replace(CAMERA, background_colour=(128.0, 128.0, 128.0), noise=5.0)
    far = state(x=1000.0)
    one, same, other = (draw(grey, SYSTEM, far, np.random.default_rng(seed)) for seed in (1, 1, 2))
    clean = draw(replace(grey, noise=0.0), SYSTEM, far).float()
    assert float((one.float() - clean).std()) == pytest.approx(5.0, rel=0.02)
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_a_blur_keeps_the_light_and_spreads_it():
    sharp, soft = (draw(replace(CAMERA, blur=blur), SYSTEM, state())[0].float() for blur in (0.0, 1.5))
    assert float(soft.mean()) == pytest.approx(float(sharp.mean()), rel=0.01)
    assert (soft.diff(dim=-1).abs().max()) < 0.7 * sharp.diff(dim=-1).abs().max()


@pytest.mark.parametrize("background", ["gradient", "checks"])
def test_backgrounds_differ_from_the_plain_one_and_lie_behind_the_robot(background):
    camera = replace(CAMERA, background=background)
    seen, plain = draw(camera, SYSTEM, state())[0], draw(CAMERA, SYSTEM, state())[0]
    assert (seen != plain).float().mean() > 0.4
    row = round((CAMERA.height - 1) / 2 + (CAMERA.offset_z + CART[1] / 2) * CAMERA.scale)
    assert torch.equal(seen[:, row, CAMERA.width // 2], plain[:, row, CAMERA.width // 2])


def test_a_state_that_is_lost_is_drawn_without_a_robot():
    lost = torch.full((1, 4), float("nan"))
    assert torch.equal(draw(CAMERA, SYSTEM, lost), draw(CAMERA, SYSTEM, state(x=1e9)))


@pytest.mark.slow
def test_five_thousand_pictures_a_second_are_drawn_on_one_thread():
    import time

    import cv2

    cv2.setNumThreads(1)
    states, camera = 0.1 * torch.randn(2000, 4), Camera(height=84, width=84, scale=17.0)
    draw(camera, SYSTEM, states)
    begin = time.perf_counter()
    draw(camera, SYSTEM, states)
    rate = 2000 / (time.perf_counter() - begin)
    print(f"{rate:.0f} pictures of 84 x 84 pixels per second")
    assert rate > 5000
