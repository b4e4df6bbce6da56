"""The camera's settings: what is refused, and how a target changes them."""

import re

import pytest

from envs import InputError, make_dynamics, make_env, make_system, make_task, parse_target
from envs.camera import Camera


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"height": 4}, "camera: height is 4, expected at least 8"),
        ({"frames": 0}, "camera: frames is 0, expected at least 1"),
        ({"scale": 0.0}, "camera: scale is 0, expected more than 0"),
        ({"brightness": float("inf")}, "camera: brightness is inf, expected more than 0"),
        ({"width": 100000}, "camera: width is 100000, expected at most 2000"),
        ({"scale": 1e9}, "camera: scale is 1e+09, expected at most 2000"),
        ({"offset_x": float("nan")}, "camera: offset_x is nan, expected a number of metres"),
        ({"noise": -1.0}, "camera: noise is -1, expected at least 0"),
        ({"cart_colour": (0, 0)}, "camera: cart_colour is (0, 0), expected red,green,blue in 0 ... 255"),
        ({"cart_colour": (0, 0, 300)}, "camera: cart_colour is (0, 0, 300), expected red,green,blue in 0 ... 255"),
        ({"background": "sea"}, "camera: background is 'sea', expected one of plain, gradient, checks"),
    ],
)
def test_a_camera_that_makes_no_sense_is_refused_in_one_line(settings, line):
    with pytest.raises(InputError, match=f"^{re.escape(line)}$"):
        Camera(**settings)


def test_a_target_changes_the_picture_and_the_robot():
    system = make_system("cartpole")
    domain = parse_target("pole_mass=x2 brightness=0.7 scale=x1.1 cart_colour=200,40,40 background=checks", system)
    task = domain.seen(make_task("cartpole", camera=Camera()))
    assert task.camera.brightness == 0.7
    assert task.camera.scale == pytest.approx(1.1 * Camera().scale)
    assert task.camera.cart_colour == (200.0, 40.0, 40.0)
    assert task.camera.background == "checks"
    assert make_dynamics(system, domain).system.pole_mass == pytest.approx(0.2)


def test_noise_of_the_picture_has_a_name_of_its_own_beside_that_of_the_measured_states():
    domain = parse_target("noise=0.5 camera_noise=4", make_system("cartpole"))
    assert domain.seen(make_task("cartpole", camera=Camera())).camera.noise == 4.0
    assert domain.noise == 0.5
    with pytest.raises(InputError, match="--target camera_noise=4: changes the picture, but this policy"):
        make_env("cartpole", "camera_noise=4")


def test_a_changed_picture_means_nothing_to_a_policy_that_sees_the_state():
    with pytest.raises(
        InputError, match=r"--target brightness=0\.7: changes the picture, but this policy sees the state"
    ):
        make_env("cartpole", "brightness=0.7")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("brightness=dark", "camera: brightness is 'dark', expected a number"),
        ("cart_colour=1,2", "camera: cart_colour is '1,2', expected red,green,blue"),
        ("blur=1,2,3", "camera: blur is '1,2,3', expected one number"),
        ("brightness=-1", "camera: brightness is -1, expected more than 0"),
        ("camera_noise=-1", "camera: noise is -1, expected at least 0"),
        ("height=64", "cartpole has no 'height'"),
    ],
)
def test_a_target_that_changes_the_picture_to_nonsense_is_refused(text, line):
    with pytest.raises(InputError, match=f"--target {re.escape(text)}.*{re.escape(line)}"):
        parse_target(text, make_system("cartpole"))


def test_a_robot_that_is_not_drawn_has_no_picture_to_change():
    with pytest.raises(InputError, match="quadrotor has no 'brightness'"):
        parse_target("brightness=0.7", make_system("quadrotor"))
