"""A bootstrap of a residual: the same fit to resampled flight, again and again. How far the fits differ is what the
data leave open.

Rows of a flight are no independent samples, so whole stretches of it are drawn with replacement (Kuensch 1989, "The
jackknife and the bootstrap for general stationary observations").
"""

from dataclasses import replace

import torch

from adapt.residual import fit_residual
from adapt.stretches import chains
from envs.errors import InputError

STRETCH = 20  # most control periods that are drawn together
FLIGHTS = 5  # that are enough to leave some out
LEAST = 5  # stretches to draw from, if need be shorter ones


def fit_ensemble(transitions, base, kind, members=3, seed=0, parameters=()):
    """`members` residuals of a kind, each fitted to other resampled stretches; fewer where some can't be fitted.

    Args:
        parameters: names that kind "parameters" refits in every member; without any each member chooses its own.
    """
    generator, found = torch.Generator().manual_seed(seed), []
    for _ in range(members):
        try:
            found.append(fit_residual(resampled(transitions, generator), base, kind, seed, parameters=parameters)[0])
        except InputError:  # a sample may hold too little of what a parameter does
            continue
    return found


def resampled(transitions, generator):
    """As many stretches as there are, drawn with replacement.

    One that is drawn twice stays in one flight, so that no fit is judged by what it has seen: flights stay those that
    were recorded, or are the stretches where there are too few of them to leave any out.
    """
    length = max(1, min(STRETCH, len(transitions) // LEAST))
    pieces = [
        range(first, min(first + length, last))
        for begun, last in chains(transitions)
        for first in range(begun, last, length)
    ]
    drawn = sorted(torch.randint(len(pieces), (len(pieces),), generator=generator).tolist())
    rows = torch.tensor([row for number in drawn for row in pieces[number]])
    sample = transitions.select(rows)
    if len(transitions.trajectory.unique()) >= FLIGHTS:
        return sample
    stretches = torch.tensor([number for number in drawn for _ in pieces[number]])
    return replace(sample, trajectory=stretches)


@torch.no_grad()
def spread(members, state, action):
    """Standard deviation (..., n) of the next states that the members predict: what they don't agree on."""
    return torch.stack([member(state, action) for member in members]).std(0)
