"""Pictures as observations: the stack, its beginning, partial resets, and going on from a TensorDict."""

from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from envs import make_dynamics, make_task
from envs.camera import Camera
from envs.drawing import draw
from envs.pixels import reseed, tracking_env

CAMERA = Camera(height=24, width=48, scale=9.0)
TASK = make_task("cartpole", camera=CAMERA)


def make(size=3, task=TASK, target="", **options):
    return tracking_env(make_dynamics("cartpole", target), task, task.episodes(20, "train", 0), (size,), **options)


def pictures(env, states):
    return draw(CAMERA, env.dynamics.system, states)


def test_it_is_a_torchrl_environment_with_a_stack_of_uint8_pictures():
    env = make()
    assert isinstance(env, TransformedEnv)
    check_env_specs(env)
    assert env.rollout(3)["pixels"].shape == (3, 3, 12, 24, 48)
    assert env.observation_spec["pixels"].dtype == torch.uint8


def test_a_task_without_a_camera_has_no_pictures():
    assert "pixels" not in make(task=make_task("cartpole")).reset().keys()  # noqa: SIM118


def test_a_flight_begins_with_its_first_picture_in_every_place():
    env = make()
    begun = env.reset()
    first = pictures(env, begun["state"])
    assert all(torch.equal(begun["pixels"][:, 3 * k : 3 * k + 3], first) for k in range(4))


def test_the_stack_holds_the_last_four_pictures_the_newest_first():
    env = make()
    flown = env.rollout(6)
    for k in range(4):
        expected = pictures(env, flown["state"][:, 5 - k])
        assert torch.equal(flown["pixels"][:, 5, 3 * k : 3 * k + 3], expected)


def test_only_the_stack_of_a_flight_that_begins_again_is_filled_anew():
    env = make(threshold=0.4)
    now = env.reset()
    for _ in range(3):
        now["action"] = torch.full((3, 1), 0.1)
        now = step_mdp(env.step(now))
    before = now["pixels"].clone()
    now["truncated"][1] = now["done"][1] = True
    now = env.maybe_reset(now)
    assert now["step"].squeeze(-1).tolist() == [3, 0, 3]
    assert torch.equal(now["pixels"][[0, 2]], before[[0, 2]])
    first = pictures(env, now["state"][1:2])
    assert torch.equal(now["pixels"][1:2], first.repeat(1, 4, 1, 1))


def test_it_goes_on_from_a_tensordict_with_the_stack_that_it_holds():
    env = make()
    flown = env.rollout(5)
    place = flown[:, 4].select("state", "episode", "step", "pixels")
    onward = env.reset(place.clone(), set_state=True)
    assert torch.equal(onward["pixels"], place["pixels"])
    fresh = env.reset(place.exclude("pixels"), set_state=True)
    assert not torch.equal(fresh["pixels"], place["pixels"])


def test_the_true_robot_is_drawn_not_its_model():
    short, long = make(), make(target="pole_half_length=x1.5")
    state = torch.zeros(3, 4)
    place = {
        "state": state,
        "episode": torch.zeros(3, 1, dtype=torch.long),
        "step": torch.zeros(3, 1, dtype=torch.long),
    }
    seen = [env._step(env.reset().update({**place, "action": torch.zeros(3, 1)}))["pixels"] for env in (short, long)]
    assert not torch.equal(*seen)


def test_noise_is_another_in_every_picture_and_the_same_with_the_same_seed():
    noisy = replace(TASK, camera=replace(CAMERA, noise=4.0))
    env = make(task=noisy)
    still, flights = TensorDictModule(lambda state: 0 * state[..., :1], ["state"], ["action"]), []
    for seed in (1, 1, 2):
        reseed(env, seed)
        flights.append(env.rollout(2, still)["pixels"])
    assert torch.equal(flights[0], flights[1])
    assert not torch.equal(flights[0], flights[2])
    assert not torch.equal(flights[0][:, 1, :3], flights[0][:, 0, :3])


def test_gradients_flow_through_the_states_of_a_filmed_flight():
    env = make()
    now = env.reset()
    action = torch.zeros(3, 1, requires_grad=True)
    now["action"] = action
    env.step(now)["next", "state"].square().sum().backward()
    assert action.grad.abs().sum() > 0


@pytest.mark.parametrize("frames", [1, 2, 6])
def test_any_number_of_pictures_is_stacked(frames):
    env = make(task=replace(TASK, camera=replace(CAMERA, frames=frames)))
    assert env.rollout(3)["pixels"].shape[-3] == 3 * frames


def test_a_camera_sees_the_robot_not_what_sensors_say_of_it():
    env = make(target="noise=30")
    check_env_specs(env)
    flown = env.rollout(4)
    for k in range(4):
        assert torch.equal(flown["pixels"][:, 3, 3 * k : 3 * k + 3], pictures(env, flown["state"][:, 3 - k]))
    assert (flown["measured"] - flown["state"])[..., 1].std() > 0.3


def test_it_goes_on_with_what_was_measured():
    env = make(target="noise=1")
    flown = env.rollout(5)
    place = flown[:, 4].select("state", "episode", "step", "pixels", "measured")
    onward = env.reset(place.clone(), set_state=True)
    for key in ("measured", "observation", "pixels"):
        assert torch.equal(onward[key], flown[key][:, 4]), key
    now = step_mdp(env.step(onward.set("action", torch.zeros(3, 1))))
    before = now.clone()
    now["truncated"][1] = now["done"][1] = True
    now = env.maybe_reset(now)
    assert torch.equal(now["measured"][[0, 2]], before["measured"][[0, 2]])
    assert not torch.equal(now["measured"][1], before["measured"][1])
