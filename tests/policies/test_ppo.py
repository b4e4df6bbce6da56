"""PPO: values and probabilities are those of the formulas, training works, and a run can be repeated and continued."""

import copy
import io
import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from envs import SYSTEMS, make_dynamics, make_env, make_system, make_task
from envs.errors import InputError
from policies import ppo, ppo_update
from policies.actor_critic import ActorCritic, actor_critic_for
from policies.apg import training_banks

TINY = ppo.Config(samples=96, batch=4, steps=6, least_updates=1, width=8, episodes=6, curriculum=0.6)


@pytest.fixture(params=SYSTEMS)
def name(request):
    return request.param


@lru_cache
def setting(name):
    """A task, its dynamics, and few training episodes at each speed."""
    task = make_task(name, horizon=3)
    return task, make_dynamics(name), training_banks(task, TINY, 0)


def begun(name, config=TINY, seed=0, network=None):
    task, dynamics, banks = setting(name)
    return ppo.begin(dynamics, task, banks, config, seed, network), (dynamics, task, banks, config)


def finished(name, config=TINY, seed=0):
    run, rest = begun(name, config, seed)
    return run, list(ppo.train(run, *rest))


def weights_of(run):
    return torch.cat([value.flatten() for value in run.network.state_dict().values()])


class Counting:
    """Dynamics that count the transitions taken from them."""

    def __init__(self, dynamics):
        self.dynamics, self.system, self.count = dynamics, dynamics.system, 0

    def __call__(self, state, action):
        self.count += len(state)
        return self.dynamics(state, action)


# --- the policy ------------------------------------------------------------------------------------------------------


def seen(name, n=5):
    env = make_env(name, task=make_task(name, horizon=3), batch_size=(n,), episodes=6)
    return env.rollout(3, break_when_any_done=False)[:, -1]


def spread_policy(name):
    """An actor-critic whose actions differ from state to state and from entry to entry."""
    network = actor_critic_for(make_task(name, horizon=3), 16).double()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64) * 0.5)
    return network


def test_the_deterministic_actor_takes_tanh_of_the_mean(name):
    network, now = spread_policy(name), seen(name).double()
    location, scale = network.policy(*(now[key] for key in network.in_keys))
    action = ppo.actor(network, None)(now.clone())["action"]
    torch.testing.assert_close(action, location.tanh())
    assert action.std() > 0.1
    assert torch.equal(ppo.actor(network, None, seed=1)(now.clone())["action"], action)
    network.policy.limit(0.01, 0.02)
    assert torch.equal(ppo.actor(network, None)(now.clone())["action"], action)
    assert (scale > 0).all()


def test_the_probability_of_a_flown_action_is_that_of_a_normal_before_the_tanh(name):
    """Change of variables: log p(a) = sum log N(atanh a) - log(1 - a²)."""
    run, (dynamics, task, banks, config) = begun(name)
    run.network = spread_policy(name).float()
    run.network.policy.limit(0.3, 0.6)
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    with ppo.drawing_from(run.generator) as seed:
        flown = ppo_update.fly(run, parts, seed).double()
    policy = copy.deepcopy(run.network.policy).double()
    location, scale = policy(*(flown[key] for key in run.network.in_keys))
    action = flown["action"]
    before = (action.atanh() - location) / scale
    normal = -0.5 * before.square() - scale.log() - 0.5 * math.log(2 * math.pi)
    expected = (normal - (1 - action.square()).log()).sum(-1)
    torch.testing.assert_close(flown["action_log_prob"], expected, rtol=1e-3, atol=2e-2)
    assert expected.std() > 0.3


def test_the_density_of_an_action_integrates_to_one():
    run, (dynamics, task, banks, config) = begun("cartpole")
    with torch.no_grad():
        run.network.policy.log_scale.fill_(-0.7)
        run.network.policy.head.bias.fill_(0.4)
    actor = ppo_update.joined(run.network, dynamics, task, banks[0], config).loss.actor_network
    now = seen("cartpole", 1)
    action = torch.linspace(-1, 1, 20001)[1:-1]
    with torch.no_grad():
        density = actor.get_dist(now).log_prob(action[:, None, None]).exp().squeeze(-1)
    assert float(torch.trapezoid(density, action)) == pytest.approx(1, abs=1e-3)


def test_the_mean_stays_where_float32_tells_one_action_from_the_next():
    network = actor_critic_for(make_task("cartpole"), 8)
    with torch.no_grad():
        network.policy.head.bias.fill_(1e4)
        location, _ = network.policy(torch.zeros(4), torch.zeros(10, 0))
    assert (location <= 5).all()
    assert (location.tanh() < 1).all()


def test_the_scale_is_kept_between_its_bounds():
    network = actor_critic_for(make_task("quadrotor"), 8)
    with torch.no_grad():
        network.policy.log_scale.copy_(torch.tensor([0.01, 0.2, 0.3, 2.0]).log())
    network.policy.limit(0.1, 0.5)
    torch.testing.assert_close(network.policy.log_scale.exp(), torch.tensor([0.1, 0.2, 0.3, 0.5]))


def test_the_contract_of_a_task_makes_a_network_that_its_weights_fit(name):
    task = make_task(name)
    network = actor_critic_for(task, 8)
    sizes = ActorCritic.contract(task)
    assert all(getattr(network.config, key) == value for key, value in sizes.items())
    again = ActorCritic(network.config)
    again.load_state_dict(network.state_dict())
    now = make_env(name, batch_size=(3,), episodes=4).reset()
    assert torch.equal(ppo.actor(again, task)(now.clone())["action"], ppo.actor(network, task)(now)["action"])


def test_without_a_width_the_layers_are_those_of_the_paper():
    network = actor_critic_for(make_task("cartpole"))
    sizes = [
        (layer.in_features, layer.out_features) for layer in network.policy.modules() if isinstance(layer, nn.Linear)
    ]
    assert sorted(sizes) == sorted([(4, 32), (32, 64), (64, 64), (64, 32), (32, 1)])


@pytest.mark.parametrize("name", ["cartpole", "fixed_wing"])
def test_observations_are_normalised_to_what_random_actions_in_the_nominal_robot_show(name):
    counting = Counting(make_dynamics(name, "gravity=x0.9" if name == "cartpole" else "drag=0.3"))
    task, nominal, banks = setting(name)
    run = ppo.begin(counting, task, banks, TINY, 0)
    assert counting.count == 0  # no transition of a target is spent on it
    inside = ppo.begin(nominal, task, banks, TINY, 0)
    for trunk in ("policy", "critic"):
        layers = [getattr(each.network, trunk).trunk.layers for each in (run, inside)]
        assert torch.equal(layers[0].observation_scale, layers[1].observation_scale)
        assert not torch.equal(layers[0].observation_scale, torch.ones_like(layers[0].observation_scale))


# --- values ----------------------------------------------------------------------------------------------------------


def judged(name, change=lambda flown: None):
    """Transitions (4, 6) with ends among them, before and after they are judged, and the run."""
    run, (dynamics, task, banks, config) = begun(name)
    run.network = spread_policy(name).float()
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    parts.env.threshold = 0.03 if name == "cartpole" else 0.3
    with ppo.drawing_from(run.generator) as seed:
        flown = ppo_update.fly(run, parts, seed)
    change(flown)
    before = flown.clone()
    metrics = ppo_update.judge(flown, run.network, parts, config)
    return run, before, flown, metrics


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_value_targets_are_the_weighted_returns_and_an_end_is_worth_what_the_state_before_it_is(name):
    run, before, flown, _ = judged(name)
    keys, done = run.network.critic_keys, before["next", "done"]
    assert done.any() and not done.all()
    with torch.no_grad():
        value, behind = (run.network.critic(*(each[key] for key in keys)) for each in (before, before["next"]))
    reward = (1 - TINY.discount) * before["next", "reward"] / run.network.unit
    target = torch.zeros_like(reward)
    for row in range(4):
        gain = 0.0
        for step in reversed(range(6)):
            ended = bool(done[row, step])
            following = value[row, step] if ended else behind[row, step]
            error = reward[row, step] + TINY.discount * following - value[row, step]
            gain = error + (0.0 if ended else TINY.discount * TINY.trace * gain)
            target[row, step] = value[row, step] + gain
    torch.testing.assert_close(flown["value_target"], target, rtol=1e-4, atol=1e-4)
    advantage = (target - value - (target - value).mean()) / (target - value).std(correction=0)
    torch.testing.assert_close(flown["advantage"], advantage, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_the_unit_is_the_mean_cost_of_a_step(name):
    run, before, _, metrics = judged(name)
    mean = -float(before["next", "reward"].mean())
    assert float(run.network.unit) == pytest.approx(mean, rel=1e-5)
    assert metrics["cost"] == pytest.approx(mean, rel=1e-5) == -metrics["reward"]
    strayed = before["next", "truncated"] & (before["next", "step"] < setting(name)[0].steps)
    assert 0 < metrics["resets"] == pytest.approx(float(strayed.float().mean()))


def test_a_flight_that_costs_the_same_everywhere_is_worth_the_same_whether_or_not_it_ends():
    """So neither straying nor arriving early is a way out of costs."""

    def level(flown):
        flown["next", "reward"] = torch.full_like(flown["next", "reward"], -3.0)

    run, (dynamics, task, banks, config) = begun("cartpole")
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    with torch.no_grad():
        run.network.critic.head.weight.zero_()
        run.network.critic.head.bias.fill_(-1.0)  # in units of the cost of a step, and of the discounted time
    for ends in (("truncated",), ("terminated",), ()):
        with ppo.drawing_from(run.generator) as seed:
            flown = ppo_update.fly(run, parts, seed)
        level(flown)
        for end in ends:
            flown["next", end][:2, 3] = True
            flown["next", "done"][:2, 3] = True
        ppo_update.judge(flown, run.network, parts, config)
        torch.testing.assert_close(flown["value_target"], torch.full((4, 6, 1), -1.0))


@pytest.mark.parametrize("bad", [float("nan"), float("-inf"), -1e30])
def test_a_cost_that_is_not_finite_or_beyond_all_measure_counts_as_a_hundred_mean_ones(bad):
    def broken(flown):
        flown["next", "reward"][1, 2] = bad
        flown["next", "state"][1, 2] = torch.nan
        flown["next", "done"][1, 2] = True

    _, _, flown, _ = judged("quadrotor", broken)
    assert float(flown["next", "reward"][1, 2]) == pytest.approx(-100 * (1 - TINY.discount))
    assert torch.isfinite(flown["advantage"]).all()
    assert flown["advantage"][1, 2] == flown["advantage"].min()


# --- updates ---------------------------------------------------------------------------------------------------------


def improved(config, advantage, epochs=1):
    """A run before and after an update on actions whose advantages are given (4, 6, 1); and the flown transitions."""
    run, (dynamics, task, banks, _) = begun("quadrotor", config)
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    with ppo.drawing_from(run.generator) as seed:
        flown = ppo_update.fly(run, parts, seed)
        flown["advantage"], flown["value_target"] = advantage, torch.zeros(4, 6, 1)
        before = weights_of(run).clone()
        metrics = ppo_update.improve(flown, run, parts, config, fall=1.0)
    with torch.no_grad():
        after = parts.loss.actor_network.get_dist(flown).log_prob(flown["action"])
    return run, before, metrics, after - flown["action_log_prob"]


def test_an_update_makes_better_actions_likelier_and_worse_ones_less_likely():
    advantage = torch.randn(4, 6, 1, generator=torch.Generator().manual_seed(0))
    config = replace(TINY, learning_rate=1e-3, target_kl=10.0, epochs=5, minibatches=1)
    *_, change = improved(config, advantage)
    assert float((change * advantage.squeeze(-1)).mean()) > 0.01


def test_the_learning_rate_follows_the_divergence_and_an_update_that_moved_too_far_ends():
    advantage = torch.randn(4, 6, 1, generator=torch.Generator().manual_seed(0))
    eager = replace(TINY, learning_rate=3e-2, target_kl=1e-6, epochs=5, minibatches=3)
    run, _, metrics, _ = improved(eager, advantage)
    assert metrics["kl"] > 2e-6
    assert run.rate == pytest.approx(3e-2 / 1.5)
    steps = {int(state["step"]) for state in run.optimizer.state_dict()["state"].values()}
    assert max(steps) < 15
    calm = replace(eager, learning_rate=1e-5, target_kl=10.0)
    run, *_ = improved(calm, advantage)
    assert run.rate == pytest.approx(1.5e-5)
    assert {int(state["step"]) for state in run.optimizer.state_dict()["state"].values()} == {15}


def test_minibatches_without_a_finite_gradient_are_left_out_and_counted():
    advantage = torch.full((4, 6, 1), torch.nan)
    run, before, metrics, _ = improved(replace(TINY, epochs=2, minibatches=3), advantage)
    assert run.skipped == 6
    assert torch.equal(weights_of(run), before)
    assert all(math.isfinite(value) for value in metrics.values())


class Failing:
    """Dynamics whose prediction for the first robots is not a number in some calls."""

    def __init__(self, dynamics, calls, rows):
        self.dynamics, self.calls, self.rows, self.system = dynamics, calls, rows, dynamics.system
        self.call = 0

    def __call__(self, state, action):
        self.call += 1
        following = self.dynamics(state, action)
        if self.call in self.calls:
            following[: self.rows] = torch.nan
        return following


@pytest.mark.parametrize(("name", "rows"), [("cartpole", 4), ("fixed_wing", 1)])
def test_a_robot_that_is_not_a_number_is_put_back_and_training_goes_on(name, rows):
    run, (dynamics, task, banks, config) = begun(name)
    history = list(ppo.train(run, Failing(dynamics, {9}, rows), task, banks, config))
    assert len(history) == config.updates
    assert run.skipped == 0
    assert torch.isfinite(weights_of(run)).all()
    assert torch.isfinite(run.place["state"]).all()
    assert all(math.isfinite(value) for row in history for value in row.values())


def test_dynamics_that_never_give_a_number_neither_break_the_policy_nor_the_run():
    run, (dynamics, task, banks, config) = begun("quadrotor")
    history = list(ppo.train(run, Failing(dynamics, range(1000), 4), task, banks, config))
    assert min(row["resets"] for row in history) > 0.9  # the others ended by the clock
    assert torch.isfinite(weights_of(run)).all()


def test_within_seconds_training_makes_the_cost_of_unseen_flights_a_tenth():
    task, dynamics = make_task("cartpole", steps=50), make_dynamics("cartpole")
    config = ppo.Config(samples=40_000, batch=128, steps=8, learning_rate=3e-3, width=32, episodes=200)
    banks = training_banks(task, config, 0)
    run = ppo.begin(dynamics, task, banks, config, 0)
    env = make_env("cartpole", task=task, batch_size=(20,), episodes=20, split="validation")
    start = env.reset(TensorDict({"episode": torch.arange(20)[:, None]}, batch_size=20))

    def cost():
        options = {"tensordict": start.clone(), "auto_reset": False, "break_when_any_done": False}
        with torch.no_grad():
            return -float(env.rollout(50, ppo.actor(run.network, task), **options)["next", "reward"].mean())

    before = cost()
    list(ppo.train(run, dynamics, task, banks, config))
    assert cost() < 0.1 * before


# --- budget and curriculum -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 1000, 1001, 4999])
def test_no_more_transitions_are_taken_than_the_budget_and_all_are_counted(samples):
    config = replace(
        ppo.finetuning(TINY, make_system("cartpole")), samples=samples, batch=128, steps=16, least_updates=10, epochs=1
    )
    task, dynamics, banks = setting("cartpole")
    counting = Counting(dynamics)
    run = ppo.begin(counting, task, banks, config, 0)
    history = list(ppo.train(run, counting, task, banks, config))
    assert counting.count == run.samples == history[-1]["samples"] <= samples
    assert run.samples >= 0.9 * samples
    assert len(history) == config.updates == run.update


def test_any_budget_lasts_for_several_updates_and_is_nearly_used_up():
    for samples in (1, 2, 15, 16, 17, 100, 1000, 1001, 5000, 150_000, 1_500_000):
        tuned = [ppo.finetuning(config, make_system(name)) for name, config in ppo.PRESETS.items()]
        for config in (*tuned, *ppo.PRESETS.values()):
            config = replace(config, samples=samples)
            used = config.updates * config.collected
            assert 0.9 * samples <= used <= samples or (samples < 100 and 0 < used <= samples)
            assert config.updates >= 10 or samples < 160
            assert config.side_by_side <= config.batch


def test_training_follows_the_curriculum_and_who_strays_is_put_back_within_it():
    config = replace(TINY, samples=12 * 24, curriculum=0.5)
    run, (dynamics, task, banks, _) = begun("quadrotor", config)
    history, farthest = [], []
    for row in ppo.train(run, dynamics, task, banks, config):
        history.append(row)
        rows = banks[row["stage"]][run.place["episode"].squeeze(-1)]
        away = task.distance(rows, run.place["step"].squeeze(-1), run.place["state"])
        farthest.append(float(away.max()) / row["threshold"])
    assert [row["stage"] for row in history] == [0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2]
    assert [row["threshold"] for row in history[:6]] == pytest.approx([0.1, 1.05] * 3)
    assert max(farthest) <= 1
    assert history[0]["resets"] > 0


def test_robots_fly_on_from_where_they_are_and_those_whose_flight_has_ended_from_another_place():
    run, (dynamics, task, banks, config) = begun("cartpole")
    parts = ppo_update.joined(run.network, dynamics, task, banks[0], config)
    parts.env.threshold = 0.1
    ended = 0
    for seed in range(20):
        place = run.place.clone()
        flown = ppo_update.fly(run, parts, seed)
        assert all(torch.equal(flown[:, 0][key], place[key]) for key in place.keys())  # noqa: SIM118
        torch.testing.assert_close(flown["next", "state"], dynamics(flown["state"], flown["action"]))
        last, done = flown["next", "state"][:, -1], flown["next", "done"][:, -1].squeeze(-1)
        assert torch.equal(run.place["state"][~done], last[~done])
        fresh = banks[0][run.place["episode"].squeeze(-1)]
        assert torch.equal(run.place["state"][done], fresh[done])  # a pole's episode is its first state
        ended += int(done.sum())
    assert 0 < ended < 80


def test_a_faster_bank_is_entered_on_its_own_reference_at_the_same_step():
    run, (_, task, banks, _) = begun("quadrotor")
    place = run.place.clone()
    ppo._move(run, task, banks[2], changed=False)
    assert torch.equal(run.place["state"], place["state"])
    ppo._move(run, task, banks[2], changed=True)
    rows, step = banks[2][place["episode"].squeeze(-1)], place["step"].squeeze(-1)
    assert torch.equal(run.place["state"], task.start(rows, step))
    assert torch.equal(run.place["step"], place["step"])


def test_exploration_narrows_from_its_first_to_its_last_bound():
    config = replace(TINY, samples=24 * 10, exploration=0.4, final_exploration=0.1)
    run, rest = begun("cartpole", config)
    torch.testing.assert_close(run.network.policy.log_scale.exp(), torch.tensor([0.4]))
    found = [row["exploration"] for row in ppo.train(run, *rest)]
    for update, value in enumerate(found):
        assert value <= 1.1 * 0.4 * 0.25 ** (update / 10)
    assert 0.09 < found[-1] < 0.13


# --- repeating and continuing ----------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_weights_and_another_seed_others():
    one, history = finished("fixed_wing")
    torch.manual_seed(99)  # global state must not matter
    two, again = finished("fixed_wing")
    other, _ = finished("fixed_wing", seed=1)
    assert torch.equal(weights_of(one), weights_of(two))
    assert history == again
    assert not torch.equal(weights_of(one), weights_of(other))


def test_training_leaves_the_global_random_state_alone():
    before = torch.get_rng_state()
    run, rest = begun("cartpole")
    for _ in ppo.train(run, *rest):
        assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(("name", "stopped_at"), [("cartpole", 2), ("quadrotor", 3)])
def test_a_resumed_run_ends_bit_for_bit_where_an_uninterrupted_one_does(name, stopped_at):
    config = replace(TINY, samples=6 * 24)
    whole, history = finished(name, config)
    begun_run, rest = begun(name, config)
    updates = ppo.train(begun_run, *rest)
    first = [next(updates) for _ in range(stopped_at)]
    file = io.BytesIO()
    torch.save(begun_run.state_dict(), file)
    file.seek(0)
    for _ in updates:  # what comes after must not reach into what was saved
        pass
    again, (dynamics, task, banks, _) = begun(name, config, seed=5)
    again.load_state_dict(torch.load(file, weights_only=True), banks, config, task)
    assert first + list(ppo.train(again, dynamics, task, banks, config)) == history
    assert torch.equal(weights_of(again), weights_of(whole))
    assert torch.equal(again.generator.get_state(), whole.generator.get_state())
    assert all(torch.equal(again.place[key], whole.place[key]) for key in whole.place.keys())  # noqa: SIM118


def test_fine_tuning_goes_on_with_a_copy_in_the_same_units():
    run, _ = finished("quadrotor")
    before, unit = weights_of(run).clone(), float(run.network.unit)
    config = replace(ppo.finetuning(TINY, make_system("cartpole")), samples=200)
    tuned, (_, task, banks, _) = begun("quadrotor", config, network=run.network)
    assert torch.equal(weights_of(tuned), before)
    assert float(tuned.network.unit) == unit > 0
    list(ppo.train(tuned, make_dynamics("quadrotor", "drag=0.3"), task, banks, config))
    assert torch.equal(weights_of(run), before)
    assert not torch.equal(weights_of(tuned), before)
    scale = tuned.network.policy.trunk.layers.observation_scale
    assert torch.equal(scale, run.network.policy.trunk.layers.observation_scale)


class Plain(nn.Module):
    """Another network with the interface that PPO asks for, which reads nothing but the state."""

    in_keys = critic_keys = ("state",)

    class Policy(nn.Module):
        def __init__(self, states, actions):
            super().__init__()
            self.mean, self.log_scale = nn.Linear(states, actions), nn.Parameter(torch.zeros(actions))

        def forward(self, state):
            return self.mean(state), self.log_scale.exp().expand(*state.shape[:-1], -1)

        def limit(self, low, high):
            self.log_scale.data.clamp_(math.log(low), math.log(high))

    def __init__(self, states, actions):
        super().__init__()
        self.policy, self.critic = Plain.Policy(states, actions), nn.Linear(states, 1)
        self.register_buffer("unit", torch.zeros(()))


@pytest.mark.parametrize("name", ["cartpole", "fixed_wing"])
def test_any_network_with_the_same_interface_is_trained(name):
    task = setting(name)[0]
    network = Plain(len(task.system.State._fields), len(task.system.Action._fields))
    run, rest = begun(name, network=network)
    before = weights_of(run).clone()
    list(ppo.train(run, *rest))
    assert not torch.equal(weights_of(run), before)
    action = ppo.actor(run.network, task)(TensorDict({"state": run.place["state"]}, batch_size=4))["action"]
    assert action.shape == (4, len(task.system.Action._fields))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("samples", 0, "--samples 0: expected at least 1"),
        ("batch", 0, "--batch 0: expected at least 1"),
        ("width", -3, "--width -3: expected at least 1"),
        ("steps", 0, "ppo.Config.steps 0: expected at least 1"),
        ("learning_rate", float("nan"), "--learning-rate nan: expected more than 0"),
        ("learning_rate", 0.0, "--learning-rate 0.0: expected more than 0"),
        ("clip", float("inf"), "ppo.Config.clip inf: expected more than 0"),
        ("curriculum", 1.5, "--curriculum 1.5: expected between 0 and 1"),
        ("discount", 1.0, "ppo.Config.discount 1: expected less than 1"),
        ("exploration", 0.01, "--exploration 0.01: expected at least 0.06, the last"),
        ("exploration", 0.0, "--exploration 0.0: expected more than 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(field, value, message):
    with pytest.raises(InputError, match="^" + message):
        ppo.Config(**{field: value})


def test_where_sensors_err_policy_and_critic_learn_from_what_they_say(name, monkeypatch):
    task, _, banks = setting(name)
    dynamics, seen, states, original = make_dynamics(name, "noise=1"), [], [], ppo.fly
    monkeypatch.setattr(ppo, "fly", lambda *args: seen.append(original(*args)) or seen[-1])
    run = ppo.begin(dynamics, task, banks, TINY, 0)
    for _ in ppo.train(run, dynamics, task, banks, TINY):
        flown = seen[-1]
        assert torch.equal(flown["state"], flown["measured"])
        assert torch.equal(flown["observation"][:, 0], task.observe(flown["state"][:, 0]))
        going = ~flown["next", "done"][:, :-1, 0]
        following = flown["next", "measured"][:, :-1]
        assert torch.equal(following[going], flown["measured"][:, 1:][going])
        states.append(flown["state"].clone())  # the collector writes over it
        onward = ~flown["next", "done"][:, -1, 0]
        ends = flown["next", "measured"][:, -1]
        assert not (run.place["state"] == ends)[onward].any()  # flights go on from where the robots truly are
    assert not torch.equal(states[-1], states[-2])
    assert run.skipped == 0
