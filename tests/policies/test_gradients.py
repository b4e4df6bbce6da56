"""Statistics of the gradient: numbers that are known on paper, and independence of units and of the batch."""

import copy
import math
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

from envs import make_dynamics, make_task
from envs.cartpole import Balance
from policies import apg, modes
from policies.gradients import gradient_statistics
from policies.networks import MODES, network_for


@dataclass(frozen=True)
class Dearer(Balance):
    """The same task, in which everything costs four times as much."""

    state_weights: ClassVar[dict[str, float]] = {name: 4 * weight for name, weight in Balance.state_weights.items()}


def steady(mode="concurrent", horizon=2):
    """A task, its dynamics, training episodes and a network, float64."""
    task = make_task("cartpole", horizon=horizon)
    network = network_for(task, features=8, widths=(8,), mode=mode).double()
    return network, make_dynamics("cartpole"), task, task.episodes(60, "train", 0).double()


@pytest.mark.parametrize("mode", MODES)
def test_the_norm_is_that_of_the_gradient_of_the_logarithm_of_the_cost(mode):
    """One episode flown from its start has nothing random left: every batch is the same."""
    network, dynamics, task, episodes = steady(mode)
    found = gradient_statistics(network, dynamics, task, episodes[:1], batches=3, size=2, periods=0)
    flight = apg.Flight(task, dynamics, episodes[:1], 1, torch.Generator(), network.config.memory)
    logarithm = modes.look_ahead(network, dynamics, task, flight).cost.mean().log()
    parts = torch.autograd.grad(logarithm, list(network.parameters()))
    assert found["norm"] == pytest.approx(float(torch.cat([part.flatten() for part in parts]).norm()))
    assert found["variance"] == pytest.approx(0, abs=1e-12)


def test_the_variance_is_that_of_a_single_sample_whatever_the_batch():
    network, dynamics, task, episodes = steady(horizon=1)
    one = gradient_statistics(network, dynamics, task, episodes, batches=300, size=1, periods=0)
    many = gradient_statistics(network, dynamics, task, episodes, batches=100, size=16, periods=0, seed=1)
    every = torch.stack([single(network, dynamics, task, episode) for episode in episodes])
    exact = (every - every.mean(0)).square().sum(-1).mean() / every.mean(0).square().sum()
    assert one["variance"] == pytest.approx(float(exact), rel=0.25)
    assert many["variance"] == pytest.approx(float(exact), rel=0.25)
    assert many["norm"] == pytest.approx(one["norm"], rel=0.25)


def single(network, dynamics, task, episode):
    """The gradient of the cost from the start of one episode."""
    flight = apg.Flight(task, dynamics, episode[None], 1, torch.Generator())
    parts = torch.autograd.grad(
        modes.look_ahead(network, dynamics, task, flight).cost.mean(), list(network.parameters())
    )
    return torch.cat([part.flatten() for part in parts])


def test_both_are_without_unit():
    network, dynamics, task, episodes = steady()
    plain = gradient_statistics(network, dynamics, task, episodes, batches=3, size=4)
    dear = gradient_statistics(network, dynamics, Dearer(horizon=2), episodes, batches=3, size=4)
    assert dear == pytest.approx(plain)


@pytest.mark.parametrize("mode", MODES)
def test_it_repeats_with_its_seed_and_leaves_the_network_and_the_global_state_alone(mode):
    network, dynamics, task, episodes = steady(mode)
    before, state = copy.deepcopy(network.state_dict()), torch.get_rng_state()
    one, two, other = (
        gradient_statistics(network, dynamics, task, episodes, seed, batches=3, size=4) for seed in (0, 0, 1)
    )
    assert one == two
    assert one != other
    assert all(math.isfinite(value) and value > 0 for value in one.values())
    assert all(parameter.grad is None for parameter in network.parameters())
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    assert torch.equal(torch.get_rng_state(), state)


def test_the_flown_states_are_those_of_the_policy():
    """Flown on, a policy that always pushes is far from rest: its cost is steeper to nothing, but not the same."""
    network, dynamics, task, episodes = steady("recurrent")
    at_once, later = (
        gradient_statistics(network, dynamics, task, episodes, batches=3, size=4, periods=periods) for periods in (0, 8)
    )
    assert at_once["norm"] != pytest.approx(later["norm"], rel=1e-3)
