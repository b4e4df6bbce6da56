"""Analytic policy gradient: the gradient is exact, training works, and a run can be repeated and continued exactly."""

import copy
import io
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from adapt.residual import FitSettings, fit_residual
from adapt.transitions import Transitions
from envs import SYSTEMS, make_dynamics, make_task
from envs.env import TrackingEnv
from envs.errors import InputError
from policies import apg, evaluate, modes
from policies.networks import as_actor, network_for

QUICK = {
    "cartpole": apg.APGConfig(updates=100, batch=32, width=32, learning_rate=2e-2, curriculum=0.3, episodes=50),
    "quadrotor": apg.APGConfig(updates=200, batch=64, width=64, learning_rate=1e-2, curriculum=0.3, episodes=200),
}
TINY = apg.APGConfig(updates=8, batch=4, width=8, episodes=6, curriculum=0.6)


@pytest.fixture(params=SYSTEMS)
def name(request):
    return request.param


@pytest.fixture
def quadrotor():
    task = make_task("quadrotor")
    return task, make_dynamics("quadrotor"), task.episodes(5, "train", 0)


@lru_cache
def tiny_setting(name):
    """A task with a short horizon, its dynamics, and few training episodes at each speed."""
    task = make_task(name, horizon=3)
    return task, make_dynamics(name), {seed: apg.training_banks(task, TINY, seed) for seed in (0, 1)}


def tiny_network(task):
    return network_for(task, features=8, widths=(8, 8)).double()


def situation(task, n=3):
    """States beside the reference and the references ahead of them, float64."""
    episodes, step = task.episodes(n, "train", 0).double(), torch.arange(n) * 3
    state = task.start(episodes, step)
    state = state + 0.05 * torch.randn(state.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return state, task.reference(episodes, step, state)


def learned_dynamics(name, kind):
    """A residual that was fitted to random transitions of a changed robot."""
    source, generator = make_dynamics(name), torch.Generator().manual_seed(0)
    task = make_task(name)
    state = task.start(task.episodes(60, "train", 1), torch.zeros(60, dtype=torch.long)).double()
    state[:, 7 if state.shape[1] > 4 else 1] += torch.randn(60, generator=generator, dtype=torch.float64)
    action = torch.rand(60, len(source.system.Action._fields), generator=generator, dtype=torch.float64) - 0.5
    following = make_dynamics(name, "drag=0.5 push=0.4")(state, action)
    names = (source.system.State._fields, source.system.Action._fields)
    flown = Transitions(state, action, following, torch.arange(60) // 6, source.dt, name, *names)
    residual, _ = fit_residual(flown, source, kind, settings=FitSettings(steps=50))
    assert not torch.allclose(residual(state, action), source(state, action), atol=1e-3)
    return residual


@pytest.mark.parametrize("model", ["source", "acceleration", "state"])
def test_the_gradient_of_a_plans_cost_is_that_of_finite_differences(name, model):
    task = make_task(name)
    dynamics = make_dynamics(name, "drag=0.3") if model == "source" else learned_dynamics(name, model)
    network, (state, reference) = tiny_network(task), situation(task)
    observation, window = task.observe(state), task.window(state, reference)

    def cost():
        return modes.plan_cost(dynamics, task, state, network(observation, window), reference).mean()

    parameters = list(network.parameters())
    gradients = torch.autograd.grad(cost(), parameters)
    generator, h = torch.Generator().manual_seed(0), 1e-6
    for _ in range(4):
        direction = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
        slope = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
        values = []
        for shift in (h, -2 * h):
            with torch.no_grad():
                for p, d in zip(parameters, direction, strict=True):
                    p.add_(shift * d)
                values.append(cost())
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p.add_(h * d)
        torch.testing.assert_close(slope, (values[0] - values[1]) / (2 * h), rtol=1e-5, atol=1e-7)


def test_the_gradient_is_that_through_a_rollout_of_the_same_actions(name):
    task = make_task(name)
    episodes, dynamics, network = task.episodes(3, "train", 0).double(), make_dynamics(name), tiny_network(task)
    rows, step = torch.arange(3), torch.zeros(3, dtype=torch.long)
    state = task.start(episodes, step)
    reference = task.reference(episodes, step, state)
    parameters = list(network.parameters())
    plan = 0.1 * network(task.observe(state), task.window(state, reference))  # gentle: a failure would be reset
    cost = modes.plan_cost(dynamics, task, state, plan, reference).sum()
    expected = torch.autograd.grad(cost, parameters, retain_graph=True)

    env = TrackingEnv(dynamics, task, episodes, (3,))
    play = TensorDictModule(lambda at: plan[rows, at.squeeze(-1)], in_keys=["step"], out_keys=["action"])
    start = env.reset(TensorDict({"episode": rows.unsqueeze(-1)}, batch_size=3))
    flown = env.rollout(task.horizon, play, tensordict=start, auto_reset=False, break_when_any_done=False)
    through_env = task.cost(flown["next", "state"], flown["action"], reference).sum()
    torch.testing.assert_close(through_env, cost)
    for ours, theirs in zip(torch.autograd.grad(through_env, parameters), expected, strict=True):
        assert theirs.abs().max() > 0
        torch.testing.assert_close(ours, theirs)


def finished(name, config, seed=0):
    """A short training run at its end, with the metrics of every update."""
    task, dynamics, banks = tiny_setting(name)
    run = apg.begin(dynamics, task, banks[seed], config, seed)
    return run, list(apg.train(run, dynamics, task, banks[seed], config))


@lru_cache
def uninterrupted(name, optimizer):
    return finished(name, replace(TINY, optimizer=optimizer, learning_rate=1e-3))


@pytest.mark.parametrize("name", ["cartpole", pytest.param("quadrotor", marks=pytest.mark.slow)])
def test_within_seconds_training_makes_the_error_a_tenth_of_that_of_random_weights(name):
    task, dynamics, config = make_task(name), make_dynamics(name), QUICK[name]
    validation = task.episodes(20, "validation", 0)
    banks = apg.training_banks(task, config, 0)
    run = apg.begin(dynamics, task, banks, config, 0)
    before = evaluate.evaluate(as_actor(run.network), dynamics, task, validation).table
    history = list(apg.train(run, dynamics, task, banks, config))
    after = evaluate.evaluate(as_actor(run.network), dynamics, task, validation).table
    assert after.success.all()
    assert after.error.mean() < 0.1 * before.error.mean()
    assert len(history) == config.updates == run.update
    assert run.skipped == 0


def weights_of(run):
    return torch.cat([value.flatten() for value in run.network.state_dict().values()])


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(name):
    one, history = finished(name, TINY)
    torch.manual_seed(99)  # global state must not matter
    two, again = finished(name, TINY)
    other, _ = finished(name, TINY, seed=1)
    assert torch.equal(weights_of(one), weights_of(two))
    assert history == again
    assert not torch.equal(weights_of(one), weights_of(other))


def test_training_leaves_the_global_random_state_alone():
    before = torch.get_rng_state()
    finished("cartpole", TINY)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(("optimizer", "stopped_at"), [("adam", 3), ("adam", 6), ("sgd", 4)])
def test_a_resumed_run_ends_bit_for_bit_where_an_uninterrupted_one_does(name, optimizer, stopped_at):
    config = replace(TINY, optimizer=optimizer, learning_rate=1e-3)
    whole, history = uninterrupted(name, optimizer)
    task, dynamics, banks = tiny_setting(name)
    banks = banks[0]
    begun = apg.begin(dynamics, task, banks, config, 0)
    updates = apg.train(begun, dynamics, task, banks, config)
    first = [next(updates) for _ in range(stopped_at)]
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    for _ in updates:  # what comes after must not reach into what was saved
        pass
    again = apg.begin(dynamics, task, banks, config, 0)
    again.load_state_dict(torch.load(file, weights_only=True), banks, config, task)
    rest = list(apg.train(again, dynamics, task, banks, config))
    assert first + rest == history
    assert torch.equal(weights_of(again), weights_of(whole))
    assert torch.equal(again.flight.state, whole.flight.state)
    assert torch.equal(again.generator.get_state(), whole.generator.get_state())


def test_the_threshold_rises_in_each_speed_and_starts_again_in_the_next():
    task, config = make_task("quadrotor"), apg.APGConfig(updates=600, curriculum=0.5)
    table = {0: (0.1, 0), 50: (1.05, 0), 100: (0.1, 1), 175: (0.1 + 1.9 * 0.75, 1), 200: (0.1, 2), 299: (1.981, 2)}
    for update, (threshold, bank) in table.items():
        assert apg.stage(config, task, 3, update) == (pytest.approx(threshold), bank)
    for update in (300, 301, 599):
        assert apg.stage(config, task, 3, update) == (2.0, 2)


def test_without_a_curriculum_the_last_threshold_and_full_speed_hold_at_once():
    task = make_task("quadrotor")
    for update in range(1, 5):
        assert apg.stage(apg.APGConfig(updates=10, curriculum=0.0), task, 3, update) == (2.0, 2)


def test_the_threshold_can_rise_alone_at_full_speed_and_the_speed_at_the_last_threshold():
    task, config = make_task("quadrotor"), apg.APGConfig(updates=600, curriculum=0.5)  # 300 updates of curriculum
    threshold = [apg.stage(config, task, 3, update, "threshold") for update in (0, 150, 299, 300)]
    assert threshold == [(0.1, 2), (pytest.approx(1.05), 2), (pytest.approx(2.0, abs=0.01), 2), (2.0, 2)]
    speed = [apg.stage(config, task, 3, update, "speed") for update in (0, 99, 100, 200, 300)]
    assert speed == [(2.0, 0), (2.0, 0), (2.0, 1), (2.0, 2), (2.0, 2)]


def test_training_raises_what_it_is_told_to():
    task, config = make_task("quadrotor"), replace(TINY, updates=9, curriculum=1.0, ramps="speed")
    banks = apg.training_banks(task, config, 0)
    run = apg.begin(make_dynamics("quadrotor"), task, banks, config, 0)
    rows = list(apg.train(run, make_dynamics("quadrotor"), task, banks, config))
    assert [(row["threshold"], row["stage"]) for row in rows] == [(2.0, update // 3) for update in range(9)]


def test_training_follows_the_curriculum():
    config = replace(TINY, updates=12, curriculum=0.5)
    _, history = finished("quadrotor", config)
    assert [row["stage"] for row in history] == [0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2]
    assert [row["threshold"] for row in history[:6]] == pytest.approx([0.1, 1.05] * 3)


def test_the_banks_are_the_same_training_paths_at_each_speed():
    task = make_task("quadrotor")
    slow, middle, full = apg.training_banks(task, replace(TINY, episodes=3), 5)
    assert torch.equal(full, task.episodes(3, "train", 5))
    torch.testing.assert_close(slow[:, ::2, :3][:, :20], full[:, :20, :3], rtol=0, atol=1e-4)
    assert (
        slow[:, :, 3:6].norm(dim=-1).max() < middle[:, :, 3:6].norm(dim=-1).max() < full[:, :, 3:6].norm(dim=-1).max()
    )


def test_the_learning_rate_rises_linearly_and_falls_as_a_cosine():
    config = apg.APGConfig(updates=1000, learning_rate=2.0, warmup=0.1, final_rate=0.25)
    assert apg.learning_rate(config, 0) == pytest.approx(2 / 101)
    assert apg.learning_rate(config, 49) == pytest.approx(2 * 50 / 101)
    assert apg.learning_rate(config, 100) == pytest.approx(2.0)
    assert apg.learning_rate(config, 550) == pytest.approx((2 + 0.5) / 2)
    assert apg.learning_rate(config, 325) == pytest.approx(2 * (0.25 + 0.75 * (1 + 2**-0.5) / 2))
    assert apg.learning_rate(config, 999) == pytest.approx(0.5, rel=1e-4)


def test_the_first_step_is_the_learning_rate_times_the_gradient_scaled_to_the_clip():
    task, dynamics = make_task("cartpole"), make_dynamics("cartpole")
    config = replace(TINY, optimizer="sgd", clip=1e-2, learning_rate=0.5, warmup=0.0)
    banks = apg.training_banks(task, config, 0)
    run = apg.begin(dynamics, task, banks, config, 0)
    before = weights_of(run)
    metrics = next(apg.train(run, dynamics, task, banks, config))
    assert metrics["gradient_norm"] > 0.1
    assert float((weights_of(run) - before).norm()) == pytest.approx(0.5 * 1e-2, rel=1e-3)


def moved_by(metres):
    """Dynamics that shift a quadrotor along x in every control period and do nothing else."""

    def dynamics(state, action):
        state = state.clone()
        state[:, 0] += metres
        return state

    return dynamics


def flight_at(task, dynamics, episodes, step):
    flight = apg.Flight(task, dynamics, episodes, 4, torch.Generator().manual_seed(0))
    flight.row, flight.step = torch.tensor([0, 1, 2, 3]), torch.full((4,), step)
    flight.state = task.start(episodes[flight.row], flight.step)
    return flight


def test_who_strays_beyond_the_threshold_is_put_back_on_the_reference_of_the_same_episode(quadrotor):
    task, _, episodes = quadrotor
    for metres in (3.0, float("nan")):
        flight = flight_at(task, moved_by(metres), episodes, 10)
        start = flight.state.clone()
        distance = task.distance(episodes[:4], torch.full((4,), 11), moved_by(metres)(start, None))
        flight.advance(torch.zeros(4, 4), 5.0 if metres == 3.0 else 2.0, 0.0)
        if metres == 3.0:
            assert (distance < 5).all()
            torch.testing.assert_close(flight.state, moved_by(3.0)(start, None))  # inside the threshold: left alone
            flight = flight_at(task, moved_by(metres), episodes, 10)
            assert float(flight.advance(torch.zeros(4, 4), 1.0, 0.0)) == 1.0
            assert flight.row.tolist() == [0, 1, 2, 3]
            assert flight.step.tolist() == [11] * 4
        assert torch.equal(flight.state, task.start(episodes[flight.row], flight.step))


def test_whoever_is_at_the_end_or_has_failed_begins_another_episode(quadrotor):
    task, _, episodes = quadrotor
    for metres, step in ((0.0, task.steps - 1), (6.0, 10)):
        flight = flight_at(task, moved_by(metres), episodes, step)
        flight.advance(torch.zeros(4, 4), 100.0, 0.0)
        assert flight.step.tolist() == [0] * 4
        assert flight.row.tolist() != [0, 1, 2, 3]
        assert torch.equal(flight.state, task.start(episodes[flight.row], flight.step))


def test_a_fixed_wing_that_has_arrived_begins_another_episode():
    task = make_task("fixed_wing")
    episodes = task.episodes(5, "train", 0)
    past = lambda state, action: state + torch.eye(13)[0] * 49  # noqa: E731
    flight = flight_at(task, past, episodes, 10)
    flight.advance(torch.zeros(4, 4), 100.0, 0.0)
    assert flight.step.tolist() == [0] * 4


def test_a_faster_bank_is_entered_on_its_own_reference_at_the_same_step(quadrotor):
    task, dynamics, episodes = quadrotor
    flight = flight_at(task, dynamics, episodes, 7)
    slower = task.episodes(5, "train", 0, speed=0.5)
    flight.switch(slower)
    assert flight.step.tolist() == [7] * 4
    assert torch.equal(flight.state, task.start(slower[:4], torch.full((4,), 7)))


def test_data_are_flown_by_the_policy_and_noise_never_leaves_the_bounds_of_an_action(quadrotor):
    task, dynamics, episodes = quadrotor
    flown = []

    def watched(state, action):
        flown.append(action)
        return dynamics(state, action)

    flight = flight_at(task, watched, episodes, 0)
    action = torch.tensor([[1.0, -1.0, 0.2, 0.0]]).expand(4, 4)
    flight.advance(action, 100.0, 0.0)
    assert torch.equal(flown[0], action)
    for _ in range(20):
        flight.advance(action, 100.0, 0.5)
    noisy = torch.cat(flown[1:])
    assert noisy.abs().max() <= 1
    assert float(noisy[:, 3].std()) == pytest.approx(0.5, rel=0.25)


class FailsOnce:
    """Dynamics whose prediction is not a number in one call."""

    def __init__(self, dynamics, call):
        self.dynamics, self.left = dynamics, call

    def __call__(self, state, action):
        self.left -= 1
        return self.dynamics(state, action) * (float("nan") if self.left == 0 else 1.0)


def test_an_update_without_a_finite_gradient_is_left_out_and_counted(name):
    (task, dynamics, banks), config = tiny_setting(name), replace(TINY, warmup=0.0)
    banks = banks[0]
    run = apg.begin(dynamics, task, banks, config, 0)
    weights, moments = [weights_of(run)], []
    for metrics in apg.train(run, FailsOnce(dynamics, 2 * task.horizon + 2), task, banks, config):
        weights.append(weights_of(run))
        moments.append(copy.deepcopy(run.optimizer.state_dict()["state"][0]["exp_avg"]))
        assert torch.isfinite(weights[-1]).all()
        if metrics["update"] == 3:
            assert not metrics["gradient_norm"] < float("inf")
            assert torch.equal(weights[-1], weights[-2])
            assert torch.equal(moments[-1], moments[-2])
        else:
            assert not torch.equal(weights[-1], weights[-2])
        assert metrics["skipped"] == int(metrics["update"] >= 3)
    assert torch.isfinite(run.flight.state).all()
    assert run.skipped == 1


def test_a_flight_that_is_not_finite_is_put_back_and_training_goes_on():
    (task, dynamics, banks), config = tiny_setting("quadrotor"), TINY
    banks = banks[0]
    run = apg.begin(dynamics, task, banks, config, 0)
    run.flight.dynamics = FailsOnce(dynamics, 2)
    history = list(apg.train(run, dynamics, task, banks, config))
    assert run.skipped == 0
    assert history[1]["resets"] == 1.0
    assert torch.isfinite(run.flight.state).all()


def test_the_papers_own_settings_run(name):
    paper = apg.PRESETS["paper"]
    config = replace(paper, updates=6, episodes=6)
    run, history = finished(name, config)
    assert (paper.optimizer, paper.learning_rate, paper.batch, paper.width) == ("sgd", 8e-5, 8, None)
    assert run.optimizer.param_groups[0]["momentum"] == 0.9
    assert run.optimizer.param_groups[0]["lr"] == pytest.approx(8e-5)  # constant
    assert len(history) == 6
    assert run.skipped == 0


def test_every_system_has_tuned_settings():
    assert set(SYSTEMS) <= set(apg.PRESETS)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("updates", 0, "--updates 0: expected more than 0"),
        ("batch", -1, "--batch -1: expected more than 0"),
        ("learning_rate", float("nan"), "--learning-rate nan: expected more than 0"),
        ("learning_rate", float("inf"), "--learning-rate inf: expected more than 0"),
        ("curriculum", 1.5, "--curriculum 1.5: expected between 0 and 1"),
        ("ramps", "up", "--ramps up: expected one of both, threshold, speed"),
        ("exploration", -0.1, "--exploration -0.1: expected between 0 and 1"),
        ("exploration", float("nan"), "--exploration nan: expected between 0 and 1"),
        ("clip", 0.0, "APGConfig.clip 0.0: expected more than 0"),
        ("episodes", 0, "APGConfig.episodes 0: expected more than 0"),
        ("warmup", 2.0, "APGConfig.warmup 2.0: expected between 0 and 1"),
        ("final_rate", -1.0, "APGConfig.final_rate -1.0: expected between 0 and 1"),
        ("optimizer", "lbfgs", "APGConfig.optimizer 'lbfgs': expected one of adam, sgd"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(field, value, message):
    with pytest.raises(InputError, match="^" + message):
        apg.APGConfig(**{field: value})
