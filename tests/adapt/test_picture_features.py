"""What is seen in pictures: hues by name, wherever they are, and nothing of where the robot is."""

import colorsys

import pytest
import torch

from adapt.picture_features import HUES, hue_strengths, with_pictures
from adapt.transitions import Transitions
from envs.camera import Camera
from envs.cartpole import CartPole
from envs.drawing import draw
from envs.errors import InputError

RED, BLUE = (220.0, 40.0, 40.0), (40.0, 60.0, 220.0)
PAIRS = {"red or blue": (RED, BLUE), "yellow or cyan": ((220.0, 220.0, 30.0), (30.0, 220.0, 220.0))}


def patch(colour, background=(100, 100, 100), row=5, column=7):
    """A picture (1, 3, 20, 30) with a patch of 2 x 2 pixels."""
    picture = torch.tensor(background, dtype=torch.uint8)[:, None, None].repeat(1, 20, 30)
    picture[:, row : row + 2, column : column + 2] = torch.tensor(colour, dtype=torch.uint8)[:, None, None]
    return picture.unsqueeze(0)


def states(n, seed=0):
    """States (n, 4) in which the whole robot is seen."""
    uniform = 2 * torch.rand(n, 4, generator=torch.Generator().manual_seed(seed)) - 1
    return uniform * torch.tensor([1.5, 1.0, 0.4, 2.0])


def seen(tip, count=300, seed=0, **camera):
    return hue_strengths(draw(Camera(tip_colour=tip, **camera), CartPole(), states(count, seed)))


def transitions(n):
    names = (CartPole.State._fields, CartPole.Action._fields)
    rows = torch.zeros(n, dtype=torch.int64)
    return Transitions(torch.zeros(n, 4), torch.zeros(n, 1), torch.zeros(n, 4), rows, 0.05, "cartpole", *names)


def test_a_colour_is_a_share_of_a_primary_and_a_share_of_a_secondary():
    picture = patch((200, 110, 30))
    expected = {"red": 90.0, "yellow": 80.0}
    mean = picture.double().mean()
    found = dict(zip(HUES, hue_strengths(picture)[0].tolist(), strict=True))
    assert found == pytest.approx({hue: expected.get(hue, 0.0) / float(mean) for hue in HUES}, abs=1e-6)


@pytest.mark.parametrize("place", range(6))
def test_each_hue_of_the_colour_circle_is_called_by_its_name(place):
    colour = [round(255 * part) for part in colorsys.hsv_to_rgb(place / 6, 1, 1)]
    found = hue_strengths(patch(colour))[0]
    assert found.argmax() == place and (found > 0).sum() == 1


def test_a_grey_thing_is_no_hue():
    assert not hue_strengths(patch((30, 30, 30), (235, 235, 235))).any()


def test_the_place_of_a_thing_does_not_matter():
    picture = draw(Camera(tip_colour=RED), CartPole(), states(1))
    for moved in (picture.roll((3, -20), (2, 3)), picture.flip(-1), picture.flip(-2), picture.mT):
        torch.testing.assert_close(hue_strengths(moved), hue_strengths(picture))


def test_the_exposure_of_the_camera_does_not_matter():
    picture = patch((200, 110, 30))
    torch.testing.assert_close(hue_strengths(picture // 2), hue_strengths(picture))


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize(
    "camera", [{}, {"background": "checks"}, {"background": "gradient"}, {"brightness": 0.6}], ids=str
)
def test_the_marker_changes_some_hue_far_more_than_cart_and_pole_do_by_moving(pair, camera):
    one, other = (seen(colour, **camera) for colour in PAIRS[pair])
    difference = (one.mean(0) - other.mean(0)).abs()
    spread = torch.maximum(one.std(0), other.std(0))
    assert (spread < 0.03 * difference).sum() >= 2


def test_no_hue_knows_where_the_robot_is():
    """A linear fit of the state to what is seen explains next to nothing."""
    placed, strengths = states(600), seen(RED, 600)
    inputs = torch.cat((torch.ones(600, 1), strengths), -1).double()
    wanted = placed[:, :1].double()
    left = wanted - inputs @ torch.linalg.lstsq(inputs, wanted, driver="gelsd").solution
    assert left.var() > 0.95 * wanted.var()


def test_noise_of_the_camera_leaves_the_markers_apart():
    one, other = (seen(colour, noise=6.0)[:, HUES.index("red")] for colour in (RED, BLUE))
    assert one.min() > other.max()


def test_what_is_seen_in_a_picture_does_not_depend_on_those_beside_it():
    pictures = draw(Camera(tip_colour=BLUE), CartPole(), states(600))
    rows = [0, 255, 256, 599]
    torch.testing.assert_close(hue_strengths(pictures)[rows], hue_strengths(pictures[rows]))


def test_a_black_picture_shows_nothing_and_no_pictures_give_no_rows():
    assert not hue_strengths(torch.zeros(2, 3, 8, 8, dtype=torch.uint8)).any()
    assert hue_strengths(torch.zeros(0, 3, 8, 8, dtype=torch.uint8)).shape == (0, 6)


@pytest.mark.parametrize(
    "pictures",
    [
        torch.zeros(2, 12, 8, 8, dtype=torch.uint8),
        torch.zeros(3, 8, 8, dtype=torch.uint8),
        torch.zeros(2, 8, 8, 3, dtype=torch.uint8),
        torch.zeros(2, 3, 1, 2, dtype=torch.uint8),
        torch.zeros(2, 3, 8, 8),
    ],
    ids=["a stack", "one picture", "channels last", "two pixels", "float32"],
)
def test_pictures_of_another_shape_or_type_are_refused(pictures):
    with pytest.raises(InputError, match=r"expected \(N, 3, height, width\) of uint8"):
        hue_strengths(pictures)


def test_each_transition_gets_what_is_seen_in_its_own_picture():
    colours = [patch(RED), patch(BLUE), patch(RED)]
    given = with_pictures(transitions(3), torch.cat(colours))
    assert given.context_names == HUES
    torch.testing.assert_close(given.context, torch.cat([hue_strengths(picture) for picture in colours]))


def test_pictures_that_are_more_or_fewer_than_the_transitions_are_refused():
    with pytest.raises(InputError, match="pictures: 1 for 3 transitions"):
        with_pictures(transitions(3), patch(RED))
