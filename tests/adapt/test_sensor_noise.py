"""The noise of the sensors is found in what was recorded, and policies are compared by what such sensors say."""

import pytest
import torch

from adapt.adaptation import learn
from adapt.gate import Gate
from adapt.sensor_noise import sensor_noise
from envs import SYSTEMS, make_dynamics
from envs.domains import NOISE
from envs.dynamics import Sensed
from policies.checkpoints import load_policy
from policies.evaluate import evaluate


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_noise_that_was_drawn_is_found_beside_what_the_robot_lacks(name):
    policy = load_policy(name)
    flown, residual, _ = learn(policy, make_dynamics(name, "drag=0.3 noise=1"), 300)
    drawn = torch.tensor([NOISE[kind] for kind in policy.task.system.quantities])
    assert torch.tensor(sensor_noise(residual, flown)) == pytest.approx(drawn, rel=0.2)


def test_exact_states_have_none():
    policy = load_policy("quadrotor")
    flown, residual, _ = learn(policy, make_dynamics("quadrotor", "drag=0.3"), 60)
    assert sensor_noise(residual, flown) == ()


def test_flight_that_is_too_short_to_tell_has_none():
    policy = load_policy("cartpole")
    flown, residual, _ = learn(policy, make_dynamics("cartpole", "noise=1"), 30)
    assert sensor_noise(residual, flown.select(torch.arange(0, 30, 2))) == ()


def test_the_gate_flies_by_the_sensors_that_it_is_told_of():
    policy, noise = load_policy("cartpole"), (0.001, 0.02, 0.0087, 0.05)
    source = make_dynamics("cartpole")
    exact, noisy = (Gate(policy, {"source": source}, noise=which, episodes=4) for which in ((), noise))
    before = {gate: gate.before["source"].summary["mean"] for gate in (exact, noisy)}
    assert before[noisy] > 2 * before[exact]
    flown = evaluate(policy.actor(), Sensed(source, noise), policy.task, noisy.episodes)
    assert flown.summary["mean"] == pytest.approx(before[noisy], rel=1e-3)
