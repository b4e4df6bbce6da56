"""The newest transitions of a flight that goes on, without what was flown before the target changed.

A change shows in what the present model misses: the errors of the newest transitions are far larger than those before.
It is placed where two stretches, each with errors of a size of its own, explain what is missed best (a likelihood ratio
of Gaussian errors whose variance changes once), and what is older is dropped.
"""

import math

import torch

from adapt.fit_parameters import EXPLAINED
from adapt.prediction import predict
from adapt.transitions import Transitions

SHORTEST = 5  # control periods on either side of a change
EVIDENCE = 12.0  # [-] logarithm of the likelihood ratio that tells of a change
WORSE = 2.0  # [-] times the mean square error that a change brings


class Window:
    """Transitions of the last `seconds`, at most back to the last change."""

    def __init__(self, system, seconds):
        self.system, self.most, self.rows, self.changed = system, max(1, round(seconds / system.dt)), [], -math.inf

    def __len__(self):
        return len(self.rows)

    def add(self, time, row):
        """Take up what was flown at a time: (state, action, next state, leg); None was nothing."""
        if row is not None:
            self.rows.append((time, *row))
        self.rows = self.rows[-self.most :]

    def forget(self, dynamics):
        """Drop what is older than a change that dynamics don't know of; the time of it [s], None without one."""
        if len(self) < 2 * SHORTEST:
            return None
        first = change_point(missed(dynamics, self.transitions()))
        if first is None:
            return None
        self.rows = self.rows[first:]
        self.changed = self.rows[0][0]
        return self.changed

    def transitions(self):
        """The rows as `Transitions`, each leg a trajectory."""
        _, *tensors, leg = zip(*self.rows, strict=True)
        state, action, following = (torch.stack(part) for part in tensors)
        names = self.system.State._fields, self.system.Action._fields
        return Transitions(state, action, following, torch.tensor(leg), self.system.dt, self.system.name, *names)


@torch.no_grad()
def missed(dynamics, transitions):
    """Accelerations (N, k) that dynamics miss over a control period [m/s^2, rad/s^2]."""
    rows = [transitions.state_names.index(name) for name in dynamics.system.accelerations]
    difference = transitions.next_state.double() - predict(dynamics, transitions).double()
    return difference[:, rows] / transitions.dt


def change_point(errors):
    """The first row of `errors` (N, k) from which on they are larger than before; None where they aren't.

    None, too, where that seems to be as late as can be told: the change may be later still.
    """
    squares = errors.square()
    count, sums = len(squares), squares.cumsum(0)
    before = torch.arange(SHORTEST, count - SHORTEST + 1)
    early = sums[before - 1] / before[:, None] + EXPLAINED**2
    late = (sums[-1] - sums[before - 1]) / (count - before)[:, None] + EXPLAINED**2
    whole = sums[-1] / count + EXPLAINED**2
    ratio = 0.5 * (count * whole.log() - before[:, None] * early.log() - (count - before)[:, None] * late.log()).sum(-1)
    best = int(ratio.argmax())
    told = best < len(before) - 1 and bool(ratio[best] > EVIDENCE) and bool((late[best] / early[best]).mean() > WORSE)
    return int(before[best]) if told else None


def likelihood(dynamics, transitions):
    """Logarithm of the likelihood of what dynamics miss, if it is Gaussian; only differences of it mean something."""
    squares = missed(dynamics, transitions).square().mean(0) + EXPLAINED**2
    return float(-0.5 * len(transitions) * squares.log().sum())
