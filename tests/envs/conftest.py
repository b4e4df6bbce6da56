"""Every robot with its default parameters and away from them, and states to start it from."""

import math
from dataclasses import fields, replace
from functools import lru_cache

import pytest
import torch

from envs import SYSTEMS


def vary(system, seed):
    """The same robot with every parameter drawn anew: within a third of its value, or small where that is zero."""
    generator = torch.Generator().manual_seed(seed)

    def uniform():
        return 2 * torch.rand((), generator=generator, dtype=torch.float64).item() - 1

    changes = {}
    for field in fields(system):
        value = getattr(system, field.name)
        if isinstance(value, tuple):
            changes[field.name] = tuple(part * (1 + uniform() / 3) for part in value)
        elif value is None:  # what a controller believes: not the truth
            changes[field.name] = getattr(system, field.name.removeprefix("controller_")) * (1 + uniform() / 3)
        else:
            changes[field.name] = value * (1 + uniform() / 3) if value else 0.2 * uniform()
    return replace(system, **changes)


@lru_cache
def starts(name, n):
    """Where episodes of a system's task start (n, states), float64."""
    task = SYSTEMS[name][1]()
    return task.start(task.episodes(n, "train", 0), torch.zeros(n, dtype=torch.long)).double()


def draw(system, n, seed=0):
    """Random states (n, states) about the starts of the system's task and random actions (n, actions), float64."""
    generator = torch.Generator().manual_seed(seed)
    start = starts(system.name, n)
    noise = torch.randn(start.shape, generator=generator, dtype=torch.float64)
    x = system.project(system.State(*(start + 0.5 * noise).unbind(-1)))
    action = 2 * torch.rand(n, len(system.Action._fields), generator=generator, dtype=torch.float64) - 1
    return torch.stack(tuple(x), -1), action


def read_scalars(system, state, action=None):
    """State and action tensors as the named scalars that equations take."""
    x = system.State(*state.unbind(-1))
    return x if action is None else (x, system.Action(*action.unbind(-1)))


def stack_rates(system, state, action):
    """The derivative as a tensor like `state`."""
    rates = system.derivative(*read_scalars(system, state, action))
    return torch.stack(torch.broadcast_tensors(*rates), -1)


@pytest.fixture(name="vary", scope="session")
def vary_fixture():
    return vary


@pytest.fixture(name="draw", scope="session")
def draw_fixture():
    return draw


@pytest.fixture(scope="session")
def scalars():
    return read_scalars


@pytest.fixture(scope="session")
def derivative():
    return stack_rates


@pytest.fixture(scope="session", params=SYSTEMS)
def nominal(request):
    """Every system with its default parameters."""
    return SYSTEMS[request.param][0]()


@pytest.fixture(scope="session", params=[(name, seed) for name in SYSTEMS for seed in (None, 1, 2)], ids=str)
def robot(request):
    """Every system with its default parameters and with two sets of others."""
    name, seed = request.param
    system = SYSTEMS[name][0]()
    return system if seed is None else vary(system, seed)


@pytest.fixture(scope="session")
def turn():
    """Quaternion of a turn by an angle about an axis."""

    def quaternion(angle, axis):
        axis = torch.nn.functional.normalize(torch.as_tensor(axis, dtype=torch.float64), dim=0)
        return (math.cos(angle / 2), *(math.sin(angle / 2) * axis).tolist())

    return quaternion
