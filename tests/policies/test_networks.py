"""Policy networks: shapes and bounds, normalisation, and what a policy must not see."""

import pytest
import torch
from tensordict import TensorDict

from envs import SYSTEMS, make_task
from envs.errors import InputError
from policies.networks import MODES, NetworkConfig, PlanNetwork, as_actor, network_for


@pytest.fixture(params=SYSTEMS)
def task(request):
    return make_task(request.param)


def seen_by(task, n, moved=0.0, dtype=torch.float64):
    """Observation and window of `n` episodes some way into them; robot and episode may be moved together [m]."""
    episodes = task.episodes(n, "train", 0).to(dtype)
    step = torch.arange(n) % task.steps
    state = task.start(episodes, step)
    reference = task.reference(episodes, step, state)
    state = state + 0.1 * torch.randn(state.shape, generator=torch.Generator().manual_seed(1), dtype=dtype)
    if moved:
        state[..., :3] += moved
        reference[..., :3] += moved
    return task.observe(state), task.window(state, reference)


def test_a_plan_has_one_action_for_each_point_of_the_horizon_and_stays_in_bounds(task):
    network = network_for(task).double()
    observation, window = seen_by(task, 7)
    plan = network(observation, window)
    assert plan.shape == (7, task.horizon, len(task.system.Action._fields))
    far = network(1e3 * observation, 1e3 * window)
    assert far.abs().max() <= 1
    assert far.abs().max() > plan.abs().max()


def test_the_batch_may_have_any_shape_and_its_rows_do_not_mix(task):
    network = network_for(task).double()
    observation, window = seen_by(task, 6)
    plan = network(observation, window)
    for i in range(6):
        torch.testing.assert_close(network(observation[i], window[i]), plan[i], rtol=1e-12, atol=1e-12)
    folded = network(observation.unflatten(0, (2, 3)), window.unflatten(0, (2, 3)))
    torch.testing.assert_close(folded, plan.unflatten(0, (2, 3)), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("horizon", [3, 15])
def test_the_horizon_of_the_task_sets_the_length_of_the_plan(horizon):
    task = make_task("quadrotor", horizon=horizon)
    network = network_for(task)
    assert network(*seen_by(task, 2, dtype=torch.float32)).shape == (2, horizon, 4)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("horizon", [1, 2])
def test_a_window_shorter_than_a_filter_is_read_whole(horizon, mode):
    task = make_task("quadrotor", horizon=horizon)
    network = network_for(task, mode=mode).double()
    assert network.window_layer.kernel_size == (horizon,)
    observation, window = (z.requires_grad_() for z in seen_by(task, 4))
    plan = network(observation, window)
    assert plan.shape == (4, network.config.planned, 4)
    plan.sum().backward()
    assert (window.grad != 0).any(0).all()


@pytest.mark.parametrize("mode", ["autoregressive", "recurrent"])
def test_a_network_that_is_called_at_every_step_gives_one_action(task, mode):
    network = network_for(task, mode=mode).double()
    observation, window = seen_by(task, 6)
    plan = network(observation, window)
    assert plan.shape == (6, 1, len(task.system.Action._fields))
    folded = network(observation.unflatten(0, (2, 3)), window.unflatten(0, (2, 3)))
    torch.testing.assert_close(folded, plan.unflatten(0, (2, 3)))
    assert network(1e3 * observation, 1e3 * window).abs().max() <= 1


def test_the_memory_of_a_network_may_have_any_batch_shape(task):
    network = network_for(task, 16, mode="recurrent").double()
    observation, window = seen_by(task, 6)
    _, hidden = network.recall(observation, window)
    assert hidden.shape == (6, 2, 16)
    plan, later = network.recall(observation, window, hidden)
    folded = network.recall(*(part.unflatten(0, (2, 3)) for part in (observation, window, hidden)))
    torch.testing.assert_close(folded, (plan.unflatten(0, (2, 3)), later.unflatten(0, (2, 3))))
    alone = network.recall(observation[4], window[4], hidden[4])
    torch.testing.assert_close(alone, (plan[4], later[4]))


def test_a_network_without_a_memory_hands_it_on_as_it_is(task):
    network = network_for(task, 8, mode="autoregressive").double()
    seen = seen_by(task, 2)
    for hidden in (None, "anything"):
        plan, kept = network.recall(*seen, hidden)
        assert kept is hidden
        assert torch.equal(plan, network(*seen))


def test_the_modes_differ_in_nothing_but_head_and_memory():
    task = make_task("quadrotor")
    sizes = {mode: sum(p.numel() for p in network_for(task, mode=mode).parameters()) for mode in MODES}
    assert sizes["concurrent"] - sizes["autoregressive"] == 36 * (64 + 1)
    assert sizes["recurrent"] - sizes["autoregressive"] == 4 * 64 * (64 + 64 + 2)


def test_the_quadrotor_network_is_that_of_the_paper():
    """State to 64; reference through 20 filters of kernel 3; three layers of 64; 40 outputs."""
    network = network_for(make_task("quadrotor"))
    linear = lambda a, b: a * b + b  # noqa: E731
    wanted = linear(15, 64) + 20 * (6 * 3) + 20 + linear(64 + 20 * 8, 64) + 2 * linear(64, 64) + linear(64, 40)
    assert sum(p.numel() for p in network.parameters()) == wanted


def test_the_cartpole_network_is_that_of_the_paper():
    """Layers of 32, 64, 64, 32 and 10 outputs."""
    network = network_for(make_task("cartpole"))
    wanted = 4 * 32 + 32 + 32 * 64 + 64 + 64 * 64 + 64 + 64 * 32 + 32 + 32 * 10 + 10
    assert sum(p.numel() for p in network.parameters()) == wanted


def test_a_width_is_that_of_every_hidden_layer():
    config = network_for(make_task("cartpole"), width=16).config
    assert (config.features, config.widths) == (16, (16, 16, 16))


def test_the_filters_run_over_time():
    """The whole network, written out: feature (f, t) sees the points t, t + 1, t + 2 of the reference."""
    task = make_task("quadrotor")
    network = network_for(task, features=8, widths=(8,)).double()
    observation, window = seen_by(task, 3)
    kernel = network.window_layer.weight  # (filters, entries, 3)
    features = [torch.einsum("fek,bke->bf", kernel, window[:, t : t + 3]) for t in range(8)]
    features = torch.stack(features, -1) + network.window_layer.bias[:, None]
    parts = (network.state_layer(observation).tanh(), features.flatten(1).tanh())
    hidden = network.trunk[0](torch.cat(parts, -1)).tanh()
    plan = network.head(hidden).tanh().reshape(3, 10, 4)
    torch.testing.assert_close(network(observation, window), plan)


def test_every_entry_that_a_network_is_given_reaches_its_plan(task):
    network = network_for(task).double()
    observation, window = (z.requires_grad_() for z in seen_by(task, 4))
    network(observation, window).sum().backward()
    assert (observation.grad != 0).any(0).all()
    if task.encoder != "none":
        assert (window.grad != 0).any(0).all()


@pytest.mark.parametrize("name", ["quadrotor", "fixed_wing"])
def test_a_policy_does_not_see_where_in_the_world_it_flies(name):
    task = make_task(name)
    network = network_for(task).double()
    here, there = network(*seen_by(task, 5)), network(*seen_by(task, 5, moved=123.0))
    torch.testing.assert_close(here, there, rtol=0, atol=1e-9)


def test_an_actor_applies_the_first_action_and_reads_nothing_but_observation_and_window(task):
    network = network_for(task).double()
    observation, window = seen_by(task, 5)
    plan = network(observation, window)
    seen = {"observation": observation, "window": window}
    hidden = {"state": torch.full((5, 20), torch.nan), "step": torch.full((5, 1), 77), "episode": torch.ones(5, 1)}
    for more in ({}, hidden):
        flown = as_actor(network)(TensorDict({**seen, **more}, batch_size=5))
        assert torch.equal(flown["action"], plan[:, 0])
    assert not torch.equal(plan[:, 0], plan[:, 1])


def test_normalisation_gives_zero_mean_and_unit_spread_where_inputs_vary():
    generator = torch.Generator().manual_seed(0)
    observation = 50 + 20 * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    observation[:, 2] = 7.0  # does not vary: keeps its value
    window = 30 * torch.randn(4000, 5, 2, generator=generator, dtype=torch.float64)
    window[:, 0] = 0.0
    network = PlanNetwork(NetworkConfig(3, (5, 2), 1, 2, "linear", features=8, widths=(8,))).double()
    plain = PlanNetwork(network.config).double()
    weights = {
        name: value for name, value in network.state_dict().items() if "mean" not in name and "scale" not in name
    }
    plain.load_state_dict(weights, strict=False)
    network.normalise(observation, window)
    by_hand = (observation - observation.mean(0)) / observation.std(0)
    by_hand[:, 2] = 7.0
    scaled = window / window.square().mean(0).sqrt().where(torch.arange(5)[:, None] > 0, torch.tensor(1.0))
    assert torch.isfinite(network(observation, window)).all()
    torch.testing.assert_close(network(observation, window), plain(by_hand, scaled))
    assert not torch.allclose(network(observation, window), plain(observation, window))


def test_normalisation_is_saved_with_the_weights_but_not_trained(task):
    network = network_for(task)
    buffers = {"observation_mean", "observation_scale", "window_scale"}
    assert buffers <= network.state_dict().keys()
    assert not buffers & dict(network.named_parameters()).keys()


def test_an_unknown_encoder_is_refused():
    with pytest.raises(InputError, match="encoder 'lstm': expected one of conv, linear, none"):
        PlanNetwork(NetworkConfig(3, (5, 2), 1, 2, "lstm"))


def test_an_unknown_mode_is_refused():
    with pytest.raises(InputError, match="mode 'chained': expected one of concurrent, autoregressive, recurrent"):
        PlanNetwork(NetworkConfig(3, (5, 2), 1, 2, "linear", mode="chained"))
