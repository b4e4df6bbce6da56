"""Choose the kind of residual by the flight that it predicts: `fit_residual(..., kind="auto")`.

Each kind is fitted to all flights but a fold and predicts stretches of the flights in that fold, several control
periods ahead, from a recorded state with the recorded actions. What counts is the error in each state compared with
that of the kind that predicts this state best: a state that none can predict, because noise is all that is left, tells
nothing. Of kinds that predict as well as the best, up to the doubt about the difference, the simplest is taken.
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
EQUAL = 0.02  # [-] difference of errors, in units of the best, that isn't worth a more complex kind
MOTION = 1e-3  # [-] share of the motion below which an error doesn't matter


@dataclass(frozen=True)
class Tried:
    """How well a kind predicts: squared errors of each stretch, in units of the best kind's, averaged over states."""

    kind: str
    squares: torch.Tensor | None  # (S,), None where it couldn't be fitted
    why: str = ""  # it couldn't

    @property
    def score(self):
        """Root mean square error in units of the best kind's; infinite where it couldn't be fitted."""
        return math.inf if self.squares is None else float(self.squares.mean().sqrt())


def choose(data, base, kinds, fit):
    """Try kinds, the simplest first, until one leaves nothing: what was tried, the name of the choice, and whether it
    leaves nothing.

    Args:
        data: `Transitions` in float64.
        kinds: names, from the simplest to the most complex.
        fit: (transitions, kind) → residual; raises `InputError` where there are too few.

    Raises:
        InputError: no kind can be fitted; says why for the first.
        ValueError: no flight is long enough to predict.
    """
    folds = blocks(data.trajectory, FOLDS)
    parts = [(data.select(folds != fold), data.select(folds == fold)) for fold in folds.unique()]
    held = [HeldOut(base, part) for _, part in parts]
    missed, reasons, solved = {}, {}, False
    for kind in kinds:
        try:
            found = [flown.missed(fit(train, kind)) for (train, _), flown in zip(parts, held, strict=True)]
            if not all(part.isfinite().all() for part in found):
                raise ValueError("predictions that aren't finite")
        except (InputError, ValueError) as error:
            reasons[kind] = str(error)
            continue
        missed[kind] = found
        if solved := all(flown.share(part) < SOLVED**2 for flown, part in zip(held, found, strict=True)):
            break
    if not missed:
        kind, why = next(iter(reasons.items()))
        raise InputError(f"transitions: no kind of residual can be fitted; {kind}: {why}")
    scored = _scored(missed, held)
    named = [kind for kind in kinds if kind in scored or kind in reasons]
    tried = tuple(Tried(kind, scored.get(kind), reasons.get(kind, "")) for kind in named)
    return tried, simplest(tried), solved


def _scored(missed, held):
    """{kind: squares (S,)} from {kind: errors (S, T + 1, d) of each fold}, in units of the best kind's."""
    floor = MOTION**2 * torch.cat([flown.moved for flown in held]).mean(0)
    errors = torch.stack([torch.cat([part.square().mean(1) for part in parts]).mean(0) for parts in missed.values()])
    scale = torch.maximum(errors.amin(0), floor).clamp(min=1e-18).sqrt()
    rest = {
        kind: torch.cat([flown.unexplained(part, scale) for flown, part in zip(held, parts, strict=True)])
        for kind, parts in missed.items()
    }
    best = torch.stack([squares.mean(0) for squares in rest.values()]).amin(0)
    units = torch.maximum(best, floor).clamp(min=1e-18)
    return {kind: (squares / units).mean(-1) for kind, squares in rest.items()}


class HeldOut:
    """Stretches of held-out flight: how far dynamics miss them.

    Raises:
        ValueError: no flight is as long as the shortest stretch.
    """

    @torch.no_grad()
    def __init__(self, base, data):
        self.system, self.flown = base.system, cut(data, AHEAD)
        self.start = self.flown.measured[:, 0]
        path = self.flown.predicted(base, self.start)
        self.before = self.flown.missed(self.system, path)
        self.of_start = of_start(step_slopes(base, path[:, :-1], self.flown.action))
        way = difference(self.system, self.flown.measured[:, :1], self.flown.measured[:, 1:])
        self.moved = way.square().mean(1)  # (S, d)

    @torch.no_grad()
    def missed(self, dynamics):
        """What leads (S, T + 1, d) from the predicted to the measured states."""
        path = self.flown.predicted(self.flown.seen_by(dynamics), self.start)
        return self.flown.missed(self.system, path)

    def share(self, missed):
        """The share of the model's squared error that is left, averaged over the states."""
        floor = MOTION**2 * self.moved.mean(0)
        before = torch.maximum(self.before.square().mean((0, 1)), floor).clamp(min=1e-18)
        return float((missed.square().mean((0, 1)) / before).mean())

    def unexplained(self, missed, scale):
        """Mean squares (S, d) of what no other state at the beginning of a stretch would explain.

        States are measured, and a residual that takes their noise for motion predicts the next measurement well, and
        flight badly.

        Args:
            scale: (d,) errors that states are expected to have.
        """
        parts, basis = ((part / scale[:, None]).flatten(1, 2) for part in (missed[..., None], self.of_start))
        return apart(parts, basis).unflatten(1, missed.shape[1:])[..., 0].square().mean(1) * scale.square()


def simplest(tried):
    """The first of those that predict as well as the best, up to twice the standard error of the paired difference."""
    best = min(tried, key=lambda one: one.score)
    for one in tried:
        if one.squares is None:
            continue
        worse = one.squares - best.squares
        doubt = 2 * float(worse.std()) / len(worse) ** 0.5 if len(worse) > 1 else 0.0
        if float(worse.mean()) <= max(doubt, EQUAL * float(best.squares.mean())):
            return one.kind
    return best.kind
