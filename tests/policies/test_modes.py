"""The modes of APG: the chain of gradients is exact, they share one cost, and a memory belongs to its flight."""

import copy
import io
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import InitTracker
from torchrl.envs.utils import step_mdp

from adapt.finetuning import finetune
from adapt.flying import collect
from envs import SYSTEMS, make_dynamics, make_task
from envs.env import TrackingEnv
from envs.errors import InputError
from policies import apg, modes
from policies.checkpoints import Policy, load_policy, save_policy
from policies.evaluate import action_time, evaluate
from policies.networks import MODES, as_actor, network_for

CALLED_AGAIN = ("autoregressive", "recurrent")  # modes whose network is called at each step of the horizon
TINY = apg.APGConfig(updates=8, batch=4, width=8, episodes=6, curriculum=0.6)
QUICK = apg.APGConfig(updates=100, batch=32, width=32, learning_rate=2e-2, curriculum=0.3, episodes=50)


@pytest.fixture(params=MODES)
def mode(request):
    return request.param


@pytest.fixture(params=SYSTEMS)
def name(request):
    return request.param


def tiny_network(task, mode):
    return network_for(task, features=8, widths=(8, 8), mode=mode).double()


def flight_of(task, dynamics, network, size=3, seed=0):
    """Flights of float64 beside their reference, with something in a memory."""
    generator = torch.Generator().manual_seed(seed)
    episodes = task.episodes(4, "train", 0).double()
    flight = apg.Flight(task, dynamics, episodes, size, generator, network.config.memory)
    flight.state = flight.state + 0.05 * torch.randn(flight.state.shape, generator=generator, dtype=torch.float64)
    if flight.hidden is not None:
        flight.hidden = 0.5 * torch.randn(flight.hidden.shape, generator=generator, dtype=torch.float64)
    return flight


def gradient(network, cost):
    """Of a cost over all weights, in one vector."""
    parts = torch.autograd.grad(cost, list(network.parameters()), retain_graph=True)
    return torch.cat([part.flatten() for part in parts])


def shifted(network, direction):
    """A copy whose weights are moved."""
    moved, used = copy.deepcopy(network), 0
    with torch.no_grad():
        for weights in moved.parameters():
            weights += direction[used : used + weights.numel()].view_as(weights)
            used += weights.numel()
    return moved


def blind_to_its_actions(network, dynamics, task, flight):
    """Cost of the next T states where each is taken as given by the call that acts in it: no chain through calls."""
    (state, reference), hidden, cost = flight.look(), flight.hidden, 0
    for ahead in range(task.horizon):
        given = state.detach()
        plan, hidden = network.recall(task.observe(given), task.window(given, flight.ahead(ahead, given)), hidden)
        state = dynamics(state, plan[:, 0])
        cost = cost + task.cost(state, plan[:, 0], reference[:, ahead])
    return cost


@pytest.mark.parametrize("mode", CALLED_AGAIN)
def test_the_gradient_is_that_of_finite_differences_through_the_chain_of_calls(name, mode):
    task, dynamics = make_task(name, horizon=4), make_dynamics(name, "drag=0.3")
    network = tiny_network(task, mode)
    with torch.no_grad():
        for weights in network.parameters():
            weights *= 2  # an action that answers strongly to where the ones before have led
    flight = flight_of(task, dynamics, network)
    exact = gradient(network, modes.look_ahead(network, dynamics, task, flight).cost.mean())
    without_chain = blind_to_its_actions(network, dynamics, task, flight).mean()
    torch.testing.assert_close(without_chain, modes.look_ahead(network, dynamics, task, flight).cost.mean())
    detached = gradient(network, without_chain)
    generator, h = torch.Generator().manual_seed(0), 1e-6
    for _ in range(3):
        direction = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            above, below = (
                modes.look_ahead(shifted(network, sign * h * direction), dynamics, task, flight).cost.mean()
                for sign in (1, -1)
            )
        difference = (above - below) / (2 * h)
        torch.testing.assert_close(exact @ direction, difference, rtol=1e-5, atol=1e-7)
    assert (detached - exact).norm() > 1e-3 * exact.norm()


@pytest.mark.parametrize("mode", CALLED_AGAIN)
def test_the_actions_of_a_horizon_are_those_of_a_flight_and_cost_what_a_plan_of_them_costs(name, mode):
    """The environment, which knows nothing of training, meets the same states when the actor flies in it."""
    task, dynamics = make_task(name, horizon=5), make_dynamics(name)
    network = tiny_network(task, mode)
    flight = apg.Flight(task, dynamics, task.episodes(4, "train", 0).double(), 3, torch.Generator().manual_seed(0))
    flight.step = torch.zeros_like(flight.step)
    flight.state = task.start(flight.episodes[flight.row], flight.step)
    ahead = modes.look_ahead(network, dynamics, task, flight)
    env = TrackingEnv(dynamics, task, flight.episodes, (3,))
    start = env.reset(TensorDict({"episode": flight.row.unsqueeze(-1)}, batch_size=3))
    flown = env.rollout(5, as_actor(network), tensordict=start, auto_reset=False, break_when_any_done=False)
    state, reference = flight.look()
    torch.testing.assert_close(flown["action"][:, 0], ahead.action)
    torch.testing.assert_close(modes.plan_cost(dynamics, task, state, flown["action"], reference), ahead.cost)
    if mode == "recurrent":
        torch.testing.assert_close(flown["next", "hidden"][:, 0], ahead.hidden)


def test_with_a_horizon_of_one_the_cost_pulls_at_the_first_action_alike_in_all_modes(name, mode):
    task, dynamics = make_task(name, horizon=1), make_dynamics(name)
    network = tiny_network(task, mode)
    flight = flight_of(task, dynamics, network)
    state, reference = flight.look()
    ahead = modes.look_ahead(network, dynamics, task, flight)
    action = ahead.action.detach().requires_grad_()
    cost = task.cost(dynamics(state, action), action, reference[:, 0])
    torch.testing.assert_close(ahead.cost, cost)
    pull = torch.autograd.grad(cost.sum(), action)[0]
    expected = gradient(network, (pull * ahead.action).sum())  # the chain rule behind the first action
    torch.testing.assert_close(gradient(network, ahead.cost.sum()), expected)


def test_with_a_horizon_of_one_a_concurrent_and_an_autoregressive_network_are_the_same(name):
    task, dynamics = make_task(name, horizon=1), make_dynamics(name)
    one, other = (tiny_network(task, mode) for mode in ("concurrent", "autoregressive"))
    other.load_state_dict(one.state_dict())
    flight = flight_of(task, dynamics, one)
    gradients = [gradient(n, modes.look_ahead(n, dynamics, task, flight).cost.mean()) for n in (one, other)]
    torch.testing.assert_close(*gradients)
    assert gradients[0].norm() > 0


def test_a_longer_horizon_sums_the_same_cost_over_more_steps(mode):
    """A robot at rest on a reference at rest costs nothing; at a constant distance, as much at each step."""
    task = make_task("quadrotor", "hover", horizon=6)
    network = tiny_network(task, mode)
    with torch.no_grad():
        network.head.weight.zero_()
        network.head.bias.copy_(torch.tensor(task.system.trim_action).atanh().repeat(network.config.planned))
    flight = flight_of(task, make_dynamics("quadrotor"), network)
    flight.state = task.start(flight.episodes[flight.row], flight.step)
    flight.state[:, 0] += 0.3
    cost = modes.look_ahead(network, make_dynamics("quadrotor"), task, flight).cost
    torch.testing.assert_close(cost, torch.full((3,), 6 * 10 * 0.3**2, dtype=torch.float64))


def test_a_memory_is_carried_on_and_empty_where_an_episode_begins_or_is_put_back():
    task, dynamics = make_task("quadrotor"), make_dynamics("quadrotor")
    network = tiny_network(task, "recurrent")
    flight = flight_of(task, dynamics, network, size=4)
    rows = flight.episodes[flight.row]
    flight.step = torch.tensor([5, 5, task.steps - 1, 5])
    flight.state = task.start(rows, flight.step)
    flight.state[1, 0] += 3.0  # strays
    flight.state[3, 0] += 6.0  # has failed
    ahead = modes.look_ahead(network, dynamics, task, flight)
    flight.advance(ahead.action.detach(), 2.0, 0.0, ahead.hidden)
    assert torch.equal(flight.hidden[0], ahead.hidden[0])
    assert ahead.hidden[1:].abs().sum((-1, -2)).min() > 0
    assert not flight.hidden[1:].any()
    assert not flight.hidden.requires_grad
    flight.switch(flight.episodes)
    assert not flight.hidden.any()


def test_training_brings_the_memory_of_each_flight_along_and_detaches_it():
    """Two updates that change no weights: the memory after the second is that of two calls in the flown states."""
    task, dynamics = make_task("cartpole"), make_dynamics("cartpole")
    config = replace(TINY, mode="recurrent", optimizer="sgd", learning_rate=1e-30, exploration=0.0, curriculum=0.0)
    banks = apg.training_banks(task, config, 0)
    run = apg.begin(dynamics, task, banks, config, 0)
    run.flight.step = torch.full_like(run.flight.step, 3)
    with torch.no_grad():
        run.network.head.weight.mul_(0.1)  # gentle, and near the goal: nobody strays
    run.flight.state = 0.1 * run.flight.state
    updates, hidden = apg.train(run, dynamics, task, banks, config), None
    for _ in range(2):
        state, reference = run.flight.look()
        with torch.no_grad():
            _, hidden = run.network.recall(task.observe(state), task.window(state, reference), hidden)
        next(updates)
        torch.testing.assert_close(run.flight.hidden, hidden)
        assert not run.flight.hidden.requires_grad


def test_what_a_policy_remembers_matters_and_belongs_to_its_own_row():
    task = make_task("quadrotor")
    network = tiny_network(task, "recurrent")
    flight = flight_of(task, make_dynamics("quadrotor"), network)
    state, reference = flight.look()
    seen = task.observe(state), task.window(state, reference)
    plan, hidden = network.recall(*seen, flight.hidden)
    assert plan.shape == (3, 1, 4)
    assert hidden.shape == (3, 2, 8)
    assert not torch.allclose(plan, network(*seen))
    torch.testing.assert_close(network(*seen), network.recall(*seen, torch.zeros_like(hidden))[0])
    other = flight.hidden.clone()
    other[1] = 0
    again, _ = network.recall(*seen, other)
    torch.testing.assert_close(again[[0, 2]], plan[[0, 2]])
    assert not torch.allclose(again[1], plan[1])


def test_the_memory_is_an_lstm_that_adds_to_what_the_trunk_makes():
    """Hochreiter and Schmidhuber (1997) with a forget gate, written out."""
    task = make_task("cartpole")
    network = tiny_network(task, "recurrent")
    flight = flight_of(task, make_dynamics("cartpole"), network)
    observation = task.observe(flight.state)
    features = network.state_layer(observation).tanh()
    for layer in network.trunk:
        features = layer(features).tanh()
    output, cell = flight.hidden.unbind(1)
    gates = features @ network.cell.weight_ih.T + network.cell.bias_ih
    gates = gates + output @ network.cell.weight_hh.T + network.cell.bias_hh
    enter, forget, new, leave = gates.chunk(4, -1)
    cell = forget.sigmoid() * cell + enter.sigmoid() * new.tanh()
    output = leave.sigmoid() * cell.tanh()
    plan, hidden = network.recall(observation, task.window(flight.state, flight.look()[1]), flight.hidden)
    torch.testing.assert_close(hidden, torch.stack((output, cell), 1))
    torch.testing.assert_close(plan[:, 0], network.head(features + output).tanh())


@pytest.fixture
def recurrent():
    """A recurrent policy of the quadrotor, its task and dynamics."""
    task = make_task("quadrotor", steps=12)
    return network_for(task, features=8, widths=(8, 8), mode="recurrent"), task, make_dynamics("quadrotor")


def by_hand(network, dynamics, task, episode, steps):
    """Actions (steps, m) of one flight from the start of an episode, the memory in a variable."""
    hidden, state, actions = None, task.start(episode, torch.zeros(1, dtype=torch.long)), []
    for step in range(steps):
        reference = task.reference(episode, torch.tensor([step]), state)
        with torch.no_grad():
            plan, hidden = network.recall(task.observe(state), task.window(state, reference), hidden)
        actions.append(plan[0, 0])
        state = dynamics(state, plan[:, 0])
    return torch.stack(actions)


def test_an_evaluation_carries_the_memory(recurrent):
    network, task, dynamics = recurrent
    episodes = task.episodes(3, "test", 0)
    result = evaluate(as_actor(network), dynamics, task, episodes)
    for i in range(3):
        expected = by_hand(network, dynamics, task, episodes[i : i + 1], task.steps)
        torch.testing.assert_close(result.actions[i], expected, rtol=1e-4, atol=1e-5)
    forgetful = TensorDictModule(
        lambda seen, window: network(seen, window)[..., 0, :], in_keys=["observation", "window"], out_keys=["action"]
    )
    assert not torch.allclose(evaluate(forgetful, dynamics, task, episodes).actions, result.actions, atol=1e-3)


def test_flights_for_data_carry_the_memory(recurrent):
    network, task, dynamics = recurrent
    episodes = task.episodes(2, "train", 0)
    flown = collect(as_actor(network), (dynamics, task, episodes), 2 * task.steps)
    for i in range(2):
        own = flown.select(flown.trajectory == i)
        episode = next(e for e in episodes if torch.allclose(task.start(e[None], torch.tensor([0])), own.state[:1]))
        expected = by_hand(network, dynamics, task, episode[None], task.steps)
        torch.testing.assert_close(own.action, expected, rtol=1e-4, atol=1e-5)


def test_in_a_rollout_with_partial_resets_each_flight_begins_with_an_empty_memory(recurrent):
    network, task, dynamics = recurrent
    episodes = task.episodes(5, "train", 0)
    env = TrackingEnv(dynamics, task, episodes, (2,), seed=1)
    start = env.reset()
    late = TensorDict({key: start[key].clone() for key in ("state", "episode", "step")}, batch_size=2)
    late["step"][1] = task.steps - 4  # ends after four steps
    start = env.reset(late, set_state=True)
    flown = env.rollout(9, as_actor(network), tensordict=start, auto_reset=False, break_when_any_done=False)
    assert flown["step"][1].flatten().tolist() == [8, 9, 10, 11, 0, 1, 2, 3, 4]
    assert flown["hidden"].shape == (2, 9, 2, 8)
    assert torch.equal(flown["hidden"], flown["next", "hidden"])
    assert flown["hidden"].flatten(2).any(-1).all()
    for row, begin in ((0, 0), (1, 4)):
        expected = by_hand(network, dynamics, task, episodes[flown["episode"][row, begin]], 9 - begin)
        torch.testing.assert_close(flown["action"][row, begin:], expected, rtol=1e-4, atol=1e-5)


def test_where_a_flight_begins_nothing_is_remembered_whatever_was_left_there(recurrent):
    network, task, dynamics = recurrent
    seen = TrackingEnv(dynamics, task, task.episodes(3, "train", 0), (3,)).reset()
    left = torch.full((3, 2, 8), 0.5)
    told = TensorDict({**seen, "hidden": left, "is_init": torch.tensor([[False], [False], [True]])}, batch_size=3)
    told["step"] = torch.tensor([[0], [7], [7]])
    inputs = seen["observation"], seen["window"]
    fresh, kept = network(*inputs)[:, 0], network.recall(*inputs, left)[0][:, 0]
    assert not torch.isclose(fresh, kept).any()
    torch.testing.assert_close(as_actor(network)(told)["action"], torch.stack((fresh[0], kept[1], fresh[2])))


def test_a_flight_that_begins_anywhere_is_known_by_torchrls_init_tracker(recurrent):
    network, task, dynamics = recurrent
    env = TransformedEnv(
        TrackingEnv(dynamics, task, task.episodes(5, "train", 0), (6,), seed=0, anywhere=True), InitTracker()
    )
    flown = env.rollout(15, as_actor(network), break_when_any_done=False)
    begins = flown["is_init"].squeeze(-1)[:, 1:]
    assert (begins & (flown["step"][:, 1:, 0] > 0)).any()
    forgetful = network(flown["observation"], flown["window"])[:, 1:, 0]
    forgot = torch.isclose(flown["action"][:, 1:], forgetful, atol=1e-6).all(-1)
    assert torch.equal(forgot, begins)


def test_a_flight_may_go_on_from_a_tensordict_that_has_a_memory_and_from_one_without(recurrent):
    network, task, dynamics = recurrent
    env = TrackingEnv(dynamics, task, task.episodes(2, "train", 0), (2,))
    actor = as_actor(network)
    with torch.no_grad():
        later = step_mdp(env.step(actor(env.reset())))
        carried, empty = actor(later.clone()), actor(later.exclude("hidden"))
    assert later["step"].tolist() == [[1], [1]]
    assert not torch.allclose(carried["action"], empty["action"])
    torch.testing.assert_close(empty["action"], network(later["observation"], later["window"])[:, 0])


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_a_policy_of_any_mode_is_saved_loaded_and_flies_the_same(tmp_path, mode, name):
    task, dynamics = make_task(name, steps=15, horizon=6), make_dynamics(name)
    network = network_for(task, features=8, widths=(8, 8), mode=mode)
    save_policy(tmp_path / "p.safetensors", network, task, {})
    policy = load_policy(tmp_path / "p.safetensors", task.system)
    assert policy.network.config == network.config
    assert policy.task == task
    episodes = task.episodes(3, "test", 0)
    one, two = (evaluate(actor, dynamics, task, episodes).actions for actor in (as_actor(network), policy.actor()))
    assert torch.equal(one, two)
    assert action_time(policy.actor(), dynamics, task, calls=3)["median_ms"] > 0


@pytest.mark.parametrize("mode", CALLED_AGAIN)
@pytest.mark.parametrize("name", ["cartpole", pytest.param("quadrotor", marks=pytest.mark.slow)])
def test_a_resumed_run_ends_bit_for_bit_where_an_uninterrupted_one_does(mode, name):
    task, dynamics, config = make_task(name, horizon=3), make_dynamics(name), replace(TINY, mode=mode)
    banks = apg.training_banks(task, config, 0)
    whole = apg.begin(dynamics, task, banks, config, 0)
    file, history = io.BytesIO(), []
    for row in apg.train(whole, dynamics, task, banks, config):
        history.append(row)
        if whole.update == 5:
            torch.save(whole.state_dict(), file)
    file.seek(0)
    again = apg.begin(dynamics, task, banks, config, 0)
    again.load_state_dict(torch.load(file, weights_only=True), banks, config, task)
    assert list(apg.train(again, dynamics, task, banks, config)) == history[5:]
    for key, value in whole.network.state_dict().items():
        assert torch.equal(again.network.state_dict()[key], value)
    assert torch.equal(again.flight.state, whole.flight.state)
    assert (again.flight.hidden is None) == (mode != "recurrent")
    if mode == "recurrent":
        assert torch.equal(again.flight.hidden, whole.flight.hidden)
        assert again.flight.hidden.any()


@pytest.mark.parametrize("mode", ["autoregressive", pytest.param("recurrent", marks=pytest.mark.slow)])
def test_within_seconds_training_lowers_the_validation_error(mode):
    task, dynamics = make_task("cartpole"), make_dynamics("cartpole")
    config = replace(QUICK, mode=mode, batch=32 if mode == "recurrent" else 16)
    validation, banks = task.episodes(10, "validation", 0), apg.training_banks(task, config, 0)
    run = apg.begin(dynamics, task, banks, config, 0)
    before = evaluate(as_actor(run.network), dynamics, task, validation).table
    list(apg.train(run, dynamics, task, banks, config))
    after = evaluate(as_actor(run.network), dynamics, task, validation).table
    assert run.skipped == 0
    assert after.success.all()
    assert after.error.mean() < 0.2 * before.error.mean()


def test_a_policy_is_fine_tuned_in_its_own_mode(mode):
    task = make_task("cartpole", steps=20)
    network = network_for(task, features=8, widths=(8, 8), mode=mode)
    network.head.weight.data.mul_(0.1)
    policy = Policy(network, task, {})
    config = replace(apg.FINETUNE, updates=3, batch=4, episodes=8)
    tuned, history = finetune(policy, make_dynamics("cartpole", "push=1"), config)
    assert tuned.network.config == network.config
    assert not torch.equal(tuned.network.head.weight, network.head.weight)
    assert len(history) == 3


def test_a_policy_does_not_change_its_mode():
    task = make_task("cartpole", steps=20)
    policy = Policy(network_for(task, 8, mode="autoregressive"), task, {})
    asked = replace(TINY, mode="recurrent")
    with pytest.raises(InputError, match=r"--mode recurrent: the policy is autoregressive and stays so"):
        finetune(policy, make_dynamics("cartpole"), asked)


def test_an_unknown_mode_is_refused_by_name():
    with pytest.raises(InputError, match=r"^--mode chained: expected one of concurrent, autoregressive, recurrent$"):
        apg.APGConfig(mode="chained")
