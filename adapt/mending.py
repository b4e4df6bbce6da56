"""Recorded transitions as they should be: each once, in the order in which they were flown, and of one robot.

What is recorded goes through many hands. A fit is sure of itself where rows are repeated, and blind to time where they
are shuffled; and flight from before a change of the robot contradicts what came after it.
"""

from itertools import pairwise

import torch

from adapt.choose_residual import MOTION, HeldOut
from adapt.residual import fit_residual
from adapt.transitions import joined
from envs.errors import InputError

# Transitions that are left to learn from, at least. A robot that sticks now and then, or flies a manoeuvre for long, is
# predicted best by a fit to that alone, so fewer would tell of changes where there are none.
SHORTEST = 60
SMALLEST = 16  # the newest flight that is asked is no smaller a part than one of so many
QUICK = "linear"  # kind of residual that tells whether flights are of one robot
CONTRADICTS = 2.0  # times the error that newer flight leaves of itself, beyond which older flight is another robot's


def mended(transitions):
    """The transitions without repeated rows, each flight in order of time; and notes on what was done, as sentences.

    A row of another flight is repeated, too, so that a log that is given twice counts once.
    """
    keys = _keys(torch.cat((transitions.state, transitions.action, transitions.next_state), -1))
    first = {}
    for number, key in enumerate(keys):
        first.setdefault(key, number)
    notes, kept = [], list(first.values())
    if len(kept) < len(keys):
        notes.append(f"{len(keys) - len(kept)} of {len(keys)} transitions were repeated rows, and left out")
        transitions = transitions.select(torch.tensor(kept))
    order = _in_time(transitions)
    if order != list(range(len(order))):
        notes.append("transitions were not in the order in which they were flown, and were put in order")
        transitions = transitions.select(torch.tensor(order))
    return transitions, notes


def _keys(rows):
    return [row.tobytes() for row in rows.cpu().numpy()]


def _in_time(transitions):
    """The order of rows in which each follows the one whose end it begins with, where there is one.

    Flights come as they stand; by their numbers where rows of one are among those of another.
    """
    flights = transitions.trajectory.tolist()
    following = _followers(transitions)
    followers = set(following.values())
    starts = [number for number in range(len(flights)) if number not in followers]
    order, seen = [], set()
    for start in (*starts, *range(len(flights))):  # circles have no start
        while start is not None and start not in seen:
            seen.add(start)
            order.append(start)
            start = following.get(start)
    named = list(dict.fromkeys(flights))
    mixed = sum(one != other for one, other in pairwise(flights)) >= len(named)
    position = {flight: place for place, flight in enumerate(sorted(named) if mixed else named)}
    return sorted(order, key=lambda number: position[flights[number]])


def _followers(transitions):
    """{row: the one that follows it in its flight}: the next row if it does, else the first of those that are left.

    A robot may come to the same state again, at rest above all, so that several rows begin where one ends.
    """
    flights = transitions.trajectory.tolist()
    begins, ends = (
        list(zip(flights, _keys(states), strict=True)) for states in (transitions.state, transitions.next_state)
    )
    count = len(flights)
    following = {number: number + 1 for number in range(count - 1) if ends[number] == begins[number + 1]}
    left = {}
    for number in sorted(set(range(count)) - set(following.values())):
        left.setdefault(begins[number], []).append(number)
    for number in range(count):
        if number not in following and (found := [one for one in left.get(ends[number], ()) if one != number]):
            following[number] = found[0]
            left[ends[number]].remove(found[0])
    return following


def still_true(transitions, base, seed=0):
    """The newest transitions that one residual explains; all, unless older flight contradicts newer.

    The newest half, quarter, … is predicted, a part at a time, by residuals fitted to all other flight and to the other
    part alone. Where the first are far worse, what is older is left out, and what is left is asked again.
    """
    tail = len(transitions) // 2
    while tail >= max(SHORTEST, len(transitions) // SMALLEST):
        split = len(transitions) - tail
        older, newer = transitions.select(slice(0, split)), transitions.select(slice(split, None))
        try:
            if _contradict(older, newer, base, seed):
                transitions = newer
        except (InputError, ValueError):  # too short to tell
            break
        tail //= 2
    return transitions


def _contradict(older, newer, base, seed):
    cut = len(newer) // 2
    parts = [newer.select(slice(0, cut)), newer.select(slice(cut, None))]
    errors = []
    for learned, held in (parts, parts[::-1]):
        flown = HeldOut(base, held.double())
        fits = [fit_residual(data, base, QUICK, seed)[0] for data in (joined((older, learned)), learned)]
        found = [flown.missed(residual).square().mean((0, 1)) for residual in fits]
        errors.append(torch.stack([*found, flown.moved.mean(0)]))
    by_all, by_newer, moved = torch.stack(errors).mean(0)
    units = torch.maximum(by_newer, MOTION**2 * moved).clamp(min=1e-18)
    return float((by_all / units).mean().sqrt()) > CONTRADICTS
