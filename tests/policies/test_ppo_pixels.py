"""PPO from pictures: the policy sees nothing else, robots keep their pictures from update to update, training works."""

import copy
import io
import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from tensordict import TensorDict

from envs import make_dynamics, make_system, make_task
from envs.camera import Camera
from envs.drawing import draw
from envs.errors import InputError
from policies import ppo, ppo_pixels, ppo_update
from policies.actor_critic import as_mean_actor
from policies.apg import training_banks
from policies.checkpoints import load_policy, save_policy
from policies.evaluate import evaluate
from policies.pixel_actor_critic import PixelActorCritic, pixel_actor_critic_for

SMALL = Camera(height=16, width=48, scale=9.6)
TINY = ppo_pixels.Config(
    samples=96,
    batch=4,
    steps=6,
    least_updates=1,
    width=8,
    episodes=6,
    minibatches=1,
    epochs=2,
    critic_epochs=2,
    spread=0.3,
)


@lru_cache
def setting(camera=SMALL):
    """A task, its dynamics, and few training episodes."""
    task = make_task("cartpole", camera=camera)
    return task, make_dynamics("cartpole"), training_banks(task, TINY, 0)


@lru_cache
def drawn(camera=SMALL, seed=0):
    """A network as training draws it."""
    task, dynamics, banks = setting(camera)
    return ppo_pixels.begin(dynamics, task, banks, TINY, seed).network


def begun(config=TINY, seed=0, network=None, camera=SMALL):
    """A run before its first update; it goes on with a copy of the network."""
    task, dynamics, banks = setting(camera)
    network = network or drawn(camera)
    return ppo_pixels.begin(dynamics, task, banks, config, seed, network), (dynamics, task, banks, config)


def finished(config=TINY, seed=0, camera=SMALL):
    run, rest = begun(config, seed, camera=camera)
    return run, list(ppo_pixels.train(run, *rest))


def weights_of(run):
    return torch.cat([value.flatten() for value in run.network.state_dict().values()])


def joined(run, dynamics, task, banks, config, threshold=0.1):
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    parts.tracking.threshold = threshold
    return parts


def spread_network():
    """A network whose actions differ from picture to picture."""
    network = copy.deepcopy(drawn())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for head in (network.policy.head, network.critic.head):
            head.weight.copy_(0.3 * torch.randn(head.weight.shape, generator=generator))
    return network


def seen(n=5):
    """What an environment shows after three steps (n,)."""
    task, dynamics, banks = setting()
    return ppo_update.environment(dynamics, task, banks[0], n).rollout(3, break_when_any_done=False)[:, -1]


class Counting:
    """Dynamics that count the transitions taken from them."""

    def __init__(self, dynamics):
        self.dynamics, self.system, self.count = dynamics, dynamics.system, 0

    def __call__(self, state, action):
        self.count += len(state)
        return self.dynamics(state, action)


# --- what is seen ----------------------------------------------------------------------------------------------------


def test_the_same_pictures_give_the_same_action_whatever_the_state_and_other_pictures_another():
    network, now = spread_network(), seen()
    action = ppo_pixels.actor(network, None)(now.clone())["action"]
    hidden = now.clone()
    for key in ("state", "observation", "reference", "step", "episode"):
        hidden[key] = hidden[key] + 1
    assert torch.equal(ppo_pixels.actor(network, None)(hidden)["action"], action)
    alone = TensorDict({"pixels": now["pixels"]}, batch_size=5)
    assert torch.equal(ppo_pixels.actor(network, None, seed=1)(alone)["action"], action)
    assert action.std() > 1e-3
    for channel in range(12):  # each picture of the stack counts
        other = now["pixels"].clone()
        other[:, channel] = 255 - other[:, channel]
        assert not torch.equal(as_mean_actor(network)(TensorDict({"pixels": other}, batch_size=5))["action"], action)


def test_the_critic_knows_the_state_and_the_deployed_policy_does_without_the_critic():
    network, now = spread_network(), seen()
    value = network.critic(*(now[key] for key in network.critic_keys))
    assert value.shape == (5, 1)
    assert not torch.equal(network.critic(now["state"] + 1, now["window"]), value)
    action = ppo_pixels.actor(network, None)(now.clone())["action"]
    with torch.no_grad():
        for parameter in network.critic.parameters():
            parameter.fill_(torch.nan)
    assert torch.equal(ppo_pixels.actor(network, None)(now.clone())["action"], action)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (torch.zeros(2, 9, 16, 48, dtype=torch.uint8), r"pixels: \(9, 16, 48\) of uint8, expected \(12, 16, 48\)"),
        (torch.zeros(2, 12, 48, 16, dtype=torch.uint8), r"pixels: \(12, 48, 16\) of uint8, expected \(12, 16, 48\)"),
        (torch.zeros(2, 12, 16, 48), r"pixels: \(12, 16, 48\) of float32, expected \(12, 16, 48\) of uint8"),
    ],
)
def test_pictures_of_another_shape_or_type_are_refused(pixels, message):
    actor = ppo_pixels.actor(pixel_actor_critic_for(setting()[0], 8), None)
    with pytest.raises(InputError, match="^" + message):
        actor(TensorDict({"pixels": pixels}, batch_size=2))


def test_a_task_without_a_camera_is_refused():
    task, dynamics, banks = setting()
    with pytest.raises(InputError, match=r"^quadrotor: the task has no camera"):
        ppo_pixels.begin(make_dynamics("quadrotor"), make_task("quadrotor"), banks, TINY, 0)
    with pytest.raises(InputError, match=r"^cartpole: the task has no camera"):
        ppo_pixels.begin(dynamics, replace(task, camera=None), banks, TINY, 0)


def test_a_checkpoint_brings_back_the_policy_and_its_camera(tmp_path):
    task = setting()[0]
    network, now = spread_network(), seen()
    save_policy(tmp_path / "policy.safetensors", network, task, {}, "ppo-pixels")
    policy = load_policy(tmp_path / "policy.safetensors", task.system, "ppo-pixels")
    assert policy.task == task
    assert isinstance(policy.network, PixelActorCritic)
    again = policy.actor()(now.clone())["action"]
    assert torch.equal(again, ppo_pixels.actor(network, task)(now.clone())["action"])


def test_pictures_are_normalised_to_what_random_actions_in_the_nominal_robot_show():
    task, _, banks = setting()
    counting = Counting(make_dynamics("cartpole", "gravity=x0.9"))
    network = ppo_pixels.begin(counting, task, banks, TINY, 0).network
    assert counting.count == 0  # no transition of a target is spent on it
    encoder = network.policy.trunk.encoder
    bright, changing = encoder.mean[:3].flatten(), encoder.mean[3:].flatten()
    assert (bright > 150).all()  # the background is light
    assert (changing.abs() < 5).all()  # and still
    assert (encoder.scale >= 1).all()
    assert not torch.equal(network.critic.trunk.layers.observation_scale, torch.ones(4))


def test_every_layer_tells_one_picture_from_another_before_anything_is_learned():
    """Mean 0 and deviation 1 over pictures, in each output of each layer, whatever the camera shows."""
    pixels = torch.randint(0, 255, (40, *SMALL.shape), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    pixels = pixels // 20 + 200  # faint differences on a bright ground
    trunk = copy.deepcopy(drawn().policy.trunk)
    trunk.normalise(pixels)
    layers = [*trunk.encoder.convolutions, trunk.encoder.layer, trunk.layer]
    outputs = []
    for layer in layers:
        layer.register_forward_hook(lambda layer, inputs, output: outputs.append(output.transpose(0, 1).flatten(1)))
    with torch.no_grad():
        trunk(pixels)
    assert len(outputs) == 6
    for hidden in outputs:
        torch.testing.assert_close(hidden.mean(1), torch.zeros(len(hidden)), rtol=0, atol=1e-3)
        torch.testing.assert_close(hidden.std(1), torch.ones(len(hidden)), rtol=1e-3, atol=0)


# --- flights ---------------------------------------------------------------------------------------------------------


def flights(updates=8):
    """The transitions (4, 6) of several updates in a row, where robots were before each and after it, and the rest."""
    run, rest = begun()
    run.network = spread_network()
    parts = joined(run, *rest)
    for seed in range(updates):
        before = run.place.clone()
        yield before, ppo_update.fly(run, parts, seed).clone(), run.place.clone(), rest


def pictures_of(task, state):
    """One picture (*B, 3, H, W) of each state (*B, 4)."""
    return draw(task.camera, task.system, state.reshape(-1, 4)).reshape(*state.shape[:-1], 3, *task.camera.shape[1:])


def test_robots_that_go_on_keep_their_pictures_and_a_new_flight_begins_with_its_first_in_every_place():
    begins = goes_on = 0
    for _, flown, after, (_, task, *_) in flights():
        torch.testing.assert_close(flown["pixels"][..., :3, :, :], pictures_of(task, flown["state"]), rtol=0, atol=0)
        older = flown["pixels"][..., :-3, :, :]
        assert torch.equal(flown["next", "pixels"][..., 3:, :, :], older)
        done = flown["next", "done"].squeeze(-1)
        following = torch.cat((flown["pixels"][:, 1:], after["pixels"].unsqueeze(1)), 1)
        assert torch.equal(following[~done], flown["next", "pixels"][~done])
        fresh = following[done]
        assert torch.equal(fresh, fresh[:, :3].repeat(1, 4, 1, 1))
        begins, goes_on = begins + int(done.sum()), goes_on + int((~done).sum())
    assert begins > 5
    assert goes_on > 50


def test_an_update_begins_where_the_one_before_it_ended():
    last = None
    for before, flown, after, (dynamics, *_) in flights():
        assert set(before.keys()) == {"state", "episode", "step", "pixels"}
        assert all(torch.equal(flown[:, 0][key], before[key]) for key in before.keys())  # noqa: SIM118
        assert last is None or all(torch.equal(last[key], before[key]) for key in before.keys())  # noqa: SIM118
        torch.testing.assert_close(flown["next", "state"], dynamics(flown["state"], flown["action"]))
        last = after


def test_robots_that_are_moved_to_another_bank_begin_with_pictures_of_where_they_are_then():
    run, (dynamics, task, banks, config) = begun()
    parts = joined(run, dynamics, task, banks, config)
    ppo_update.fly(run, parts, 0)
    ppo._move(run, task, banks[0] + 0.02, changed=True)
    flown = ppo_update.fly(run, parts, 1)
    episode = flown["episode"][:, 0].squeeze(-1)
    assert torch.equal(flown["state"][:, 0], banks[0][episode] + 0.02)
    assert torch.equal(flown["pixels"][:, 0], pictures_of(task, flown["state"][:, 0]).repeat(1, 4, 1, 1))


def test_the_probability_of_a_flown_action_is_that_of_a_normal_before_the_tanh():
    """Change of variables: log p(a) = log N(atanh a) - log(1 - a²); the first step of an update so has ratio 1."""
    run, rest = begun()
    run.network = spread_network()
    run.network.policy.limit(0.3, 0.6)
    parts = joined(run, *rest)
    flown = ppo_update.fly(run, parts, 0)
    location, scale = (part.double() for part in run.network.policy(flown["pixels"]))
    action = flown["action"].double()
    normal = -0.5 * ((action.atanh() - location) / scale).square() - scale.log() - 0.5 * math.log(2 * math.pi)
    expected = (normal - (1 - action.square()).log()).sum(-1)
    torch.testing.assert_close(flown["action_log_prob"].double(), expected, rtol=1e-3, atol=2e-2)
    assert expected.std() > 0.2


def test_who_strays_is_put_back_within_the_threshold_of_the_curriculum():
    config = replace(TINY, samples=24 * 10, curriculum=0.5, epochs=1, critic_epochs=0)
    run, (dynamics, task, banks, _) = begun(config)
    history, farthest = [], []
    for row in ppo_pixels.train(run, dynamics, task, banks, config):
        history.append(row)
        farthest.append(float(run.place["state"][:, 2].abs().max()) - row["threshold"])
    assert [row["threshold"] for row in history] == pytest.approx([0.05, 0.12, 0.19, 0.26, 0.33] + 5 * [0.4])
    assert max(farthest) <= 0
    assert history[0]["resets"] > 0


def test_training_flights_begin_all_over_the_picture_and_like_those_of_the_task_but_for_that():
    task, _, _ = setting()
    bank = task.episodes(500, "train", 0)
    (scattered,) = ppo_pixels._scattered([bank], task, replace(TINY, spread=0.7))
    assert torch.equal(scattered[:, 1:], bank[:, 1:])
    offset = scattered[:, 0] - bank[:, 0]
    assert offset.abs().max() <= 0.7 + 1e-6
    assert float(offset.mean()) == pytest.approx(0, abs=0.06)
    assert float(offset.std()) == pytest.approx(0.7 / math.sqrt(3), rel=0.1)  # uniform
    assert torch.equal(ppo_pixels._scattered([bank], task, replace(TINY, spread=0.7))[0], scattered)
    assert torch.equal(ppo_pixels._scattered([bank], task, replace(TINY, spread=0.0))[0], bank)


def test_robots_start_from_scattered_places_from_the_first_update_on():
    wide = replace(TINY, samples=6 * 64, batch=64, minibatches=1, epochs=1, spread=1.5)
    run, rest = begun(wide)
    assert run.place["state"][:, 0].abs().max() > 1
    begin = run.place["state"][:, 0].clone()
    run.place["state"][:, 2] = 1.0  # all fall, and begin again elsewhere
    list(ppo_pixels.train(run, *rest))
    again = run.place["state"][:, 0]
    assert (again - begin).abs().max() > 0.3
    assert again.abs().max() > 1


# --- training --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 333, 1024])
def test_no_more_transitions_are_taken_than_the_budget_and_all_are_counted(samples):
    config = replace(TINY, samples=samples, batch=32, steps=8, least_updates=3, epochs=1)
    task, dynamics, banks = setting()
    counting = Counting(dynamics)
    run = ppo_pixels.begin(counting, task, banks, config, 0)
    history = list(ppo_pixels.train(run, counting, task, banks, config))
    assert counting.count == run.samples == history[-1]["samples"] <= samples
    assert run.samples >= 0.9 * samples
    assert len(history) == config.updates == run.update


def test_the_tuned_settings_take_no_more_than_the_samples_of_the_paper():
    for config in ppo_pixels.PRESETS.values():
        assert config.updates * config.collected <= config.samples <= 230_000


@pytest.mark.parametrize("camera", [SMALL, replace(SMALL, noise=4.0)], ids=["clear", "noisy"])
def test_a_resumed_run_ends_bit_for_bit_where_an_uninterrupted_one_does(camera):
    whole, history = finished(camera=camera)
    run, rest = begun(camera=camera)
    updates = ppo_pixels.train(run, *rest)
    first = [next(updates) for _ in range(2)]
    file = io.BytesIO()
    torch.save(run.state_dict(), file)
    file.seek(0)
    list(updates)  # what comes after must not reach into what was saved
    again, (dynamics, task, banks, config) = begun(seed=5, camera=camera)
    again.load_state_dict(torch.load(file, weights_only=True), banks, config, task)
    assert first + list(ppo_pixels.train(again, dynamics, task, banks, config)) == history
    assert torch.equal(weights_of(again), weights_of(whole))
    assert torch.equal(again.generator.get_state(), whole.generator.get_state())
    assert all(torch.equal(again.place[key], whole.place[key]) for key in whole.place.keys())  # noqa: SIM118


def test_the_same_seed_gives_the_same_weights_another_seed_others_and_the_global_state_stays():
    torch.manual_seed(99)
    before = torch.get_rng_state()
    runs = []
    for seed in (0, 0, 1):
        task, dynamics, banks = setting()
        run = ppo_pixels.begin(dynamics, task, banks, TINY, seed)
        runs.append((run, list(ppo_pixels.train(run, dynamics, task, banks, TINY))))
    (one, history), (two, again), (other, _) = runs
    assert torch.equal(torch.get_rng_state(), before)
    assert history == again
    assert torch.equal(weights_of(one), weights_of(two))
    assert not torch.equal(weights_of(one), weights_of(other))


def test_fine_tuning_goes_on_with_a_copy():
    run, _ = finished()
    before = weights_of(run).clone()
    config = replace(ppo_pixels.finetuning(TINY, make_system("cartpole")), samples=100)
    tuned, (_, task, banks, _) = begun(config, network=run.network)
    assert torch.equal(weights_of(tuned), before)
    list(ppo_pixels.train(tuned, make_dynamics("cartpole", "gravity=x1.2"), task, banks, config))
    assert torch.equal(weights_of(run), before)
    assert not torch.equal(weights_of(tuned), before)
    encoders = [each.network.policy.trunk.encoder for each in (run, tuned)]
    assert torch.equal(encoders[0].scale, encoders[1].scale)
    assert not torch.equal(encoders[0].convolutions[0].weight, encoders[1].convolutions[0].weight)


@pytest.mark.slow
def test_training_on_few_pictures_makes_unseen_flights_last_longer():
    task, dynamics = replace(setting()[0], steps=100), setting()[1]
    config = replace(ppo_pixels.PRESETS["cartpole"], samples=16_000, episodes=200, spread=0.0)
    banks = training_banks(task, config, 0)
    run = ppo_pixels.begin(dynamics, task, banks, config, 0)
    unseen = task.episodes(20, "validation", 0)

    def lasting():
        """Mean number of steps until a flight fails."""
        states = evaluate(ppo_pixels.actor(run.network, task), dynamics, task, unseen).states
        return float((~task.diverged(None, None, states)).float().sum(1).mean())

    before = lasting()
    list(ppo_pixels.train(run, dynamics, task, banks, config))
    assert lasting() > 2 * before


# --- the critic alone ------------------------------------------------------------------------------------------------


def test_passes_of_the_critic_alone_bring_it_nearer_to_the_returns_and_leave_the_policy_as_it_is():
    config = replace(TINY, critic_epochs=60, trace=1.0, learning_rate=1e-2)
    run, rest = begun(config)
    parts = joined(run, *rest[:3], config)
    flown = ppo_update.fly(run, parts, 0)
    ppo_update.judge(flown, run.network, parts, config)
    policy = copy.deepcopy(run.network.policy.state_dict())

    def misses():
        with torch.no_grad():
            value = run.network.critic(*(flown[key] for key in run.network.critic_keys))
        return float((value - flown["value_target"]).square().mean())

    before = misses()
    with ppo.drawing_from(run.generator):
        ppo_update.study(flown, run, parts, config, fall=1.0)
    assert misses() < 0.5 * before
    assert all(torch.equal(value, policy[name]) for name, value in run.network.policy.state_dict().items())
    assert float(flown["advantage"].mean()) == pytest.approx(0, abs=1e-5)
    assert float(flown["advantage"].std(correction=0)) == pytest.approx(1, abs=1e-4)


def test_advantages_are_those_of_the_critic_after_its_last_pass():
    config = replace(TINY, critic_epochs=3, trace=0.0)
    run, rest = begun(config)
    parts = joined(run, *rest[:3], config)
    flown = ppo_update.fly(run, parts, 0)
    ppo_update.judge(flown, run.network, parts, config)
    with ppo.drawing_from(run.generator):
        ppo_update.study(flown, run, parts, config, fall=1.0)
    with torch.no_grad():
        here, there = (run.network.critic(each["state"], each["window"]) for each in (flown, flown["next"]))
    gain = flown["next", "reward"] + config.discount * there - here  # with a trace of 0: one step
    expected = (gain - gain.mean()) / gain.std(correction=0)
    torch.testing.assert_close(flown["advantage"], expected, rtol=1e-3, atol=1e-3)


def test_training_lets_the_critic_take_its_own_passes_in_every_update():
    run, _ = finished(replace(TINY, critic_epochs=3))
    state = run.optimizer.state_dict()["state"]
    steps = [int(each["step"]) for each in state.values()]
    assert set(steps) == {min(steps), min(steps) + 3 * run.update}  # of the policy, and of the critic
    assert min(steps) >= run.update


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("critic_epochs", -1, "ppo.Config.critic_epochs -1: expected at least 0"),
        ("spread", -0.1, "ppo_pixels.Config.spread -0.1: expected at least 0"),
        ("spread", math.nan, "ppo_pixels.Config.spread nan: expected at least 0"),
        ("samples", 0, "--samples 0: expected at least 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(field, value, message):
    with pytest.raises(InputError, match="^" + message):
        ppo_pixels.Config(**{field: value})
