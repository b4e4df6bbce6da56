"""The noise of the sensors is found in what was recorded, and policies are compared by what such sensors say."""

import copy
from dataclasses import replace

import pytest
import torch

from adapt import adaptation
from adapt.adaptation import adapt, learn
from adapt.gate import Gate
from adapt.sensor_noise import sensor_noise
from envs import SYSTEMS, make_dynamics
from envs.domains import NOISE
from envs.dynamics import Sensed
from policies.apg import FINETUNES
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


def test_what_the_robot_lacks_is_not_taken_for_noise():
    """A residual without rotation can't tell a payload's thrust from a push, and strays by decimetres per second."""
    policy = load_policy("quadrotor")
    flown, residual, _ = learn(policy, make_dynamics("quadrotor", "mass=x1.3"), 300, kind="state")
    assert torch.tensor(sensor_noise(residual, flown)).max() < NOISE["velocity"]


def test_adaptation_from_noisy_flight_validates_and_judges_by_noisy_sensors(monkeypatch):
    policy, target, flown = load_policy("cartpole"), make_dynamics("cartpole", "push=1 noise=1"), {}
    for name in ("finetune", "Gate"):
        found = getattr(adaptation, name)

        def watched(*arguments, name=name, found=found, **named):
            flown[name] = named.get("noise") or arguments[-1]
            return found(*arguments, **named)

        monkeypatch.setattr(adaptation, name, watched)
    config = replace(FINETUNES["cartpole"], updates=50)
    adapt(policy, target, samples=300, kind="parameters", episodes=2, config=config)
    drawn = [NOISE[kind] for kind in policy.task.system.quantities]
    assert flown["Gate"] == flown["finetune"] == pytest.approx(drawn, rel=0.2)


def test_dynamics_with_sensors_can_be_copied():
    flown = copy.deepcopy(Sensed(make_dynamics("cartpole"), (0.001,)))
    assert flown.noise == (0.001,)
    assert flown.dt == make_dynamics("cartpole").dt
