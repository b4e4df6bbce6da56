"""How the actions of a horizon come about in training, and what they cost: one function for each way.

Wiedemann, Wuest et al. (2023), sect. "Backpropagation over a horizon". All minimise the same cost: that of the next T
states against the T reference points that were seen at the beginning of the horizon. They differ in how long the chain
of gradients is: `concurrent` goes T times through the dynamics and once through the network, `stepwise` T times through
both. See `policies.networks` for the modes of a network.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Ahead(NamedTuple):
    """What a network makes of the next T control periods of B flights."""

    cost: Tensor  # (B,), differentiable in the weights
    action: Tensor  # (B, m), the first of the T
    hidden: Tensor | None = None  # (B, 2, memory), what is remembered after the first


def look_ahead(network, dynamics, task, flight):
    """The next T control periods of a `Flight`, the way that suits the mode of the network."""
    way = concurrent if network.config.mode == "concurrent" else stepwise
    return way(network, dynamics, task, flight)


def concurrent(network, dynamics, task, flight):
    """All T actions from one call of the network."""
    state, reference = flight.look()
    plan = network(task.observe(state), task.window(state, reference))
    return Ahead(plan_cost(dynamics, task, state, plan, reference), plan[:, 0])


def stepwise(network, dynamics, task, flight):
    """One action from each of T calls of the network, in the state that the ones before led to.

    What the network remembers goes on through the T calls, from what the flight has brought with it. That is taken as
    given: gradients are cut off at the beginning of the horizon (truncated backpropagation through time).
    """
    (state, reference), hidden = flight.look(), flight.hidden
    states, actions, kept = [], [], None
    for ahead in range(task.horizon):
        now = reference if ahead == 0 else flight.ahead(ahead, state)
        plan, hidden = network.recall(task.observe(state), task.window(state, now), hidden)
        kept = hidden if ahead == 0 else kept
        actions.append(plan[:, 0])
        state = dynamics(state, actions[-1])
        states.append(state)
    cost = task.cost(torch.stack(states, -2), torch.stack(actions, -2), reference).sum(-1)
    return Ahead(cost, actions[0], kept)


def plan_cost(dynamics, task, state, plan, reference):
    """Cost (B,) of a plan (B, T, m) from state (B, n) against reference (B, T, r), differentiable in all of them."""
    states = []
    for action in plan.unbind(-2):
        state = dynamics(state, action)
        states.append(state)
    return task.cost(torch.stack(states, -2), plan, reference).sum(-1)
