"""Planning on pictures: what the image model has learned, what its cost sees and what not, and where the plan leads."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from envs import make_dynamics, make_task
from envs.camera import Camera
from envs.drawing import draw
from envs.errors import InputError
from policies import pixel_mpc
from policies.cem import PlannerConfig
from policies.evaluate import evaluate
from policies.pixel_mpc import Config

SMALL = Config(
    samples=600, latent=12, updates=250, unroll=3, shifts=(0,), planner=PlannerConfig(candidates=40, elites=5)
)


CAMERA = Camera(height=24, width=72, scale=14.5)


@pytest.fixture(scope="module")
def task():
    return make_task("cartpole", camera=CAMERA)


@pytest.fixture(scope="module")
def dynamics(task):
    return make_dynamics(task.system)


@pytest.fixture(scope="module")
def model(task, dynamics):
    return pixel_mpc.fit(dynamics, task, SMALL, seed=0)


def stack(task, *states):
    """What the camera shows (1, 12, H, W) of a robot that was in these states, the newest first."""
    return draw(task.camera, task.system, torch.tensor(states)).flatten(0, 1).unsqueeze(0)


def still(task, x=0.0, angle=0.0):
    return stack(task, *(4 * [[x, 0.0, angle, 0.0]]))


def seen(pixels, **more):
    return TensorDict({"pixels": pixels, **more}, batch_size=(len(pixels),))


def test_it_predicts_held_out_pictures_better_than_nothing_changes(task, dynamics, model):
    """Over five steps of its own, in flights that it hasn't seen. Random flights change little in one step."""
    generator = torch.Generator().manual_seed(1)
    footage = pixel_mpc.filmed(dynamics, task, replace(SMALL, samples=200), 1, generator, "validation")
    _, action, following = pixel_mpc.sequences(footage, replace(SMALL, mirror=False))
    windows = pixel_mpc.windows(following, 5)
    assert len(windows) > 50
    now = before = model.seen(footage.pixels(windows[:, 0]))
    for row in windows.unbind(1):
        now, true = model(now, action[row]), model.encode(footage.frames[following[row]])
        error = (now[:, 0] - true).square().sum(-1).mean()
        assert error < 0.35 * (before[:, 0] - true).square().sum(-1).mean()


def test_the_predicted_cart_goes_where_it_is_pushed(task, dynamics, model):
    """Three steps of ±0.2 part the carts; the predicted pictures are nearest to those of carts as far apart."""
    action = torch.tensor([[0.2], [-0.2]])
    latents, state = model.seen(still(task).expand(2, -1, -1, -1)), torch.zeros(2, 4)
    for _ in range(3):
        latents, state = model(latents, action), dynamics(state, action)
    scales = torch.tensor([-1.0, 0.0, 0.5, 1.0, 1.5])
    for end, predicted in zip(state, latents[:, 0], strict=True):
        candidates = model.encode(draw(task.camera, task.system, scales[:, None] * end))
        assert (candidates - predicted).square().sum(-1).argmin() == 3


def test_the_model_learns_from_pictures_and_actions_alone(task, dynamics, model, monkeypatch):
    """Footage whose states are wiped gives the same model, to the last bit; so does the seed, in any global state."""
    filmed = pixel_mpc.filmed

    def wiped(*args):
        footage = filmed(*args)
        footage.state.fill_(torch.nan)
        footage.next_state.fill_(torch.nan)
        return footage

    monkeypatch.setattr(pixel_mpc, "filmed", wiped)
    torch.manual_seed(123)
    before = torch.get_rng_state()
    again = pixel_mpc.fit(dynamics, task, SMALL, seed=0)
    assert torch.equal(torch.get_rng_state(), before)
    for name, value in model.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0)


def test_no_more_is_filmed_than_the_budget_and_who_falls_begins_anew(task, dynamics):
    for samples in (7, 205):
        config = replace(SMALL, samples=samples)
        footage = pixel_mpc.filmed(dynamics, task, config, 0, torch.Generator().manual_seed(0))
        assert samples - config.flights < len(footage) <= samples
        assert (footage.state[:, 2].abs() <= task.angle_limit).all()
    assert footage.flight.unique().numel() > 10


def test_steps_that_follow_one_another_share_their_pictures(task, dynamics):
    """The newest picture of a step is the second newest of the next, in every view; no window crosses two flights."""
    config = replace(SMALL, samples=300, shifts=(0, 5))
    footage = pixel_mpc.filmed(dynamics, task, config, 0, torch.Generator().manual_seed(0))
    stacks, action, following = pixel_mpc.sequences(footage, config)
    assert len(stacks) == len(action) == len(following) == 4 * len(footage)
    known = (following >= 0).nonzero()[:, 0]
    assert torch.equal(stacks[following[known], 1], known)
    assert len(known) == 4 * (len(footage) - footage.flight.unique().numel())
    rows = pixel_mpc.windows(following, 3)
    assert torch.equal(following[rows[:, :-1]], rows[:, 1:])
    assert (following[rows] >= 0).all()
    view, flight = rows // len(footage), footage.flight[rows % len(footage)]
    assert (view == view[:, :1]).all()
    assert (flight == flight[:, :1]).all()
    torch.testing.assert_close(action.view(4, -1)[1], -footage.action[:, 0])


def test_a_view_is_the_picture_of_a_robot_elsewhere(task):
    """Shifted by whole pixels cart and pole are those of a robot that stands there; mirrored, of the mirrored robot."""
    state = torch.tensor([[0.1, 0.0, 0.2, 0.0]])
    shift = 3
    bare = replace(task.camera, rail_colour=task.camera.background_colour)
    there = state + torch.tensor([shift / bare.scale, 0.0, 0.0, 0.0])
    pictures = draw(bare, task.system, torch.cat((state, there, -there))).int()
    for view, expected in (((shift, False), pictures[1]), ((shift, True), pictures[2])):
        found = pixel_mpc.viewed(pictures[0], *view)
        assert (found - expected).abs().float().mean() < 0.3
        assert (pictures[0] - expected).abs().float().mean() > 3


def test_the_cost_is_about_the_nearest_goal_wherever_it_is(task, model):
    """Upright at rest costs next to nothing at any place that was learned from; a leaning pole costs."""
    at_rest = [model.cost(model.seen(still(task, x=x))).item() for x in (-0.1, 0.0, 0.1)]
    leaning = model.cost(model.seen(still(task, angle=0.1))).item()
    assert max(at_rest) < 0.01 * leaning


def test_the_distance_of_pictures_flattens_where_poles_no_longer_overlap(task, model):
    """Squared, twice the angle should cost four times as much, as in the cost of the task."""
    cost = [model.cost(model.seen(still(task, angle=angle))).item() for angle in (0.2, 0.4)]
    assert cost[0] < cost[1] < 2.5 * cost[0]


def test_only_the_weight_on_rest_makes_the_cost_see_a_velocity(task, model):
    """An upright pole that moves costs no more than one at rest to the distance alone."""
    moving = stack(task, *([-0.03 * k, 0.0, 0.0, 0.0] for k in range(4)))
    latents, at_rest = model.seen(moving), model.seen(still(task))
    with_rest = model.cost(latents)
    weight, model.rest = model.rest, 0.0
    without, least = model.cost(latents), model.cost(at_rest)
    model.rest = weight
    torch.testing.assert_close(without, least, rtol=0, atol=1e-5)
    moved = (latents[:, 0] - latents[:, 1]).square().sum(-1)
    torch.testing.assert_close(with_rest - without, weight * moved)
    assert moved > 1e-3


def test_the_action_depends_on_the_pictures_and_the_seed_alone(task, model):
    """With another hidden state, or with none, the same pictures give the same action; without drawing globally."""
    pixels = torch.cat((still(task, angle=0.1), still(task, angle=-0.1)))
    torch.manual_seed(5)
    before = torch.get_rng_state()
    first = pixel_mpc.actor(model, task, SMALL, seed=3)(seen(pixels))["action"]
    assert torch.equal(torch.get_rng_state(), before)
    assert first.shape == (2, 1)
    for state in (torch.zeros(2, 4), torch.full((2, 4), torch.nan)):
        more = {"state": state, "observation": state, "reference": state}
        again = pixel_mpc.actor(model, task, SMALL, seed=3)(seen(pixels, **more))
        assert torch.equal(again["action"], first)
        torch.testing.assert_close(again["state"], state, equal_nan=True)
    other = pixel_mpc.actor(model, task, SMALL, seed=4)(seen(pixels))["action"]
    assert not torch.equal(other, first)


def test_a_leaning_pole_is_driven_under(task, model):
    """The first action pushes the cart towards the side that the pole leans to."""
    pixels = torch.cat((still(task, angle=0.12), still(task, angle=-0.12)))
    action = pixel_mpc.actor(model, task, SMALL)(seen(pixels))["action"]
    assert action[0] > 0.05
    assert action[1] < -0.05


def test_rows_that_are_done_are_left_out_and_plans_are_counted(task, model):
    planner = pixel_mpc.actor(model, task, SMALL)
    done = torch.tensor([[False], [True], [False]])
    action = planner(seen(still(task, angle=0.1).expand(3, -1, -1, -1), done=done))["action"]
    assert planner.calls == 2
    assert planner.failures == 0
    assert action[1] == 0
    assert (action[[0, 2]] != 0).all()
    assert planner(TensorDict({"pixels": still(task)[0]}, ()))["action"].shape == (1,)
    assert planner.calls == 3


def test_a_plan_without_a_finite_cost_is_a_failure(task, model):
    planner = pixel_mpc.actor(model, task, SMALL)
    goals, model.goals = model.goals, torch.full_like(model.goals, torch.nan)
    action = planner(seen(still(task)))["action"]
    model.goals = goals
    assert planner.failures == 1
    assert action == 0


class Slider:
    """A cart that an action moves by up to 0.08 m at once, under a pole that stays upright."""

    def __init__(self, system):
        self.system = system

    def __call__(self, state, action):
        return state + 0.08 * action * state.new_tensor([1.0, 0.0, 0.0, 0.0])


def test_it_steers_to_goal_pictures_where_pictures_are_enough(task):
    """Where nothing has a velocity, a picture says all: carts from anywhere end within a pixel of either goal."""
    task = replace(task, steps=12)
    planner = PlannerConfig(min_std=0.01)
    config = replace(SMALL, flights=50, exploration=0.7, rest=0.0, history=1, shifts=(-3, 0, 3), planner=planner)
    slider = Slider(task.system)
    model = pixel_mpc.fit(slider, task, config, seed=0)
    for place in (-0.25, 0.25):
        model.goals = model.encode(draw(task.camera, task.system, torch.tensor([[place, 0.0, 0.0, 0.0]])))
        flown = evaluate(pixel_mpc.actor(model, task, config), slider, task, task.episodes(4, "validation", 0))
        assert (flown.states[:, 0, 0] - place).abs().min() > 1.5 / task.camera.scale
        assert (flown.states[:, -1, 0] - place).abs().max() < 1 / task.camera.scale


def test_the_nearest_transition_of_a_recorded_one_is_itself(task, dynamics):
    config = replace(SMALL, model="nearest", mirror=False)
    model = pixel_mpc.fit(dynamics, task, config, seed=0)
    footage = pixel_mpc.filmed(dynamics, task, config, 0, torch.Generator().manual_seed(0))
    _, action, following = pixel_mpc.sequences(footage, config)
    known = (following >= 0).nonzero()[:, 0]
    predicted = model(model.seen(footage.pixels(known)), action[known])[:, 0]
    true = model.encode(footage.frames[following[known]])
    torch.testing.assert_close(predicted, true, rtol=0, atol=1e-4)
    assert pixel_mpc.actor(model, task, config)(seen(still(task)))["action"].abs() <= 1


@pytest.mark.parametrize("frames", [1, 2])
def test_a_camera_with_few_frames_is_enough_to_learn_and_plan(dynamics, frames):
    task = make_task("cartpole", camera=replace(CAMERA, frames=frames))
    model = pixel_mpc.fit(dynamics, task, replace(SMALL, samples=100, updates=3, latent=4), seed=0)
    pixels = draw(task.camera, task.system, torch.zeros(frames, 4)).flatten(0, 1).unsqueeze(0)
    assert pixel_mpc.actor(model, task, SMALL)(seen(pixels))["action"].isfinite().all()


def test_bad_input_is_named(task, dynamics, model):
    with pytest.raises(InputError, match=r"pixels: \(12, 24, 70\) of uint8, expected \(12, 24, 72\)"):
        model.seen(torch.zeros(1, 12, 24, 70, dtype=torch.uint8))
    with pytest.raises(InputError, match="of float32, expected"):
        model.seen(torch.zeros(1, 12, 24, 72))
    with pytest.raises(InputError, match="no camera"):
        pixel_mpc.fit(dynamics, make_task("cartpole"), SMALL, seed=0)
    with pytest.raises(InputError, match="--samples 20: none in a row"):
        pixel_mpc.fit(dynamics, task, replace(SMALL, samples=20), seed=0)
    wrong = ("samples", 0), ("latent", 0), ("rest", -1.0), ("reach", 0.0), ("model", "linear"), ("shifts", ())
    for name, value in wrong:
        with pytest.raises(InputError, match=name):
            Config(**{name: value})
