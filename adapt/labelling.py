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
SURE = 5.0  # standard errors of it: few noisy transitions may fall into any pattern
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
    found = [(*_gain(base, recorded, other), words) for words, recorded, other in _labellings(transitions)]
    sure = [(gain, words) for gain, doubt, words in found if gain > max(FAR_BETTER, SURE * doubt)]
    if sure:
        gain, words = max(sure)
        better = f"the model explains them {math.exp(gain):.1f} times as well {words}"
        if words != DELAYED:
            raise InputError(f"transitions: {better}; put the actions, or the axes, right and begin again")
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
    """By how much the logarithm of what the model misses falls, mean of its quantities, and the standard error of it.

    What is missed is a standard deviation over the transitions; its logarithm is half that of the mean square.
    """
    squares = [_squares(base, data) for data in (recorded, other)]
    means = [square.mean(0) + MISSED**2 for square in squares]
    each = [(square / mean).mean(-1) / 2 for square, mean in zip(squares, means, strict=True)]
    gain = (means[0] / means[1]).log().mean() / 2
    return float(gain), float((each[0] - each[1]).std()) / len(each[0]) ** 0.5


def _squares(base, data):
    """(N, k) what the model misses, squared; its mean is left to wind and drag."""
    system, data = base.system, data.double()
    missed = difference(system, base(data.state, data.action), data.next_state)
    rows = [i for i, quantity in enumerate(system.quantities) if quantity in QUANTITIES] or slice(None)
    return (missed[:, rows] - missed[:, rows].mean(0)).square()
