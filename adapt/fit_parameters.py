"""Fit a parameter residual: which named parameters explain the transitions, and their values with standard errors.

Gauss-Newton on what the model misses. Parameters are taken up one at a time, each the one that explains most of what is
left, while cross-validation says that it predicts flight it has not seen; see Ljung (1999), "System Identification",
ch. 16, on choosing a structure. Where exact states would leave nothing but something is left, it may be noise of the
measured states: then the search is repeated on stretches of flight, which noise doesn't bias (`Shooting`).
"""

from dataclasses import dataclass, field, replace

import torch

from adapt.parameter_losses import NEGLIGIBLE, OneStep, Shooting, least_squares, size
from adapt.parameter_residual import candidates, changed, nominal
from adapt.prediction import prediction_error
from adapt.sensitivities import apart
from envs.errors import InputError

MOST = 8  # parameters
ROUNDS = 8  # Gauss-Newton steps
SETTLED = 1e-6  # [-] change of all parameters, in their sizes, at which they have converged
SURE = 4.0  # [-] standard errors that a parameter must differ from its nominal value
ALIKE = 0.999  # [-] correlation of two parameters' effects beyond which data can't tell them apart
NOTICEABLE = 1e-3  # [-] change of a parameter, in its size, that is worth a name
ENOUGH = 5  # transitions for each parameter
WORTH = 1e-3  # [-] share of what is left that a parameter must explain
BLIND = 1e-9  # [-] square of an effect below which there is none
EXPLAINED = 10 * NEGLIGIBLE  # [m/s^2, rad/s^2] what may be left where states are exact


@dataclass
class Found:
    """Parameters and their values, with what the data say about them."""

    values: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)  # standard errors
    alike: dict[str, tuple] = field(default_factory=dict)  # name: others that the data can't tell from it
    noise: tuple[float, ...] = ()  # of the measured states in the tangent space, where it was estimated


def fit_parameters(residual, data, train, held, settings, generator):
    """Choose and fit on `train`, judge on `held`; then fit the same parameters to all data."""
    found = search(residual.base, train, residual.config.parameters)
    _set(residual, found)
    after = prediction_error(residual, held)
    loss = _loss(residual.base, data, bool(found.noise))
    again = settle(loss, tuple(found.values), found.values)  # None where the held-out flight contradicts the others
    found = found if again is None else replace(again, alike=found.alike)
    _set(residual, found)
    values = {name: (found.values[name], found.errors[name]) for name in found.values}
    return {"parameters": values, "alike": _undoing(loss, found)}, after


def _set(residual, found):
    residual.config = replace(residual.config, parameters=tuple(found.values))
    residual.values = torch.tensor(list(found.values.values()), dtype=torch.float64)
    residual.errors = torch.tensor(list(found.errors.values()), dtype=torch.float64)
    residual.simplify()


def _loss(base, data, noisy):
    return Shooting(base, data) if noisy else OneStep(base, data)


def search(base, data, named=()):
    """The parameters that explain the transitions, fitted; `named` are all fitted, without a choice.

    Raises:
        InputError: named parameters that the data don't determine; says in which direction.
    """
    quick = OneStep(base, data)
    found = _named(quick, named) if named else _chosen(quick)
    if quick.missed(changed(base, found.values)).abs().max() < EXPLAINED:
        return found
    try:
        slow = Shooting(base, data)
        if not named:
            return _chosen(slow)
    except ValueError:  # too short to tell, or no flight
        return found
    return _named(slow, named)


def _chosen(loss):
    """Parameters taken up one at a time while they predict."""
    found, system = Found(), loss.base.system
    most = min(MOST, len(loss.folds) // ENOUGH if isinstance(loss, OneStep) else MOST)
    while len(found.values) < most:
        names = [name for name in candidates(system) if name not in found.values]
        left, effects = loss.linearised(found.values, (*found.values, *names))
        own, others = effects[:, : len(found.values)], effects[:, len(found.values) :]
        others, left = apart(others, own), apart(left[:, None], own)[:, 0]
        best = _next(names, others, left)
        folds = loss.folds.repeat_interleave(len(left) // len(loss.folds))
        if best is None or not _predicts(left, others[:, names.index(best)], folds):
            break
        tried = settle(loss, (*found.values, best), found.values)
        if tried is None or abs(tried.values[best] - nominal(system, best)) < SURE * tried.errors[best]:
            break
        found = replace(tried, alike=found.alike | {best: _alike(best, names, others)})
    return _without_idle(loss, found)


def _without_idle(loss, found):
    """The same without parameters that a later one has brought back to their nominal value."""
    system = loss.base.system
    moved = [n for n, value in found.values.items() if abs(value - nominal(system, n)) > NOTICEABLE * size(system, n)]
    if len(moved) == len(found.values):
        return found
    again = settle(loss, tuple(moved), found.values)
    return found if again is None else replace(again, alike={name: found.alike[name] for name in moved})


def _named(loss, named):
    _, effects = loss.linearised({}, named)
    if direction := undetermined(effects, named):
        raise InputError(f"transitions: don't determine {', '.join(named)}: {direction} changes no prediction")
    if (found := settle(loss, named, {})) is None:
        raise InputError(f"transitions: no values of {', '.join(named)} explain them; check units and columns")
    return found


def undetermined(effects, names):
    """The direction in parameter space that the data don't determine, in words; empty where they determine all.

    Args:
        effects: (R, p) of the parameters in their sizes.
    """
    norms = effects.norm(dim=0)
    if blind := [name for name, norm in zip(names, norms.tolist(), strict=True) if norm < 1e-9]:
        return f"a change of {blind[0]}"
    _, singular, directions = torch.linalg.svd(effects / norms, full_matrices=False)
    if singular[-1] > singular[0] * (1 - ALIKE**2) ** 0.5:
        return ""
    parts = directions[-1] / norms
    parts = (parts / parts.abs().max()).tolist()
    return " with ".join(f"{value:+.2g} {name}" for name, value in zip(names, parts, strict=True) if abs(value) > 0.01)


def _next(names, effects, left):
    """The parameter whose effect explains most of what is left, of equals the first; or None."""
    squares = effects.square().sum(0)
    gains = torch.where(squares > BLIND, (left @ effects).square() / squares.clamp(min=1e-12), 0.0)
    if not names or not float(gains.max()) > 0:
        return None
    return names[int((gains >= ALIKE * gains.max()).to(torch.int8).argmax())]


def _predicts(left, effect, folds):
    """Whether a parameter fitted to the other folds explains each fold, by more than the doubt about that."""
    gains = []
    for fold in folds.unique():
        inside = folds == fold
        value = effect[~inside] @ left[~inside] / effect[~inside].square().sum().clamp(min=1e-12)
        gains.append(left[inside].square().sum() - (left[inside] - value * effect[inside]).square().sum())
    gains = torch.stack(gains) / left.square().sum().clamp(min=1e-12)
    return bool(gains.sum() > WORTH) and bool(gains.mean() > gains.std() / len(gains) ** 0.5)


def _alike(best, names, effects):
    """Parameters whose effect the data can't tell from that of the best."""
    unit = effects / effects.norm(dim=0).clamp(min=1e-12)
    likeness = (unit.T @ unit[:, names.index(best)]).abs().tolist()
    return tuple(name for name, value in zip(names, likeness, strict=True) if value > ALIKE and name != best)


def _undoing(loss, found):
    """{name: {other: amount}}: for each parameter, those that the data can't tell from it and how much undoes +1 of it.

    +1 of the parameter with that amount of the other, each in its unit, is a direction in parameter space that the data
    don't determine. The amount is None where that doesn't hold at the fitted values any more.
    """
    return {name: _amounts(loss, found, name, others) for name, others in found.alike.items()}


def _amounts(loss, found, name, others):
    rest = tuple(fitted for fitted in found.values if fitted != name)
    _, effects = loss.linearised(found.values, (*rest, name, *others))
    own, both = effects[:, : len(rest)], effects[:, len(rest) :]
    own_effect, *theirs = apart(both, own).T
    amounts = {}
    for other, effect in zip(others, theirs, strict=True):
        square, shared = float(effect @ effect), float(effect @ own_effect)
        same = square > BLIND and abs(shared) > ALIKE * square**0.5 * float(own_effect.norm())
        sizes = [size(loss.base.system, one) for one in (other, name)]
        amounts[other] = -shared / square * sizes[0] / sizes[1] if same else None
    return amounts


def settle(loss, names, start):
    """Gauss-Newton from the values at hand until they stay: `Found`, or None where they run away."""
    system = loss.base.system
    values = {name: start.get(name, nominal(system, name)) for name in names}
    sizes = torch.tensor([size(system, name) for name in names], dtype=torch.float64)
    for _ in range(ROUNDS if names else 1):
        try:
            left, effects = loss.linearised(values, names)
        except InputError:  # values without physical sense
            return None
        if not left.isfinite().all() or not effects.isfinite().all():
            return None
        errors = _standard_errors(loss, left, effects) * sizes
        if not names:
            break
        change = least_squares(effects, left[:, None])[:, 0]
        values = {name: values[name] + float(c * s) for name, c, s in zip(names, change, sizes, strict=True)}
        if change.abs().max() < SETTLED:
            break
    if not _physical(loss.base, values):  # the last step led there
        return None
    noise = () if loss.noise is None else tuple(loss.noise.tolist())
    return Found(values, dict(zip(names, errors.tolist(), strict=True)), noise=noise)


def _physical(base, values):
    """Whether a robot can have these values."""
    try:
        changed(base, values)
    except InputError:
        return False
    return True


def _standard_errors(loss, left, effects):
    """One standard deviation of each parameter in its size, if what is left is independent noise."""
    if not effects.shape[1]:
        return torch.zeros(0, dtype=torch.float64)
    variance = loss.repeated * left.square().sum() / max(1, len(left) - loss.spent - effects.shape[1])
    return (torch.linalg.pinv(effects.T @ effects).diagonal().clamp(min=0) * variance).sqrt()
