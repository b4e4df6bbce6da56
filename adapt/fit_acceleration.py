"""Fit an acceleration residual: a sparse linear part by cross-validation, then a network on what that leaves.

Both explain the push (an acceleration held over a step) that would have led to the recorded next state.
"""

import torch

from adapt.correction import normalise, solve
from adapt.correction import train as train_network
from adapt.prediction import bound, predict, prediction_error
from adapt.sparse_ridge import SparseFit, blocks, fit_sparse
from envs.errors import InputError

NEGLIGIBLE = 1e-4  # [m/s^2, rad/s^2] what no network is trained for
ROUNDING = 2 * torch.finfo(torch.float32).eps  # [-] of a recorded number
SETTLED = 1e-6  # change of the weights at which their fit has converged


def fit_acceleration(residual, data, train, held, settings, generator):
    """Linear part and network on `train`, judged on `held`; then on all data the linear part where no network is."""
    network, residual.network = residual.network, None
    _fit_linear(residual, train, settings.linear)
    misled = _misled(residual, held)
    residual.weights[misled], residual.bias[misled] = 0.0, 0.0
    stays = torch.zeros(len(residual.bias), dtype=torch.bool)
    if network is not None:
        stays = _fit_network(residual, network, train, held, settings, generator)
        residual.network = network if stays.any() else None
    after = prediction_error(residual, held)
    weights, bias = residual.weights.clone(), residual.bias.clone()
    residual.network = None
    fit = _fit_linear(residual, data, settings.linear)
    seen = stays | misled  # what the network was trained on, and what is better left alone
    residual.weights[seen], residual.bias[seen] = weights[seen], bias[seen]
    if stays.any():
        residual.network = network
    else:
        residual.drop_network()
    choice = _choice(residual, fit, stays)
    residual.simplify()
    return choice, after


def _misled(residual, held):
    """Which outputs (k) the linear part explains worse than nothing does, on transitions that it has not seen."""
    rows = [held.state_names.index(name) for name in residual.system.accelerations]
    errors = [(predict(d, held) - held.next_state)[:, rows].square().mean(0) for d in (residual, residual.base)]
    return errors[0] > errors[1] + (held.dt * _rounding(residual.system, held)).square()


def _choice(residual, fit, stays):
    system, names = residual.system, ("1", *residual.feature_names())
    table = _linear(residual) != 0
    chosen = [tuple(name for name, used in zip(names, row, strict=True) if used) for row in table.tolist()]
    return {
        "inputs": dict(zip(system.accelerations, chosen, strict=True)),
        "penalty": dict(zip(system.accelerations, fit.penalty, strict=True)),
        "network": tuple(name for name, on in zip(system.accelerations, stays.tolist(), strict=True) if on),
    }


@torch.no_grad()
def _fit_linear(residual, data, any_input=True, rounds=8):
    """Set weights and bias so that the step, not its start, is explained; without `any_input`, none but zero.

    A push held over a step answers to the mean of the inputs over it, so outputs are regressed on that mean, along the
    path that the residual of the last round predicts. (The recorded end of the step would carry its measurement noise
    into the inputs, and the fit would explain the noise by itself.) What the fitted step then still misses is added to
    what the weights explain, and the regression is repeated: it converges in a few rounds to weights whose own step
    misses nothing that they can express.
    """
    _set_linear(residual, torch.zeros(len(residual.bias), 1 + residual.weights.shape[1], dtype=torch.float64))
    if not any_input:
        return SparseFit(_linear(residual), (0.0,) * len(residual.bias), residual.bias)
    seen = bound(residual, data)
    slopes = _push_slopes(seen, data)
    missed = unexplained(seen, data, slopes)
    libraries = _libraries(residual)
    folds, noise = blocks(data.trajectory), _rounding(residual.system, data)
    size = missed.square().mean(0) + (100 * noise).square()
    best, weights = (float("inf"), None), _linear(residual)
    for _ in range(rounds):
        inputs = torch.cat((torch.ones(len(data), 1, dtype=torch.float64), _mean_features(seen, data)), -1)
        fit = fit_sparse(inputs, inputs @ weights.T + missed, folds, noise, libraries)
        change, weights = (fit.weights - weights).abs().max(), fit.weights
        _set_linear(residual, weights)
        missed = unexplained(seen, data, slopes)
        error = float((missed.square().mean(0) / size).sum())
        if not error < best[0]:
            break
        best = (error, fit)
        if change < SETTLED:
            break
    if best[1] is None:
        raise InputError("transitions: no linear residual gives finite predictions; check units and columns")
    _set_linear(residual, best[1].weights)
    return best[1]


def _linear(residual):
    """Bias and weights as one table (k, 1 + f)."""
    return torch.cat((residual.bias[:, None], residual.weights), -1)


def _set_linear(residual, table):
    residual.bias.copy_(table[:, 0])
    residual.weights.copy_(table[:, 1:])


def _libraries(residual):
    """Masks over the constant and the features: without products, with those of the speed, and all."""
    inputs, factors = len(residual.system.residual_input_names), residual.config.factors
    block = [0] * inputs + [place for place in range(1, 1 + len(factors)) for _ in range(inputs)]
    block = torch.tensor([0, *block, *(0 for _ in residual.config.context_names)])
    return tuple(block <= last for last in sorted({0, min(1, len(factors)), len(factors)}))


def _rounding(system, data):
    """What storing the states in their dtype does to the accelerations (k) that explain them."""
    rows = [data.state_names.index(name) for name in system.accelerations]
    return ROUNDING * data.next_state[:, rows].square().mean(0).sqrt() / data.dt + 1e-9


@torch.no_grad()
def unexplained(residual, data, slopes=None, rounds=3):
    """The held push (N, k) that would have led to the recorded next state, beyond what the residual does.

    Newton's method on the rows `accelerations`, with the slopes of the first round: a step is nearly affine in a push.
    """
    rows = [data.state_names.index(name) for name in residual.system.accelerations]
    slopes = _push_slopes(residual, data) if slopes is None else slopes
    push = torch.zeros(len(data), len(rows), dtype=data.state.dtype)
    for _ in range(rounds):
        missed = (data.next_state - residual.pushed(data.state, data.action, push))[:, rows]
        push = push + torch.linalg.solve(slopes, missed.unsqueeze(-1)).squeeze(-1)
    return push


@torch.enable_grad()
def _push_slopes(residual, data):
    """Derivative (N, k, k) of the rows `accelerations` of the next state by the push."""
    rows = [data.state_names.index(name) for name in residual.system.accelerations]
    push = torch.zeros(len(data), len(rows), dtype=data.state.dtype, requires_grad=True)
    following = residual.pushed(data.state, data.action, push)
    slopes = [torch.autograd.grad(following[:, row].sum(), push, retain_graph=True)[0] for row in rows]
    return torch.stack(slopes, 1)


def _mean_features(residual, data):
    """Mean (N, f) of what the linear part sees over each predicted step, by Simpson's rule."""
    middle, end = (residual.pushed(data.state, data.action, share=share) for share in (0.5, 1.0))
    ends = residual.features(data.state, data.action) + residual.features(end, data.action)
    return (ends + 4 * residual.features(middle, data.action)) / 6


def _fit_network(residual, network, train, held, settings, generator):
    """Train the network on what the linear part leaves; switch it off where it doesn't help, return where it does (k).

    The gain must exceed the margin and twice its standard error over blocks of neighbouring rows.
    """
    (seen_train, targets), (seen_held, wanted) = (_left(residual, part) for part in (train, held))
    features = bound(residual, train).features(train.state, train.action)
    signal = targets + features @ residual.weights.T + residual.bias
    left = targets.square().mean(0).sqrt() > settings.left * signal.square().mean(0).sqrt() + NEGLIGIBLE
    if not left.any():
        return left
    normalise(network, seen_train, targets)
    if network.activation == "cos":
        solve(network, seen_train, targets, seen_held, wanted, left)
    else:
        train_network(network, seen_train, targets, seen_held, wanted, left, settings, generator)
    with torch.no_grad():
        gains = wanted.square() - (wanted - network(seen_held)).square()
    network.size[~(left & _surely_better(gains, wanted.square(), settings.gain))] = 0.0
    return network.size != 0


def _left(residual, data):
    seen = bound(residual, data)
    return seen.inputs(data.state, data.action), unexplained(seen, data)


def _surely_better(gains, before, margin, neighbours=5):
    """Whether the mean gain (N, k) -> (k) of squared errors passes the margin and twice its standard error."""
    groups = max(1, len(gains) // neighbours)
    means = torch.stack([part.mean(0) for part in gains.tensor_split(groups)])
    doubt = means.std(0) / groups**0.5 if groups > 1 else torch.full_like(means[0], torch.inf)
    needed = (1 - (1 - margin) ** 2) * before.mean(0)
    return means.mean(0) > torch.maximum(needed, 2 * doubt)
