"""Fit a residual to transitions, and say how much better it predicts.

The default residual is a sparse linear acceleration, chosen by cross-validation (see `sparse_ridge`), and a small
network that learns what the linear part leaves and stays only where it improves held-out transitions.
"""

import time
from dataclasses import dataclass, field, replace

import torch

from adapt.residual_dynamics import (
    RESIDUALS,
    SPEED,
    AccelerationResidual,
    ResidualConfig,
    ResidualDynamics,
    StateResidual,
    load_residual,
    make_residual,
)
from adapt.sparse_ridge import blocks, fit_sparse
from adapt.transitions import QUATERNION, Transitions, check
from envs.errors import InputError

NEGLIGIBLE = 1e-4  # [m/s^2, rad/s^2] what no network is trained for
ROUNDING = 2 * torch.finfo(torch.float32).eps  # [-] of a recorded number
SETTLED = 1e-6  # change of the weights at which their fit has converged
MINIMUM = 10  # transitions; fewer say nothing about what to leave out
# Rows of the state by what they measure: prediction errors are reported for each group that a system has.
GROUPS = {
    "position": ("px", "py", "pz", "x"),
    "velocity": ("vx", "vy", "vz", "u_b", "v_b", "w_b", "v"),
    "attitude": (*QUATERNION, "theta"),
    "rates": ("p", "q", "r", "omega"),
}


@dataclass(frozen=True)
class FitSettings:
    """How a residual is fitted."""

    network: bool = True
    hidden: int = 64  # width of the network
    held_out: float = 0.2  # share of the trajectories that validates
    steps: int = 500  # most gradient steps of the network
    patience: int = 150  # steps without improvement before it stops
    batch: int = 512  # transitions in a gradient step
    rate: float = 1e-2  # Adam's first learning rate
    decay: float = 1e-4  # pull of the network's weights to zero
    left: float = 1e-2  # share of the signal that the linear part must leave for a network to be tried
    gain: float = 0.02  # share by which the network must lower the held-out error of an output to stay


@dataclass(frozen=True)
class FitReport:
    """What was chosen and what it is worth.

    `before` and `after` are one-step errors (see `prediction_error`) on the held-out transitions, `after` of a residual
    fitted without them; the residual that is returned has seen all.
    """

    kind: str
    transitions: int
    trajectories: int
    held_out: int  # transitions that `before` and `after` are measured on
    before: dict[str, float]
    after: dict[str, float]
    seconds: float
    inputs: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of the linear part, by output
    penalty: dict[str, float] = field(default_factory=dict)  # of the ridge, by output
    network: tuple[str, ...] = ()  # outputs where a network stays
    warnings: tuple[str, ...] = ()


def fit_residual(transitions, base, kind="acceleration", seed=0, settings=FitSettings()):
    """Learn what `base` lacks to explain the transitions.

    Returns:
        the fitted `ResidualDynamics`, whose context is unset if it has any, and a `FitReport`.

    Raises:
        InputError: unknown kind, fewer than `MINIMUM` transitions, another system or control period, a number that
            isn't finite, or a state from which the model's own prediction isn't.
    """
    began = time.perf_counter()
    check(transitions, base.system, MINIMUM)
    generator = torch.Generator().manual_seed(seed)
    data = _in_double(transitions)
    names = transitions.context_names
    config = ResidualConfig(kind, settings.hidden if settings.network else 0, names, (SPEED, *names))
    _check_prediction(base, data)
    train, held = data.split(1 - settings.held_out, generator)  # before the network draws its weights
    residual = make_residual(base, config, generator)
    choice, after = FITS[kind](residual, data, train, held, settings, generator)
    before = prediction_error(base, held)
    report = FitReport(
        kind=kind,
        transitions=len(data),
        trajectories=len(data.trajectory.unique()),
        held_out=len(held),
        before=before,
        after=after,
        seconds=time.perf_counter() - began,
        warnings=_warnings(held, before, after),
        **choice,
    )
    return residual, report


@torch.no_grad()
def prediction_error(dynamics, transitions):
    """One-step errors of dynamics: root mean square of the norm of each group of rows in `GROUPS` that the system has.

    position [m], velocity [m/s], attitude [- for quaternions, else rad], rates [rad/s], and `acceleration` [m/s^2] and
    `angular_acceleration` [rad/s^2], the errors of velocity and rates over the control period.
    """
    difference = predict(dynamics, transitions) - transitions.next_state
    names = transitions.state_names
    errors = {}
    for group, members in GROUPS.items():
        if rows := [i for i, name in enumerate(names) if name in members]:
            errors[group] = float(difference[:, rows].square().sum(-1).mean().sqrt())
    for rate, group in (("acceleration", "velocity"), ("angular_acceleration", "rates")):
        if group in errors:
            errors[rate] = errors[group] / transitions.dt
    return errors


def predict(dynamics, transitions):
    """Next states (N, n) that dynamics predict; a quaternion has the sign of the recorded one."""
    following = bound(dynamics, transitions)(transitions.state, transitions.action)
    if set(QUATERNION) <= set(transitions.state_names):
        columns = [transitions.state_names.index(name) for name in QUATERNION]
        agrees = (following[:, columns] * transitions.next_state[:, columns]).sum(-1, keepdim=True) >= 0
        sign = torch.ones_like(following)
        sign[:, columns] = torch.where(agrees, 1.0, -1.0).to(following).expand(-1, 4)
        following = following * sign
    return following


def bound(dynamics, transitions):
    """Dynamics that see the context of the transitions, row by row, if they take any."""
    if isinstance(dynamics, ResidualDynamics) and dynamics.config.context_names:
        return dynamics.with_context(transitions.context)
    return dynamics


def _in_double(transitions):
    parts = {name: getattr(transitions, name).double() for name in ("state", "action", "next_state")}
    context = None if transitions.context is None else transitions.context.double()
    return replace(transitions, **parts, context=context)


def _check_prediction(base, data):
    with torch.no_grad():
        lost = (~base(data.state, data.action).isfinite()).any(-1).nonzero()
    if len(lost):
        raise InputError(
            f"transitions: row {int(lost[0]) + 1}: {data.system}'s model can't go on from this state; remove it"
        )


def _warnings(held, before, after):
    """Signs that data and model don't belong together."""
    found = []
    for group in ("velocity", "rates"):
        if group not in before:
            continue
        if after[group] > 1.05 * before[group] + 1e-5:
            found.append(f"held-out {group} is predicted worse than without the residual: too few transitions?")
        rows = [i for i, name in enumerate(held.state_names) if name in GROUPS[group]]
        moved = float((held.next_state - held.state)[:, rows].square().sum(-1).mean().sqrt())
        if after[group] > moved + 1e-5:
            found.append(
                f"held-out {group} is predicted worse than if nothing changed: wrong units, columns or period?"
            )
    return tuple(found)


# --- acceleration -----------------------------------------------------------------------------------------------------


def _fit_acceleration(residual, data, train, held, settings, generator):
    """Linear part and network on `train`, judged on `held`; then on all data the linear part where no network is."""
    network, residual.network = residual.network, None
    _fit_linear(residual, train)
    misled = _misled(residual, held)
    residual.weights[misled], residual.bias[misled] = 0.0, 0.0
    stays = torch.zeros(len(residual.bias), dtype=torch.bool)
    if network is not None:
        stays = _fit_network(residual, network, train, held, settings, generator)
        residual.network = network if stays.any() else None
    after = prediction_error(residual, held)
    weights, bias = residual.weights.clone(), residual.bias.clone()
    residual.network = None
    fit = _fit_linear(residual, data)
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
def _fit_linear(residual, data, rounds=8):
    """Set weights and bias so that the step, not its start, is explained.

    A push held over a step answers to the mean of the inputs over it, so outputs are regressed on that mean, along the
    path that the residual of the last round predicts. (The recorded end of the step would carry its measurement noise
    into the inputs, and the fit would explain the noise by itself.) What the fitted step then still misses is added to
    what the weights explain, and the regression is repeated: it converges in a few rounds to weights whose own step
    misses nothing that they can express.
    """
    _set_linear(residual, torch.zeros(len(residual.bias), 1 + residual.weights.shape[1], dtype=torch.float64))
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
    _normalise(network, seen_train, targets)
    _train(network, seen_train, targets, seen_held, wanted, left, settings, generator)
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


def _normalise(network, inputs, targets):
    """Inputs to zero mean and unit spread, where they vary; outputs in units of the targets."""
    spread = inputs.std(0)
    network.mean.copy_(inputs.mean(0))
    network.scale.copy_(torch.where(spread > 1e-3, spread, 1.0))
    network.size.copy_(targets.square().mean(0).sqrt().clamp(min=1e-12))


def _train(network, inputs, targets, held_inputs, held_targets, outputs, settings, generator):
    """Adam with early stopping, in float32 and normalised units; `outputs` (k) are those that count. In place."""
    names = ("first", "first_bias", "last", "last_bias")
    weights = [getattr(network, name).float().requires_grad_() for name in names]
    x, held_x = (((z - network.mean) / network.scale).float() for z in (inputs, held_inputs))
    y, held_y = ((t / network.size)[:, outputs].float() for t in (targets, held_targets))

    def loss(x, y):
        hidden = torch.tanh(x @ weights[0].T + weights[1])
        return (hidden @ weights[2][outputs].T + weights[3][outputs] - y).square().mean()

    optimizer = torch.optim.AdamW(weights, lr=settings.rate, weight_decay=settings.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    best, since = (float(held_y.square().mean()), [w.detach().clone() for w in weights]), 0
    for step in range(settings.steps):
        rows = slice(None)
        if len(x) > settings.batch:
            rows = torch.randint(len(x), (settings.batch,), generator=generator)
        optimizer.zero_grad()
        loss(x[rows], y[rows]).backward()
        optimizer.step()
        schedule.step()
        since += 1
        if step % 10 == 9:
            with torch.no_grad():
                held = float(loss(held_x, held_y))
            if held < best[0]:
                best, since = (held, [w.detach().clone() for w in weights]), 0
        if since > settings.patience:
            break
    for name, weight in zip(names, best[1], strict=True):
        getattr(network, name).copy_(weight)


# --- state ------------------------------------------------------------------------------------------------------------


def _fit_state(residual, data, train, held, settings, generator):
    """The network on the one-step error of the whole state."""
    network = residual.network
    if network is None:
        return {}, prediction_error(residual, held)
    parts = []
    for part in (train, held):
        with torch.no_grad():
            error = part.next_state - predict(residual, part)
        parts.append((bound(residual, part).inputs(part.state, part.action), error))
    (inputs, targets), (held_inputs, held_targets) = parts
    outputs = targets.square().mean(0).sqrt() > 1e-7
    if outputs.any():
        _normalise(network, inputs, targets)
        _train(network, inputs, targets, held_inputs, held_targets, outputs, settings, generator)
        network.size[~outputs] = 0.0
    names = tuple(name for name, on in zip(data.state_names, outputs.tolist(), strict=True) if on)
    return {"network": names}, prediction_error(residual, held)


FITS = {"acceleration": _fit_acceleration, "state": _fit_state}

__all__ = [
    "FITS", "GROUPS", "MINIMUM", "RESIDUALS", "AccelerationResidual", "FitReport", "FitSettings", "ResidualConfig",
    "ResidualDynamics", "StateResidual", "Transitions", "fit_residual", "load_residual", "make_residual", "predict",
    "prediction_error",
]  # fmt: skip
