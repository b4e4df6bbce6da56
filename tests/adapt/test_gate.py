"""The gate takes what is surely better in every model that the data allow, and keeps the old policy otherwise."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from adapt.gate import Flown, Gate, decide
from adapt.trust_region import NOISY, Best, distance, part_way
from envs import make_dynamics
from policies import evaluate as flights
from policies.checkpoints import load_policy
from policies.evaluate import evaluate

ALL = torch.ones(20, dtype=torch.bool)
NOISE = torch.randn(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def flown(old, new, model="fit", old_succeeded=ALL, new_succeeded=ALL):
    return Flown(model, old, new, old_succeeded, new_succeeded)


def around(mean, spread=0.05):
    return mean * (1 + spread * NOISE)


def test_half_the_error_in_every_model_is_taken():
    verdict = decide([flown(around(1.0), around(0.5)), flown(around(1.0), around(0.6), "other")])
    assert verdict.accepted
    assert verdict.confidence > 0.99
    assert verdict.gain == pytest.approx((math.log(2) + math.log(1 / 0.6)) / 2)


def test_the_same_is_not_better():
    verdict = decide([flown(around(1.0), around(1.0))])
    assert not verdict.accepted
    assert "0.95 is asked for" in verdict.reason


def test_a_gain_within_the_scatter_of_the_episodes_is_not_sure():
    better = around(1.0) - 0.02 - 0.2 * NOISE.roll(7)
    verdict = decide([flown(around(1.0), better)])
    assert verdict.gain > 0
    assert not verdict.accepted


def test_a_gain_that_the_models_do_not_agree_on_is_not_sure():
    verdict = decide([flown(around(1.0), around(0.5)), flown(around(1.0), around(1.04), "other")])
    assert not verdict.accepted
    assert verdict.confidence < 0.95


def test_one_model_in_which_it_is_worse_is_enough_to_refuse():
    verdict = decide([flown(around(1.0), around(0.1)), flown(around(1.0), around(1.2), "resampled flight 1")])
    assert not verdict.accepted
    assert verdict.reason == "the new policy is worse in resampled flight 1"


def test_a_smaller_error_does_not_excuse_a_crash():
    one_crash = ALL.clone()
    one_crash[3] = False
    verdict = decide([flown(around(1.0), around(0.1), new_succeeded=one_crash)])
    assert not verdict.accepted
    assert "fails more often in fit" in verdict.reason


def test_to_fly_where_the_old_one_crashed_is_a_gain_whatever_the_error():
    assert decide([flown(around(1.0), around(1.0), old_succeeded=~ALL)]).accepted


def first(count):
    """The first `count` of the episodes."""
    return torch.arange(20) < count


def test_a_few_flights_that_both_survive_tell_nothing():
    verdict = decide([flown(around(1.0), around(0.5), "fit", first(8), first(8))])
    assert not verdict.accepted
    assert verdict.reason == "too few flights succeed in fit to tell which policy is better"


def test_flights_that_are_saved_in_one_model_are_no_evidence_of_smaller_errors_in_another():
    saved = flown(around(1.0), around(1.0), "other", ~ALL)
    assert decide([flown(around(1.0), around(0.5)), saved]).accepted
    verdict = decide([flown(around(1.0), around(0.999)[torch.randperm(20)]), saved])
    assert not verdict.accepted
    assert "0.95 is asked for" in verdict.reason


@pytest.fixture(scope="module")
def cart():
    return load_policy("cartpole")


def spoilt(policy, size, seed=0):
    """The policy with weights that are off."""
    network, generator = copy.deepcopy(policy.network), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator)
    return replace(policy, network=network)


def test_a_good_policy_replaces_a_spoilt_one_and_not_the_other_way_round(cart):
    bad, models = spoilt(cart, 0.02), {"the fit": make_dynamics("cartpole")}
    assert Gate(bad, models, episodes=8).judge(cart).accepted
    chosen, verdict = Gate(cart, models, episodes=8).choose(bad)
    assert chosen is cart
    assert not verdict.accepted


def test_actions_that_change_too_much_are_not_even_flown(cart, monkeypatch):
    monkeypatch.setattr("adapt.gate.FARTHEST", 1e-6)
    chosen, verdict = Gate(cart, {"the fit": make_dynamics("cartpole")}, episodes=4).choose(spoilt(cart, 0.02))
    assert chosen is cart
    assert "actions differ" in verdict.reason


def test_where_a_robot_was_lost_nothing_is_compared(cart):
    other = spoilt(cart, 0.02)
    flight = evaluate(
        cart.actor(), make_dynamics("cartpole"), cart.task, flights.test_episodes(cart.task, 2, "validation")
    )
    whole = distance(cart, other, flight)
    flight.states[1, 5:] = torch.nan
    assert 0 < distance(cart, other, flight) < 2 * whole


def test_part_way_is_between_and_the_whole_way_is_the_new_policy(cart):
    other = spoilt(cart, 0.02)
    assert part_way(cart, other, 1.0) is other
    half = part_way(cart, other, 0.5).network.state_dict()
    for name, value in half.items():
        torch.testing.assert_close(value, (cart.network.state_dict()[name] + other.network.state_dict()[name]) / 2)


def test_the_distance_is_that_of_the_actions_flown(cart):
    flight = evaluate(
        cart.actor(), make_dynamics("cartpole"), cart.task, flights.test_episodes(cart.task, 4, "validation")
    )
    assert distance(cart, cart, flight) == 0
    other = spoilt(cart, 0.02)
    state = flight.states[0, 7:8]
    window = cart.task.window(state, cart.task.reference(flight.episodes[:1], torch.tensor([7]), state))
    with torch.no_grad():
        actions = [policy.network(cart.task.observe(state), window)[:, 0] for policy in (cart, other)]
    torch.testing.assert_close(actions[0], flight.actions[0, 7:8])
    assert distance(cart, other, flight) > 0.1 * float((actions[0] - actions[1]).abs())


def test_the_best_weights_on_the_way_are_kept(cart):
    best = Best(cart, make_dynamics("cartpole"), updates=4, times=2, episodes=4)
    bad = spoilt(cart, 0.05)
    best(bad.network, 1)  # not its turn
    best(bad.network, 2)
    best(bad.network, 4)
    assert best.update == 0
    assert all(torch.equal(best.weights[name], value) for name, value in cart.network.state_dict().items())
    other = Best(bad, make_dynamics("cartpole"), updates=4, times=2, episodes=4)
    other(cart.network, 2)
    assert other.update == 2


def test_by_noisy_sensors_weights_are_chosen_by_how_they_fly_with_the_noise(cart):
    source, noise = make_dynamics("cartpole"), (0.01, 0.1, 0.05, 0.2)
    exact, noisy = (Best(cart, source, updates=4, times=2, episodes=4, noise=which) for which in ((), noise))
    assert len(noisy.episodes) == NOISY * len(exact.episodes)
    assert noisy.score[1] < 2 * exact.score[1] < 0  # minus the error
