"""The probabilistic ensemble: it learns means and variances, its members differ, and it steps as dynamics do."""

import math
from dataclasses import asdict, replace

import pytest
import torch

from envs import SYSTEMS, make_dynamics, make_task
from envs.errors import InputError
from policies import ensemble
from policies.ensemble import (
    Ensemble,
    EnsembleConfig,
    EnsembleDynamics,
    FitConfig,
    fit,
    model_inputs,
    model_outputs,
)


@pytest.fixture(params=SYSTEMS)
def task(request):
    return make_task(request.param)


def made(inputs=1, outputs=1, seed=0, **shape):
    torch.manual_seed(seed)
    return Ensemble(EnsembleConfig(inputs, outputs, **{"width": 32, **shape}))


def bootstrap(rows, members=5, seed=0, held_out=0.1):
    generator = torch.Generator().manual_seed(seed)
    counts = torch.poisson(torch.ones(rows, members), generator=generator).long()
    counts[torch.rand(rows, generator=generator) < held_out] = -1
    return counts


def learn(network, inputs, outputs, seed=0, counts=None, **settings):
    network.normalise(inputs, outputs)
    counts = bootstrap(len(inputs), network.config.members, seed) if counts is None else counts
    return fit(network, inputs, outputs, counts, FitConfig(**settings), torch.Generator().manual_seed(seed))


def noise_of(x):
    """Standard deviation that grows from left to right."""
    return 0.1 * x.exp()


@pytest.fixture(scope="module")
def heteroscedastic():
    """An ensemble that has learned sin(3 x) with noise that depends on x, from samples in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(3000, 1, generator=generator) - 1
    network = made()
    y = (3 * x).sin() + noise_of(x) * torch.randn(x.shape, generator=generator)
    learn(network, x, y, steps=1000)
    return network


@torch.no_grad()
def physical(network, x):
    """Mean and standard deviation of every member, not normalised."""
    mean, logvar = network(x)
    return mean * network.output_scale + network.output_mean, (0.5 * logvar).exp() * network.output_scale


def test_every_member_recovers_mean_and_variance_of_noise_that_depends_on_the_input(heteroscedastic):
    x = torch.linspace(-0.9, 0.9, 50).unsqueeze(-1)
    mean, std = physical(heteroscedastic, x)
    assert ((mean - (3 * x).sin()).abs() < 0.5 * noise_of(x) + 0.03).all()
    assert (std / noise_of(x)).log().abs().max() < 0.4


def test_members_disagree_where_there_were_no_data(heteroscedastic):
    inside, _ = physical(heteroscedastic, torch.linspace(-0.9, 0.9, 50).unsqueeze(-1))
    outside, _ = physical(heteroscedastic, torch.tensor([[-4.0], [-3.0], [3.0], [4.0]]))
    assert inside.std(0).mean() > 0
    assert outside.std(0).min() > 5 * inside.std(0).mean()


def test_the_loss_is_the_negative_log_likelihood_of_a_gaussian_without_its_constant():
    network, x = made(2, 3), torch.randn(7, 2)
    y = torch.randn(5, 7, 3)
    mean, logvar = network(x)
    gaussian = torch.distributions.Normal(mean, (0.5 * logvar).exp())
    expected = -gaussian.log_prob(y).mean((-1, -2)) - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(network.loss(x, y), expected)


@pytest.mark.parametrize("size", [1.0, 1e3, 1e6])
def test_the_log_variance_never_leaves_its_bounds(size):
    network = made(2, 3)
    with torch.no_grad():
        for bias in network.biases:
            bias.normal_(0, size, generator=torch.Generator().manual_seed(0))
    logvar = network(size * torch.randn(100, 2))[1]
    slack = 1e-4  # the second soft clamp lifts what lies at the upper bound by this little
    assert (logvar >= network.min_logvar).all()
    assert (logvar <= network.max_logvar + slack).all()
    assert logvar.isfinite().all()


def test_the_bounds_of_the_log_variance_are_drawn_together_by_learning():
    network, x = made(), torch.linspace(-1, 1, 200).unsqueeze(-1)
    before = float((network.max_logvar - network.min_logvar).detach())
    learn(network, x, x, steps=200)
    assert float((network.max_logvar - network.min_logvar).detach()) < before


def test_a_member_learns_from_the_rows_of_its_own_bootstrap_sample_as_often_as_they_are_in_it(monkeypatch):
    """The inputs are the numbers of the rows, so that what the loss is asked about tells which they were."""
    network, seen = made(members=3), []
    counts = bootstrap(12, members=3)
    monkeypatch.setattr(network, "loss", lambda x, y: seen.append(x) or Ensemble.loss(network, x, y))
    rows = torch.arange(12.0).unsqueeze(-1)
    fit(network, rows, rows, counts, FitConfig(steps=200, batch=64), torch.Generator().manual_seed(0))
    drawn = torch.cat([x for x in seen if x.dim() == 3], 1)[..., 0].long()
    share = torch.stack([torch.bincount(rows, minlength=12) for rows in drawn], -1) / drawn.shape[1]
    wanted = counts.clamp(min=0)
    torch.testing.assert_close(share, wanted / wanted.sum(0), rtol=0, atol=0.02)
    assert (share[wanted == 0] == 0).all()
    assert (counts < 0).any()
    assert len({tuple(column) for column in wanted.T.tolist()}) == 3


def test_the_weights_kept_are_those_that_were_best_on_held_out_rows(monkeypatch):
    """Of pure noise nothing can be learned: what is learned by heart is thrown away."""
    generator, looks = torch.Generator().manual_seed(0), []
    x, y = torch.randn(60, 1, generator=generator), torch.randn(60, 1, generator=generator)
    counts = torch.ones(60, 5, dtype=torch.long)
    counts[40:] = -1
    network, original = made(width=64), ensemble._held_out
    monkeypatch.setattr(ensemble, "_held_out", lambda *args: looks.append(original(*args)) or looks[-1])
    best, skipped = learn(network, x, y, counts=counts, steps=400, learning_rate=1e-2)
    with torch.no_grad():
        assert float(network.loss(x[40:], network.normalised(y[40:])).mean()) == pytest.approx(best)
    assert best == min(looks) < looks[0]
    assert looks[-1] > best + 0.2
    assert skipped == 0


def test_more_data_make_an_ensemble_better_that_had_learned_from_few():
    """The rise of the learning rate at the start of a fit doesn't hide what the end of it gains."""
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(2000, 1, generator=generator) - 1
    y, counts, network = (3 * x).sin() + 0.01 * torch.randn(x.shape, generator=generator), bootstrap(2000), made()
    learn(network, x[:40], y[:40], counts=counts[:40], steps=400)
    before, _ = physical(network, x)
    fit(network, x, y, counts, FitConfig(steps=600), torch.Generator().manual_seed(1))
    after, _ = physical(network, x)
    assert (after - (3 * x).sin()).square().mean() < 0.5 * (before - (3 * x).sin()).square().mean()


def test_rows_that_are_not_finite_in_the_loss_are_left_out_and_counted():
    x = torch.linspace(-1, 1, 50).unsqueeze(-1)
    counts = bootstrap(50)
    network = made()
    network.normalise(x, x)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    _, skipped = fit(network, x, x * math.nan, counts, FitConfig(steps=10), torch.Generator().manual_seed(0))
    assert skipped == 10
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_very_few_rows_are_no_error(rows):
    x = torch.randn(rows, 2, generator=torch.Generator().manual_seed(0))
    for held_out in (0.0, 0.5, 1.0):
        best, _ = learn(made(2, 1), x, x[:, :1], counts=bootstrap(rows, held_out=held_out), steps=20)
        assert math.isfinite(best)


def test_fitting_is_the_same_for_the_same_seed_and_leaves_the_global_generator_alone():
    x = torch.linspace(-1, 1, 100).unsqueeze(-1)
    networks = [made(), made(), made()]
    torch.manual_seed(5)
    before = torch.get_rng_state()
    for network, seed in zip(networks, (0, 0, 1), strict=True):
        learn(network, x, x.sin(), seed=seed, counts=bootstrap(100), steps=30)
    assert torch.equal(torch.get_rng_state(), before)
    states = [torch.cat([value.flatten() for value in network.state_dict().values()]) for network in networks]
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


# --- dynamics ----------------------------------------------------------------------------------------------------


def situations(task, n, seed=0):
    """States about the start of the task, random actions, and what they lead to."""
    generator = torch.Generator().manual_seed(seed)
    state = task.start(task.episodes(n, "train", 0), torch.zeros(n, dtype=torch.long))
    noisy = state + 0.1 * torch.randn(state.shape, generator=generator)
    state = torch.stack(tuple(task.system.project(task.system.State(*noisy.unbind(-1)))), -1)
    action = 2 * torch.rand(n, len(task.system.Action._fields), generator=generator) - 1
    return state, action, make_dynamics(task.system)(state, action)


def untrained(task, **shape):
    torch.manual_seed(0)
    return Ensemble(Ensemble.Config(**Ensemble.contract(task), width=16, **shape))


def test_true_outputs_lead_to_the_true_next_state(task):
    """A network whose output is constant and right steps like the robot: nothing is lost in the tangent space."""
    state, action, following = situations(task, 1)
    network = untrained(task)
    with torch.no_grad():
        for weight in network.weights:
            weight.zero_()
        network.output_mean.copy_(model_outputs(task.system, state, following)[0])
    torch.testing.assert_close(EnsembleDynamics(network, task.system)(state, action), following, rtol=1e-5, atol=1e-5)


def test_a_linear_system_is_learned_to_a_few_percent_of_how_it_moves():
    class Linear:
        """x' = x + 0.1 v + 0.005 u, v' = 0.9 v + 0.1 u."""

        def __call__(self, state, action):
            x, v, theta, omega = state.unbind(-1)
            u = action[..., 0]
            return torch.stack((x + 0.1 * v + 0.005 * u, 0.9 * v + 0.1 * u, theta + 0.1 * omega, omega - 0.1 * u), -1)

    system, generator = make_task("cartpole").system, torch.Generator().manual_seed(0)
    state = 0.2 * torch.randn(2500, 4, generator=generator)
    action = 2 * torch.rand(2500, 1, generator=generator) - 1
    following = Linear()(state, action)
    inputs, outputs = model_inputs(system, state, action), model_outputs(system, state, following)
    network = untrained(make_task("cartpole"))
    learn(network, inputs[:2000], outputs[:2000], steps=1200, learning_rate=5e-3)
    with torch.no_grad():
        predicted = EnsembleDynamics(network, system)(state[2000:], action[2000:])
    moved = (following - state)[2000:].std(0)
    assert ((predicted - following[2000:]).square().mean(0).sqrt() < 0.03 * moved).all()


def test_it_takes_any_batch_and_keeps_attitudes_on_the_unit_sphere(task):
    state, action, _ = situations(task, 6)
    model = EnsembleDynamics(untrained(task), task.system)
    with torch.no_grad():
        flat, folded = model(state, action), model(state.reshape(2, 3, -1), action.reshape(2, 3, -1))
        assert torch.equal(folded, flat.reshape(2, 3, -1))
        torch.testing.assert_close(model(state[0], action[0]), flat[0])
        torch.testing.assert_close(model(state, action[0]), model(state, action[:1].expand(6, -1)))
    if "qw" in task.system.State._fields:
        torch.testing.assert_close(flat[:, 3:7].norm(dim=-1), torch.ones(6))
    assert model.dt == task.system.dt


def test_the_prediction_does_not_depend_on_the_place(task):
    state, action, _ = situations(task, 6)
    places = [i for i, name in enumerate(task.system.State._fields) if name in ("px", "py", "pz", "x")]
    moved = state.clone()
    moved[:, places] += 3.0
    model = EnsembleDynamics(untrained(task), task.system)
    with torch.no_grad():
        expected = model(state, action)
        expected[:, places] += 3.0
        torch.testing.assert_close(model(moved, action), expected, rtol=1e-5, atol=1e-5)


def test_samples_have_the_mean_and_the_spread_of_their_member():
    task = make_task("cartpole")
    state, action, _ = situations(task, 1)
    network, model = untrained(task), None
    model = EnsembleDynamics(network, task.system)
    noise = torch.randn(5, 4000, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        drawn = model.sample(state.expand(5, 4000, -1), action.expand(4000, -1), noise)
        mean, logvar = network(model_inputs(task.system, state, action))
        without = model.sample(state.expand(5, 1, -1), action, torch.zeros(5, 1, 4))
    torch.testing.assert_close(without, state + mean)
    torch.testing.assert_close(drawn.mean(1), (state + mean)[:, 0], rtol=0, atol=0.08)
    torch.testing.assert_close(drawn.std(1), (0.5 * logvar).exp()[:, 0], rtol=0.05, atol=0)


def test_the_mean_of_the_members_is_what_a_step_gives():
    task = make_task("cartpole")
    state, action, _ = situations(task, 3)
    model = EnsembleDynamics(untrained(task), task.system)
    with torch.no_grad():
        each = model.sample(state.expand(5, -1, -1), action, torch.zeros(5, 3, 4))
        torch.testing.assert_close(model(state, action), each.mean(0))


def test_the_shape_is_told_in_plain_values_and_comes_back_from_them():
    config = EnsembleConfig(5, 4, width=16)
    assert EnsembleConfig(**asdict(config)) == config


@pytest.mark.parametrize("name", ["inputs", "outputs", "members", "width", "layers"])
def test_a_size_below_one_is_refused(name):
    with pytest.raises(InputError, match=f"EnsembleConfig.{name} 0: expected at least 1"):
        replace(EnsembleConfig(2, 2), **{name: 0})


@pytest.mark.parametrize("changes", [{"steps": 0}, {"batch": 0}, {"learning_rate": math.nan}, {"weight_decay": -1.0}])
def test_settings_of_a_fit_that_make_no_sense_are_refused(changes):
    with pytest.raises(InputError, match=f"FitConfig.{next(iter(changes))} "):
        FitConfig(**changes)
