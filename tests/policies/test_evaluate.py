"""The closed-loop evaluation: controllers whose result is known on paper, and independence of everything else."""

import itertools
import math
import time

import pandas as pd
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, exploration_type

from envs import SYSTEMS, make_dynamics, make_task
from policies import evaluate as evaluation
from policies.evaluate import Evaluation, action_time, evaluate
from policies.networks import as_actor, network_for


@pytest.fixture(params=SYSTEMS)
def name(request):
    return request.param


def constant(*action):
    """An actor that always does the same."""
    values = torch.tensor(action, dtype=torch.float64)
    return TensorDictModule(
        lambda observation: values.expand(*observation.shape[:-1], -1), in_keys=["observation"], out_keys=["action"]
    )


def falling(steps):
    """Quadrotors that hover at the start and then fall under the least thrust: -7.5 m/s^2."""
    task = make_task("quadrotor", "hover", steps=steps)
    return evaluate(constant(-1, 0, 0, 0), make_dynamics("quadrotor"), task, task.episodes(3, "test", 0).double())


def test_a_hovering_quadrotor_has_no_error():
    task = make_task("quadrotor", "hover")
    trim = constant(*task.system.trim_action)
    result = evaluate(trim, make_dynamics("quadrotor"), task, task.episodes(4, "test", 0).double())
    assert result.summary == {
        "mean": pytest.approx(0, abs=1e-9),
        "std": pytest.approx(0, abs=1e-9),
        "success": 1,
        "n": 4,
    }
    assert result.states.shape == (4, 101, 13)
    assert result.actions.shape == (4, 100, 4)


def test_the_error_of_a_falling_quadrotor_is_that_of_a_parabola():
    result = falling(steps=8)
    expected = sum(0.5 * 7.5 * (0.1 * k) ** 2 for k in range(1, 9)) / 8
    assert result.table.error.tolist() == pytest.approx([expected] * 3)
    assert result.summary["success"] == 1.0  # 2.4 m off


def test_an_episode_ends_where_it_leaves_5_m_and_stays_as_it_is_from_there_on():
    result = falling(steps=100)
    drop = result.states[:, 0, 2:3] - result.states[:, :, 2]
    end = math.ceil(math.sqrt(5 / (0.5 * 7.5)) / 0.1)
    torch.testing.assert_close(drop[0, end], torch.tensor(0.5 * 7.5 * (0.1 * end) ** 2, dtype=torch.float64))
    assert (drop[:, end:] == drop[:, end : end + 1]).all()
    assert (drop[:, end - 1] < 5).all()
    assert not result.table.success.any()
    assert result.summary["success"] == 0
    assert math.isnan(result.summary["mean"])


def test_a_robot_that_becomes_infinite_has_failed(name):
    task = make_task(name)
    result = evaluate(
        constant(*task.system.trim_action),
        WithoutNumbers(make_dynamics(name), task.steps // 4),
        task,
        task.episodes(2, "test", 0).double(),
    )
    assert not result.table.success.any()


class WithoutNumbers:
    """Dynamics that lose their numbers after some steps."""

    def __init__(self, dynamics, steps):
        self.dynamics, self.left, self.system = dynamics, steps, dynamics.system

    def __call__(self, state, action):
        self.left -= 1
        return self.dynamics(state, action) * (1.0 if self.left > 0 else math.nan)


def test_a_cart_at_rest_with_its_pole_upright_has_no_error():
    task = make_task("cartpole")
    result = evaluate(constant(0.0), make_dynamics("cartpole"), task, torch.zeros(2, 4, dtype=torch.float64))
    assert result.summary["mean"] == 0
    assert result.summary["success"] == 1


def test_a_cart_that_lets_its_pole_fall_has_failed():
    task = make_task("cartpole")
    start = torch.tensor([[0.0, 0.0, 0.05, 0.0]], dtype=torch.float64)
    result = evaluate(constant(0.0), make_dynamics("cartpole"), task, start)
    assert not result.table.success.any()
    assert result.states[0, -1, 2].abs() > task.angle_limit
    assert result.states[0, -1, 2].abs() < 2 * task.angle_limit  # held at the end, not fallen further


def test_an_aircraft_that_does_not_reach_the_target_has_failed():
    task = make_task("fixed_wing", steps=20)
    trim = constant(*task.system.trim_action)
    assert (
        evaluate(trim, make_dynamics("fixed_wing"), task, task.episodes(3, "test", 0).double()).summary["success"] == 0
    )


def test_leaving_the_5_m_once_is_a_failure_even_if_the_rest_is_perfect():
    task = make_task("quadrotor", "hover")
    episodes = task.episodes(3, "test", 0)
    states = task.start(episodes, torch.zeros(3, dtype=torch.long)).unsqueeze(1).repeat(1, 101, 1)
    states[1, 50, 1] += 4.99
    states[2, 50, 1] += 5.01
    error, success = task.score(episodes, states)
    assert success.tolist() == [True, True, False]
    torch.testing.assert_close(error, torch.tensor([0.0, 0.0499, 0.0501]), rtol=1e-4, atol=1e-6)


def test_mean_and_deviation_are_those_of_the_successful_episodes():
    table = pd.DataFrame({"episode": range(4), "error": [1.0, 3.0, 100.0, 5.0], "success": [True, True, False, True]})
    empty = torch.zeros(4, 1, 1)
    result = Evaluation(table, "error", "m", empty, empty, empty)
    assert result.summary == {"mean": 3.0, "std": pytest.approx(math.sqrt(8 / 3)), "success": 0.75, "n": 4}
    assert str(result) == "3.0000 ± 1.6330 m, success 0.75, N = 4"


@pytest.fixture
def flown(name):
    """A random policy in a target, float64, and its task and episodes."""
    task = make_task(name, steps=25)
    actor = as_actor(network_for(task, features=8, widths=(8, 8)).double())
    return actor, make_dynamics(name, "drag=0.3"), task, task.episodes(6, "test", 0).double()


def test_the_same_flight_gives_the_same_result_bit_for_bit(flown):
    one, two = evaluate(*flown), evaluate(*flown)
    assert torch.equal(one.states, two.states)
    assert one.table.equals(two.table)


def test_an_episode_does_not_depend_on_those_beside_it(flown):
    actor, dynamics, task, episodes = flown
    together = evaluate(actor, dynamics, task, episodes)
    order = torch.tensor([3, 0, 5])
    apart = evaluate(actor, dynamics, task, episodes[order])
    torch.testing.assert_close(apart.states, together.states[order], rtol=1e-9, atol=1e-9)
    alone = evaluate(actor, dynamics, task, episodes[4:5])
    torch.testing.assert_close(alone.states, together.states[4:5], rtol=1e-9, atol=1e-9)
    assert alone.table.error[0] == pytest.approx(together.table.error[4], rel=1e-9)


def test_the_states_are_those_that_the_actions_lead_to(flown):
    actor, dynamics, task, episodes = flown
    result = evaluate(actor, dynamics, task, episodes)
    assert torch.equal(result.states[:, 0], task.start(episodes, torch.zeros(6, dtype=torch.long)))
    torch.testing.assert_close(result.states[:, 1], dynamics(result.states[:, 0], result.actions[:, 0]))
    torch.testing.assert_close(result.states[:, 3], dynamics(result.states[:, 2], result.actions[:, 2]))


def test_policies_fly_without_exploration_and_without_gradient(flown):
    actor, dynamics, task, episodes = flown
    modes = []

    def watched(tensordict):
        modes.append((exploration_type(), torch.is_grad_enabled()))
        return actor(tensordict)

    result = evaluate(watched, dynamics, task, episodes)
    assert set(modes) == {(ExplorationType.DETERMINISTIC, False)}
    assert not result.states.requires_grad


def test_as_many_episodes_as_the_published_tables_use(name):
    wanted = {"cartpole": 50, "quadrotor": 50, "fixed_wing": 30}[name]
    assert len(evaluation.test_episodes(make_task(name))) == wanted
    assert len(evaluation.test_episodes(make_task(name), 7)) == 7


def test_episodes_of_the_test_are_never_trained_on(name):
    task = make_task(name)
    test = {tuple(row.flatten().tolist()) for row in evaluation.test_episodes(task, 50)}
    assert test == {tuple(row.flatten().tolist()) for row in task.episodes(50, "test", 0)}
    for seed in range(3):
        for split in ("train", "validation"):
            assert not test & {tuple(row.flatten().tolist()) for row in task.episodes(100, split, seed)}


def test_the_seed_draws_other_episodes(name):
    task = make_task(name)
    assert torch.equal(evaluation.test_episodes(task, 5, seed=1), evaluation.test_episodes(task, 5, seed=1))
    assert not torch.equal(evaluation.test_episodes(task, 5), evaluation.test_episodes(task, 5, seed=1))


def test_the_first_calls_warm_up_and_are_not_timed():
    task, calls = make_task("cartpole"), []
    actor = as_actor(network_for(task))

    def slow_at_first(tensordict):
        calls.append(None)
        if len(calls) <= 20:
            time.sleep(0.05)
        return actor(tensordict)

    spent = action_time(slow_at_first, make_dynamics("cartpole"), task, calls=9)
    assert len(calls) == 29
    assert spent["median_ms"] < 50


def test_the_time_of_an_action_is_taken_on_one_thread_which_is_undone(name):
    task = make_task(name)
    threads, seen = torch.get_num_threads(), []
    actor = as_actor(network_for(task))

    def watched(tensordict):
        seen.append((torch.get_num_threads(), tensordict.batch_size))
        return actor(tensordict)

    torch.set_num_threads(2)
    try:
        spent = action_time(watched, make_dynamics(name), task, calls=20)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert set(seen) == {(1, (1,))}
    assert 0 < spent["median_ms"] <= spent["p99_ms"] < 1000


def test_an_action_is_timed_in_flight_and_the_next_episode_follows_where_one_ends(name):
    task = make_task(name)
    step, seen = make_dynamics(name), []
    hover = torch.tensor([task.system.trim_action])

    def resting(tensordict):
        seen.append(tensordict.clone())
        return tensordict.set("action", hover)

    action_time(resting, step, task, calls=task.steps)
    assert [td["step"].item() for td in seen[:3]] == [0, 1, 2]
    assert torch.allclose(seen[1]["state"], step(seen[0]["state"], hover))
    later = [td for td in seen if td["episode"].item() == 1]
    assert later[0]["step"].item() == 0
    assert torch.equal(
        later[0]["state"], task.start(task.episodes(20, "validation", 0)[1:2], torch.zeros(1, dtype=int))
    )


def test_a_policy_is_told_which_rows_have_ended_and_all_ended_ends_the_evaluation():
    task = make_task("fixed_wing")
    trim, calls = torch.tensor(task.system.trim_action), []

    def level(tensordict):
        calls.append(tensordict["done"].squeeze(-1).clone())
        return tensordict.set("action", trim.expand(len(tensordict), -1).contiguous())

    result = evaluate(level, make_dynamics("fixed_wing"), task, task.episodes(3, "test", 0))
    assert not calls[0].any()
    assert all((after | ~before).all() for before, after in itertools.pairwise(calls))
    assert len(calls) < task.steps
    assert result.states.shape == (3, task.steps + 1, 13)
    assert result.actions.shape == (3, task.steps, 4)


class Watching:
    """An actor that always does the same, and remembers what it saw."""

    def __init__(self, *action):
        self.action, self.seen = torch.tensor(action, dtype=torch.float64), []

    def __call__(self, tensordict):
        self.seen.append(tensordict["measured"])
        return tensordict.set("action", self.action.expand(*tensordict.batch_size, -1))


def test_a_policy_is_scored_by_where_it_was_not_by_what_its_sensors_said(name):
    task = make_task(name, steps=30)
    episodes, trim = task.episodes(5, "test", 0).double(), task.system.trim_action
    exact = evaluate(constant(*trim), make_dynamics(name, "drag=0.3"), task, episodes)
    noisy = evaluate(Watching(*trim), make_dynamics(name, "drag=0.3 noise=10"), task, episodes)
    assert torch.equal(noisy.states, exact.states)
    assert noisy.table.equals(exact.table)


def test_policies_that_are_compared_have_the_same_noise(name):
    task = make_task(name, steps=30)
    episodes, trim = task.episodes(100, "test", 0).double(), task.system.trim_action
    watchers = [Watching(*(entry + more for entry in trim)) for more in (0.0, 0.0, 0.001)]
    dynamics = make_dynamics(name, "noise=1")
    flights = [evaluate(watcher, dynamics, task, episodes) for watcher in watchers]
    assert all(torch.equal(a, b) for a, b in zip(*(watcher.seen for watcher in watchers[:2]), strict=True))

    def errors(number, step):
        states = flights[number].states[:, step], watchers[number].seen[step]
        x, y = (task.system.State(*part.unbind(-1)) for part in states)
        return torch.stack(task.system.difference(x, y), -1)

    for step in (0, 5):
        torch.testing.assert_close(errors(2, step), errors(0, step), rtol=0, atol=1e-9)
        expected = torch.tensor(dynamics.noise, dtype=torch.float64)
        assert ((errors(0, step).std(0) / expected - 1).abs() < 5 / math.sqrt(200)).all()
    assert not torch.equal(errors(0, 0), errors(0, 5))


def test_an_action_is_timed_on_what_sensors_say():
    task, dynamics = make_task("quadrotor", "hover"), make_dynamics("quadrotor", "noise=1")
    flight, still = evaluation.FlightForTiming(dynamics, task), torch.tensor([task.system.trim_action])
    for _ in range(3):
        state, seen = flight.state, flight.seen()
        assert 0 < (seen["state"] - state).abs().max() < 0.3
        assert torch.equal(seen["observation"], task.observe(seen["state"]))
        flight.advance({"action": still})
    assert torch.equal(flight.state[:, :3], torch.zeros(1, 3)) or flight.state[:, :3].abs().max() < 1e-5
