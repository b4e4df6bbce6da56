"""Linear regression that uses few inputs, each output its own, chosen by cross-validation.

Ridge regression in closed form on supports of growing size: forward selection, and backward elimination from the
largest one, which undoes an early choice that a later one made needless (Miller 2002, "Subset Selection in Regression",
ch. 3). Few transitions then give the structure and not only a curve through the data, and what is learned from slow
flight holds in fast flight.

Shapes: N rows, p inputs, k outputs, F folds, S supports of a path, L inputs in the largest of them.
"""

from dataclasses import dataclass

import torch

PENALTIES = (1e-9, 1e-4, 1e-2, 1e-1)  # [-] of inputs and outputs scaled to mean square one
NEGLIGIBLE = 1e-4  # [-] share of the signal below which a difference of errors doesn't matter
ROWS = 5  # rows that each input of a support must have: neighbouring rows are nearly copies
LARGEST = 12  # [-] inputs in a support
EXCITATION = 1e-3  # [-] an input that varies less, against the larger of 1 and its size, has shown no effect of its own
COLLINEAR = 1e-10  # [-] share of an input's square that the chosen ones must leave for it to be tried


@dataclass(frozen=True)
class SparseFit:
    """Outputs (N, k) predicted as `inputs @ weights.T` from inputs (N, p)."""

    weights: torch.Tensor  # (k, p), zero outside the support
    penalty: tuple[float, ...]  # (k)
    error: torch.Tensor  # (k) cross-validated root mean square


def blocks(trajectory, most=5, least=3):
    """Fold (N,) of each row: whole trajectories where there are at least `least`, else contiguous blocks of rows."""
    flights, index = trajectory.unique(return_inverse=True)
    if len(flights) >= least:
        return index * min(most, len(flights)) // len(flights)
    return torch.arange(len(trajectory)) * least // len(trajectory)


def fit_sparse(inputs, outputs, folds, tolerance, libraries):
    """Choose inputs and penalty of each output by cross-validation, then fit them to all rows.

    Each library has paths of its own, because in a large one an input may be hidden by near copies of it.

    Args:
        inputs: (N, p) float64; the first column is the constant 1.
        outputs: (N, k) float64.
        folds: (N,) from `blocks`.
        tolerance: (k) errors below it are rounding and count as none.
        libraries: masks (p) of the inputs to choose among, such as simple ones only, and all.
    """
    distinct = len(inputs.unique(dim=0))  # a row that is repeated says nothing new
    largest = min(inputs.shape[1], LARGEST, max(1, distinct // ROWS))
    scale = _scale(inputs)
    size = torch.maximum(outputs.square().mean(0).sqrt(), tolerance)
    scaled, wanted = inputs / scale, outputs / size
    errors = _path_errors(scaled, wanted, folds, largest, libraries)
    doubt = (ROWS / (2 * len(inputs))) ** 0.5  # relative standard error of a root mean square of N / ROWS numbers
    places, penalties = _simplest(errors, 1 + doubt, tolerance / size, largest)
    gram, moment = _moments(scaled, wanted)
    every = torch.arange(outputs.shape[1])
    support = _paths(gram[None], moment[None], largest, libraries)[0, every, places]
    chosen = torch.tensor(PENALTIES, dtype=inputs.dtype)[penalties]
    weights = _solve(gram, moment, support, chosen, largest) / scale * size[:, None]
    return SparseFit(weights, tuple(chosen.tolist()), errors[every, places, penalties] * size)


def _scale(inputs):
    """Root mean square of each column; infinite, which takes it out, where it shows no effect of its own."""
    size = inputs.square().mean(0).sqrt()
    varies = inputs.std(0, correction=0) > EXCITATION * size.clamp(min=1)
    varies[0] = True
    return torch.where(varies, size, torch.inf)


def _moments(inputs, outputs):
    """Mean products of the inputs (p, p), and of outputs and inputs (k, p)."""
    return inputs.T @ inputs / len(inputs), outputs.T @ inputs / len(inputs)


def _path_errors(inputs, outputs, folds, largest, libraries):
    """Cross-validated root mean square (k, S, penalties) of the supports that each fold's training rows give."""
    training = [folds != fold for fold in folds.unique()]
    moments = [_moments(inputs[rows], outputs[rows]) for rows in training]
    grams, products = (torch.stack(parts) for parts in zip(*moments, strict=True))
    supports = _paths(grams, products, largest, libraries)
    penalties = torch.tensor(PENALTIES, dtype=inputs.dtype)
    squares = 0
    for rows, gram, moment, support in zip(training, grams, products, supports, strict=True):
        weights = _solve(gram, moment[:, None, None], support[:, :, None], penalties, largest)  # (k, S, penalties, p)
        predicted = (inputs[~rows] @ weights.flatten(0, -2).T).unflatten(-1, weights.shape[:-1])
        squares = squares + (outputs[~rows][..., None, None] - predicted).square().sum(0)
    return (squares / len(inputs)).sqrt()


def _solve(gram, moment, support, penalty, largest):
    """Ridge weights (..., p) of the inputs in `support` (..., p), zero elsewhere.

    gram (p, p), moment (..., p) and penalty (...) broadcast. Only the chosen rows and columns are solved for.
    """
    inside, places = support.to(torch.int8).topk(largest, -1)  # (..., L), padded with inputs that aren't chosen
    inside = inside.to(gram)
    system = gram[places.unsqueeze(-1), places.unsqueeze(-2)] * inside.unsqueeze(-1) * inside.unsqueeze(-2)
    diagonal = penalty.unsqueeze(-1) * inside + (1 - inside)
    batch = diagonal.shape[:-1]
    right = moment.expand(*batch, -1).gather(-1, places.expand(*batch, -1)) * inside
    found = torch.linalg.solve(system + torch.diag_embed(diagonal), right.unsqueeze(-1)).squeeze(-1)
    return gram.new_zeros(*batch, gram.shape[-1]).scatter(-1, places.expand(*batch, -1), found)


def _paths(gram, moment, largest, libraries):
    """Supports (F, k, S, p) for gram (F, p, p), moment (F, k, p): for each library 0 to L inputs, then L to 0."""
    paths = []
    for library in libraries:
        forward = _forward(gram, moment, largest, library)
        paths += [forward, _backward(gram, moment, forward[:, :, -1], largest)]
    return torch.cat(paths, 2)


def _forward(gram, moment, largest, library):
    """Supports (F, k, L + 1, p), each adding the input that lowers the squared error most.

    The sweep operator takes a chosen input out of all that is left, so each step costs a rank-one update.
    """
    right = moment.clone()
    left = gram.unsqueeze(1).expand(*right.shape, -1).clone()
    chosen = torch.zeros_like(right, dtype=torch.bool)
    path = [chosen]
    for _ in range(largest):
        variance = left.diagonal(dim1=-2, dim2=-1)
        free = library & ~chosen & (variance > COLLINEAR)
        gain = torch.where(free, right.square() / variance.clamp(min=COLLINEAR), -1.0)
        best = gain.argmax(-1, keepdim=True)
        useful = free.gather(-1, best)
        row = left.gather(-2, best.unsqueeze(-1).expand(*best.shape, left.shape[-1])).squeeze(-2)
        share = torch.where(useful, row / torch.where(useful, row.gather(-1, best), 1.0), 0.0)
        right = right - share * right.gather(-1, best)
        left = left - share.unsqueeze(-1) * row.unsqueeze(-2)
        chosen = chosen.scatter(-1, best, chosen.gather(-1, best) | useful)
        path.append(chosen)
    return torch.stack(path, 2)


def _backward(gram, moment, support, largest):
    """Supports (F, k, L + 1, p) from `support` (F, k, p) down to none, each leaving out the least useful input.

    Leaving out input i raises the squared error by w_i^2 / (G^-1)_ii.
    """
    path = [support]
    for _ in range(largest):
        inside, places = support.to(torch.int8).topk(largest, -1)
        inside = inside.to(gram)
        rows = gram.unsqueeze(1).expand(-1, moment.shape[1], -1, -1)
        rows = rows.gather(-2, places.unsqueeze(-1).expand(*places.shape, gram.shape[-1]))
        system = rows.gather(-1, places.unsqueeze(-2).expand(*places.shape, largest))
        system = system * inside.unsqueeze(-1) * inside.unsqueeze(-2) + torch.diag_embed(1 - inside + COLLINEAR)
        inverse = torch.linalg.inv(system)
        weights = (inverse @ (moment.gather(-1, places) * inside).unsqueeze(-1)).squeeze(-1)
        loss = weights.square() / inverse.diagonal(dim1=-2, dim2=-1).clamp(min=COLLINEAR)
        worst = torch.where(inside > 0, loss, torch.inf).argmin(-1, keepdim=True)
        support = support.scatter(-1, places.gather(-1, worst), False)
        path.append(support)
    return torch.stack(path, 2)


def _simplest(errors, margin, tolerance, largest):
    """Place on the path and of the penalty (k), (k): the smallest support near the best, then the largest penalty.

    Near is an error at most `margin` times the smallest. Of two supports of one size the better one counts.
    """
    outputs, places, _ = errors.shape
    sizes = torch.cat((torch.arange(largest + 1), torch.arange(largest, -1, -1)))
    sizes = sizes.repeat(places // len(sizes))
    best = errors.min(-1).values  # (k, S)
    limit = best.min(-1).values * margin + NEGLIGIBLE + tolerance
    good = best <= limit[:, None]
    rank = torch.where(good, sizes.double() + best / (best.max() + 1), torch.inf)
    place = rank.argmin(-1)
    fits = errors[torch.arange(outputs), place] <= limit[:, None]
    return place, len(PENALTIES) - 1 - fits.flip(-1).to(torch.int8).argmax(-1)
