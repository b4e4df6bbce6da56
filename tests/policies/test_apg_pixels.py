"""APG from pictures: the budget, the variations of what was filmed, exact resuming, and that it learns."""

from dataclasses import replace

import pytest
import torch

from envs import InputError, make_dynamics, make_task
from envs.camera import Camera
from envs.drawing import draw
from policies import apg_pixels, evaluate
from policies.apg_pixels import Config

TASK = make_task("cartpole", camera=Camera(height=24, width=48, scale=9.0))
DYNAMICS = make_dynamics("cartpole")
TINY = Config(samples=60, rounds=3, flights=4, updates=9, batch=8, episodes=20)


def begun(config=TINY, seed=0, task=TASK, **options):
    banks = [task.episodes(config.episodes, "train", seed)]
    return apg_pixels.begin(DYNAMICS, task, banks, config, seed, **options), banks


def trained(config=TINY, seed=0, until=None, **options):
    run, banks = begun(config, seed, **options)
    for row in apg_pixels.train(run, DYNAMICS, TASK, banks, config):
        if row["update"] == until:
            break
    return run


def weights(run):
    return torch.cat([part.detach().flatten() for part in run.network.parameters()])


@pytest.mark.parametrize("samples", [1, 7, 60, 101])
def test_no_more_is_filmed_than_the_budget_and_nearly_all_of_it(samples):
    run = trained(replace(TINY, samples=samples))
    assert samples - TINY.flights < run.samples <= samples


def test_it_is_filmed_in_rounds_spread_over_the_updates():
    run, banks = begun()
    counts = [row["samples"] for row in apg_pixels.train(run, DYNAMICS, TASK, banks, TINY)]
    assert counts == [20, 20, 20, 40, 40, 40, 60, 60, 60]


def test_the_first_round_is_flown_at_random_and_the_others_by_the_policy_of_the_time():
    run = trained(replace(TINY, samples=1500, exploration=0.0, first_exploration=0.3))
    first, later = run.footage.action[:500], run.footage.action[500:]
    assert abs(float(first.std()) - 0.3) < 0.05
    rows = torch.arange(1000, 1500)
    with torch.no_grad():
        planned = run.network(run.footage.pixels(rows))[:, 0]
    assert (planned - run.footage.action[rows]).abs().mean() < 0.5 * later.std() + 0.05


def test_a_varied_picture_is_that_of_the_varied_state():
    camera = replace(TASK.camera, width=96, rail_colour=TASK.camera.background_colour)  # nothing but the robot
    task = replace(TASK, camera=camera)
    run, _ = begun(replace(TINY, samples=80), task=task)
    config = replace(TINY, shift=0, batch=64)
    state, pixels = apg_pixels.varied(run.footage, task.system, config, torch.Generator().manual_seed(0))
    apart = (draw(camera, task.system, state).float() - pixels[:, :3].float()).abs()
    assert apart.mean() < 0.2
    assert (state[:, 2] < 0).any()
    assert (state[:, 2] > 0).any()
    plain = apg_pixels.varied(run.footage, task.system, replace(config, mirror=False), torch.Generator().manual_seed(0))
    assert (draw(camera, task.system, -plain[0]).float() - plain[1][:, :3].float()).abs().mean() > 1


def test_a_shift_moves_all_pictures_of_a_stack_alike():
    run, _ = begun()
    config = replace(TINY, shift=5, mirror=False, batch=16)
    moved = apg_pixels.varied(run.footage, TASK.system, config, torch.Generator().manual_seed(3))
    still = apg_pixels.varied(run.footage, TASK.system, replace(config, shift=0), torch.Generator().manual_seed(3))
    assert torch.equal(moved[0], still[0])
    for one, other in zip(moved[1], still[1], strict=True):
        assert any(torch.equal(one, other.roll(by, -1)) for by in range(-5, 6))
    assert not torch.equal(moved[1], still[1])


def test_the_same_seed_trains_the_same_policy_and_another_seed_another():
    one, same, other = (weights(trained(seed=seed)) for seed in (0, 0, 1))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("stop", [1, 4])
def test_a_resumed_run_ends_bit_for_bit_where_an_uninterrupted_one_does(stop, tmp_path):
    whole, broken = trained(), trained(until=stop)
    torch.save(broken.state_dict(), tmp_path / "training.pt")
    run, banks = begun()
    run.load_state_dict(torch.load(tmp_path / "training.pt", weights_only=True), banks, TINY, TASK)
    assert run.update == stop
    list(apg_pixels.train(run, DYNAMICS, TASK, banks, TINY))
    assert torch.equal(weights(run), weights(whole))
    assert torch.equal(run.footage.frames, whole.footage.frames)


def test_a_run_whose_sensors_err_is_resumed_with_what_was_measured_last():
    dynamics, banks = make_dynamics("cartpole", "noise=1"), [TASK.episodes(20, "train", 0)]
    run, resumed = (apg_pixels.begin(dynamics, TASK, banks, TINY, 0) for _ in range(2))
    resumed.load_state_dict(run.state_dict(), banks, TINY, TASK)
    assert torch.equal(resumed.place["measured"], run.place["measured"])
    for one in (run, resumed):
        list(apg_pixels.train(one, dynamics, TASK, banks, TINY))
    assert torch.equal(resumed.footage.state, run.footage.state)
    assert torch.equal(weights(resumed), weights(run))


def test_fine_tuning_on_given_footage_films_nothing_and_leaves_the_old_network_alone():
    first = trained()
    before, filmed = weights(first).clone(), first.samples
    tuned = trained(replace(TINY, rounds=1, samples=500), network=first.network, footage=first.footage)
    assert tuned.samples == filmed
    assert torch.equal(weights(first), before)
    assert not torch.equal(weights(tuned), before)


def test_training_that_goes_on_is_filmed_with_the_given_policy():
    first = trained(replace(TINY, samples=200))
    config = replace(TINY, samples=400, rounds=1, exploration=0.0)
    run, _ = begun(config, network=first.network)
    rows = torch.arange(run.samples)
    with torch.no_grad():
        planned = first.network(run.footage.pixels(rows))[:, 0]
    assert run.samples == 400
    torch.testing.assert_close(run.footage.action, planned, atol=1e-5, rtol=1e-4)


def test_an_update_without_a_finite_gradient_is_left_out_and_counted():
    run, banks = begun()
    before = weights(run).clone()

    class Lost:
        system = DYNAMICS.system

        def __call__(self, state, action):
            return state * float("nan") * action

    list(apg_pixels.train(run, Lost(), TASK, banks, TINY))
    assert run.skipped == TINY.updates
    assert torch.equal(weights(run), before)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"samples": 0}, "--samples 0: expected at least 1"),
        ({"rounds": 0}, r"apg_pixels\.Config\.rounds 0: expected at least 1"),
        ({"learning_rate": 0.0}, r"--learning-rate 0\.0: expected more than 0"),
        ({"brightness": 2.0}, r"apg_pixels\.Config\.brightness 2\.0: expected between 0 and 1"),
        ({"shift": -1}, r"apg_pixels\.Config\.shift -1: expected at least 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, line):
    with pytest.raises(InputError, match=f"^{line}$"):
        replace(TINY, **settings)


def test_a_robot_without_a_camera_is_refused():
    with pytest.raises(InputError, match="quadrotor: the task has no camera"):
        task = make_task("quadrotor")
        apg_pixels.begin(make_dynamics("quadrotor"), task, [task.episodes(2, "train", 0)], TINY, 0)


@pytest.mark.slow
def test_six_hundred_samples_teach_it_to_keep_the_pole_up():
    task = make_task("cartpole", camera=Camera())
    config = replace(apg_pixels.PRESETS["cartpole"], updates=400, samples=600)
    banks = [task.episodes(config.episodes, "train", 0)]
    run = apg_pixels.begin(DYNAMICS, task, banks, config, 0)
    list(apg_pixels.train(run, DYNAMICS, task, banks, config))
    episodes = evaluate.test_episodes(task, 20, "validation")
    result = evaluate.evaluate(apg_pixels.actor(run.network, task), DYNAMICS, task, episodes)
    assert result.summary["success"] >= 0.9  # untrained: none stays up for a second
