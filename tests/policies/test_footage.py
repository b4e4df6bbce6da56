"""Footage: every stack is what the camera showed, and flights are told apart."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from envs import make_dynamics, make_task
from envs.camera import Camera
from envs.pixels import tracking_env
from policies.footage import Footage, film

CAMERA = Camera(height=24, width=48, scale=9.0, noise=3.0)  # with noise, no two pictures are the same
TASK = make_task("cartpole", camera=CAMERA)


def flown(steps=60, size=3, exploration=0.3, seed=0):
    """Footage of random flights that fall, and what the environment showed at each of its steps."""
    env = tracking_env(make_dynamics("cartpole"), TASK, TASK.episodes(20, "train", 0), (size,), threshold=0.1)
    footage, shown, generator = Footage.empty(TASK), [], torch.Generator().manual_seed(seed)
    now = env.reset()
    for _ in range(steps):
        shown.append(now["pixels"].clone())
        now = film(footage, env, None, now, 1, exploration, generator)
    return footage, torch.cat(shown)


def test_its_stacks_are_what_the_camera_showed_over_the_ends_of_flights_too():
    footage, shown = flown()
    assert len(footage) == 180
    assert int(footage.flight.max()) > 5  # what makes this test one
    assert torch.equal(footage.pixels(torch.arange(180)), shown)


def test_each_picture_is_kept_once():
    footage, _ = flown(10)
    assert footage.frames.shape == (30, 3, 24, 48)


def test_within_a_flight_each_state_is_where_the_step_before_led():
    footage, _ = flown()
    for flight in footage.flight.unique():
        rows = (footage.flight == flight).nonzero().squeeze(-1)
        assert torch.equal(footage.state[rows[1:]], footage.next_state[rows[:-1]])
    dynamics = make_dynamics("cartpole")
    torch.testing.assert_close(dynamics(footage.state, footage.action), footage.next_state)


def test_the_first_steps_are_whole_footage():
    footage, shown = flown()
    first = footage.first(100)
    assert len(first) == 100
    assert torch.equal(first.pixels(torch.arange(100)), shown[:100])


def test_a_policy_is_followed_but_for_the_noise():
    env = tracking_env(make_dynamics("cartpole"), TASK, TASK.episodes(20, "train", 0), (40,))
    policy = TensorDictModule(lambda pixels: 0.5 + 0 * pixels[..., 0, 0, :1].float(), ["pixels"], ["action"])
    footage = Footage.empty(TASK)
    film(footage, env, policy, env.reset(), 25, 0.1, torch.Generator().manual_seed(0))
    assert abs(float(footage.action.mean()) - 0.5) < 0.02
    assert abs(float(footage.action.std()) - 0.1) < 0.02


def test_joined_footage_shows_what_both_parts_show_and_keeps_their_flights_apart():
    (one, first), (two, second) = flown(20, seed=1), flown(15, seed=2)
    both = one.joined(two)
    assert torch.equal(both.pixels(torch.arange(len(both))), torch.cat((first, second)))
    assert not set(both.flight[:60].tolist()) & set(both.flight[60:].tolist())
    assert torch.equal(Footage.empty(TASK).joined(one).stacks, one.stacks)


def test_where_sensors_err_the_states_are_what_they_say_and_the_pictures_show_the_robot():
    clear, pair = make_task("cartpole", camera=Camera(height=24, width=48, scale=9.0)), []
    for target in ("", "noise=10"):
        env = tracking_env(make_dynamics("cartpole", target), clear, clear.episodes(20, "train", 0), (3,))
        start = env.reset(TensorDict({"episode": torch.arange(3)[:, None]}, 3), set_state=True)
        pair.append(Footage.empty(clear))
        film(pair[-1], env, None, start, 8, 0.1, torch.Generator().manual_seed(0))
    exact, noisy = pair
    assert torch.equal(noisy.frames, exact.frames)
    error = noisy.state - exact.state
    assert 0.1 < float(error[:, 1].std()) < 0.4
    for flight in noisy.flight.unique():
        rows = (noisy.flight == flight).nonzero().squeeze(-1)
        assert torch.equal(noisy.state[rows[1:]], noisy.next_state[rows[:-1]])
