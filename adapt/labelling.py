"""Whether recorded actions are what their columns say: not swapped, not of the other sign, not recorded a period late.

A residual would explain such a record just as well as the true one, and be as sure of it; the policy tuned in it then
steers the wrong way. But the model itself, which knows what each action does, predicts far better once the actions are
put right. No change of a robot does that, but for one: its actuators may act a period late.
"""

import math
from dataclasses import replace
from itertools import combinations

import torch

from adapt.stretches import difference
from envs.errors import InputError

FAR_BETTER = 0.2  # [-] by which the logarithm of what the model misses falls
FEWEST = 5  # transitions that a shift in time is judged by
MISSED = 1e-6  # [m/s, rad/s] over a period that is as good as nothing
DELAYED = "with each action one control period later"
QUANTITIES = ("velocity", "rates")  # that actions act on at once


def check_labels(transitions, base):
    """Compare the record with itself under every swap of two actions, turned sign, and shift by one period.

    Args:
        transitions: in the order in which they were flown.
        base: `Dynamics` of the source.

    Returns:
        notes, as sentences: that the robot acts a period late, if it does.

    Raises:
        InputError: the model explains the record far better with other labels; names them.
    """
    found = [(_gain(base, recorded, other), words) for words, recorded, other in _labellings(transitions)]
    gain, words = max(found)
    if gain > FAR_BETTER:
        better = f"the model explains them {math.exp(gain):.1f} times as well {words}"
        if words != DELAYED:
            raise InputError(f"transitions: {better}; put the actions right and begin again")
        return [f"{better}: the robot acts late, or was recorded early, and no residual learns a delay"]
    return []


def _labellings(data):
    """(in words, transitions as recorded, the same transitions labelled in another way)."""
    names, count = data.action_names, data.action.shape[1]
    for i in range(count):
        sign = torch.ones(count).index_fill(0, torch.tensor([i]), -1.0)
        yield f"with the sign of {names[i]} turned", data, replace(data, action=data.action * sign.to(data.action))
    for i, j in combinations(range(count), 2):
        order = list(range(count))
        order[i], order[j] = j, i
        yield f"with {names[i]} and {names[j]} swapped", data, replace(data, action=data.action[:, order])
    follows = (data.next_state[:-1] == data.state[1:]).all(-1) & (data.trajectory[:-1] == data.trajectory[1:])
    if int(follows.sum()) >= FEWEST:
        first = follows.nonzero()[:, 0]
        late, early = data.select(first), data.select(first + 1)
        yield "with each action one control period earlier", late, replace(late, action=early.action)
        yield DELAYED, early, replace(early, action=late.action)


@torch.no_grad()
def _gain(base, recorded, other):
    """By how much the logarithm of what the model misses falls, as a standard deviation, mean of its quantities."""
    return float((_missed(base, recorded) / _missed(base, other)).log().mean())


def _missed(base, data):
    system, data = base.system, data.double()
    missed = difference(system, base(data.state, data.action), data.next_state)
    rows = [i for i, quantity in enumerate(system.quantities) if quantity in QUANTITIES] or slice(None)
    return missed[:, rows].std(0, correction=0) + MISSED  # the mean is left to wind and drag
