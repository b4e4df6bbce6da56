"""Choose the kind of residual by the flight that it predicts: `fit_residual(..., kind="auto")`.

Each kind is fitted to all flights but a fold and predicts stretches of the flights in that fold, several control
periods ahead, from a recorded state with the recorded actions. What counts is the error left of that of the model
without a residual. Of kinds that predict as well as the best, up to the doubt about the difference, the simplest is
taken.
"""

import math
from dataclasses import dataclass

import torch

from adapt.sensitivities import apart, of_start, step_slopes
from adapt.sparse_ridge import blocks
from adapt.stretches import cut, difference
from envs.errors import InputError

FOLDS = 3
AHEAD = 10  # control periods that are predicted
SOLVED = 1e-3  # [-] share of the model's error that needs no better kind
EQUAL = 0.02  # [-] difference of shares that isn't worth a more complex kind
MOTION = 1e-3  # [-] share of the motion below which an error doesn't matter


@dataclass(frozen=True)
class Tried:
    """How well a kind predicts: the share of the model's error that it leaves, of each stretch and in the mean."""

    kind: str
    shares: torch.Tensor | None  # (S,), None where it couldn't be fitted
    why: str = ""  # it couldn't

    @property
    def score(self):
        """Root of the mean square of the shares; infinite where it couldn't be fitted."""
        return math.inf if self.shares is None else float(self.shares.mean().sqrt())


def choose(data, base, kinds, fit):
    """Try kinds, the simplest first, until one leaves nothing: what was tried, and the name of the choice.

    Args:
        data: `Transitions` in float64.
        kinds: names, from the simplest to the most complex.
        fit: (transitions, kind) → residual; raises `InputError` where there are too few.
    """
    folds = blocks(data.trajectory, FOLDS)
    parts = [(data.select(folds != fold), data.select(folds == fold)) for fold in folds.unique()]
    tried = []
    for kind in kinds:
        tried.append(_try(kind, parts, base, fit))
        if tried[-1].score < SOLVED:
            break
    return tuple(tried), simplest(tried)


def _try(kind, parts, base, fit):
    shares = []
    for train, held in parts:
        try:
            shares.append(left_over(fit(train, kind), base, held))
        except (InputError, ValueError) as error:
            return Tried(kind, None, str(error))
    shares = torch.cat(shares)
    return Tried(kind, shares) if shares.isfinite().all() else Tried(kind, None, "predictions that aren't finite")


def simplest(tried):
    """The first of those that predict as well as the best, up to twice the standard error of the paired difference.

    Raises:
        InputError: none could be fitted; says why for the first.
    """
    best = min(tried, key=lambda one: one.score)
    if best.shares is None:
        raise InputError(f"transitions: no kind of residual can be fitted; {tried[0].kind}: {tried[0].why}")
    for one in tried:
        if one.shares is None:
            continue
        worse = one.shares - best.shares
        doubt = 2 * float(worse.std()) / len(worse) ** 0.5 if len(worse) > 1 else 0.0
        if float(worse.mean()) <= max(doubt, EQUAL * float(best.shares.mean()), SOLVED**2):
            return one.kind
    return best.kind


@torch.no_grad()
def left_over(residual, base, data):
    """The share (S,) of the model's squared error that a residual leaves of each stretch, averaged over its states.

    A state counts by the error of the model over all stretches, so that each has the same weight; one that the model
    predicts well compared with how it moves doesn't matter. What another state at the beginning of the stretch would
    explain isn't counted: states are measured, and a residual that takes their noise for motion predicts the next
    measurement well, and flight badly.
    """
    flown, system = cut(data, AHEAD), base.system
    start = flown.measured[:, 0]
    paths = [flown.predicted(flown.seen_by(one), start) for one in (residual, base)]
    left, before = (flown.missed(system, path) for path in paths)
    moved = difference(system, flown.measured[:, :1], flown.measured[:, 1:]).square().mean((0, 1))
    scale = torch.maximum(before.square().mean((0, 1)), MOTION**2 * moved).clamp(min=1e-18).sqrt()
    slopes = step_slopes(base, paths[1][:, :-1], flown.action)
    parts = (torch.stack((left, before), -1) / scale[:, None]).flatten(1, 2)  # (S, (T + 1) d, 2)
    rest = apart(parts, (of_start(slopes) / scale[:, None]).flatten(1, 2)).square().mean(1)
    return rest[:, 0] / rest[:, 1].mean().clamp(min=1e-18)
