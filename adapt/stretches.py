"""Stretches of recorded flight, and how far dynamics stray from them when they are left to themselves."""

from dataclasses import dataclass
from itertools import pairwise

import torch

SHORTEST = 3  # control periods


@dataclass(frozen=True)
class Stretches:
    """M stretches of T control periods without a gap."""

    measured: torch.Tensor  # (M, T + 1, n) states
    action: torch.Tensor  # (M, T, m)
    trajectory: torch.Tensor  # (M,) flight that each is of
    context: torch.Tensor | None = None  # (M, c) at its beginning
    repeated: float = 1.0  # [-] how often a transition stands in them, on average

    def seen_by(self, dynamics):
        """The dynamics with the context that each stretch begins with, if they take any."""
        names = getattr(getattr(dynamics, "config", None), "context_names", ())
        return dynamics.with_context(self.context) if names else dynamics

    def predicted(self, dynamics, start):
        """The states (M, T + 1, n) that the recorded actions lead to from `start` (M, n)."""
        states = [start]
        for action in self.action.unbind(1):
            states.append(dynamics(states[-1], action))
        return torch.stack(states, 1)

    def missed(self, system, predicted):
        """What leads (M, T + 1, d) from predicted to measured states, in the tangent space."""
        return difference(system, predicted, self.measured)


def cut(data, length):
    """Flights cut into stretches of `length` control periods, or of fewer where most flights are shorter.

    What a stretch tells about an acceleration grows with the cube of its length: the length is taken that tells most in
    all, and flights that are shorter are left out. The last stretch of a flight overlaps the one before it, so that
    nothing of it is.

    Raises:
        ValueError: no flight is as long as the shortest stretch.
    """
    unbroken = chains(data)
    longest = max((last - first for first, last in unbroken), default=0)
    if longest < SHORTEST:
        raise ValueError(f"flights of {longest} transitions without a gap, expected {SHORTEST}")
    covered = {
        tried: sum(last - first for first, last in unbroken if last - first >= tried)
        for tried in range(min(length, longest), SHORTEST - 1, -1)
    }
    length = max(covered, key=lambda tried: covered[tried] * tried**2)  # of equals the longest
    long = [(first, last) for first, last in unbroken if last - first >= length]
    starts = [min(start, last - length) for first, last in long for start in range(first, last, length)]
    rows = torch.tensor(starts)[:, None] + torch.arange(length)
    first = rows[:, 0]
    measured = torch.cat((data.state[rows], data.next_state[rows[:, -1:]]), 1)
    context = None if data.context is None else data.context[first]
    return Stretches(measured, data.action[rows], data.trajectory[first], context, rows.numel() / covered[length])


def chains(data):
    """(first, last + 1) of rows that each begin where the one before ended."""
    follows = (data.next_state[:-1] == data.state[1:]).all(-1) & (data.trajectory[:-1] == data.trajectory[1:])
    breaks = [0, *((~follows).nonzero()[:, 0] + 1).tolist(), len(data)]
    return list(pairwise(breaks))


def difference(system, states, others):
    """What leads from states to others (..., n), as (..., d)."""
    x, y = (system.State(*part.unbind(-1)) for part in torch.broadcast_tensors(states, others))
    return torch.stack(system.difference(x, y), -1)


def displaced(system, states, deltas):
    """The states (..., n) that deltas (..., d) lead to."""
    shape = torch.broadcast_shapes(states.shape[:-1], deltas.shape[:-1])
    x = system.State(*states.expand(*shape, -1).unbind(-1))
    return torch.stack(tuple(system.displaced(x, deltas.expand(*shape, -1).unbind(-1))), -1)
