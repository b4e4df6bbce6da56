"""Fit a residual to transitions, and say how much better it predicts.

By default the kind is chosen by the flight that it predicts (see `choose_residual`): refitted parameters of the model,
a sparse linear acceleration (see `sparse_ridge`), random features or a network, which stay only where they improve
held-out transitions, or the paper's network added to the whole next state.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch

from adapt.choose_residual import Tried, choose
from adapt.fit_acceleration import fit_acceleration
from adapt.fit_parameters import fit_parameters
from adapt.fit_state import fit_state
from adapt.prediction import GROUPS, prediction_error
from adapt.residual_dynamics import SPEED, ResidualConfig
from adapt.residual_kinds import make_residual
from adapt.transitions import check
from envs.errors import InputError

MINIMUM = 10  # transitions; fewer say nothing about what to leave out
FEATURES = 200  # random Fourier features


class Kind(NamedTuple):
    """What `--residual` may name: the form of what is fitted, how, and of which parts it consists."""

    form: str
    fit: Callable
    linear: bool = False
    network: str = ""  # its activation; none where empty


# From the simplest to what may take any shape: of two that predict as well, the first is taken.
KINDS = {
    "parameters": Kind("parameters", fit_parameters),
    "linear": Kind("acceleration", fit_acceleration, linear=True),
    "features": Kind("acceleration", fit_acceleration, network="cos"),
    "network": Kind("acceleration", fit_acceleration, network="tanh"),
    "linear+network": Kind("acceleration", fit_acceleration, linear=True, network="tanh"),
    "state": Kind("state", fit_state, network="tanh"),
}
MENU = tuple(KINDS)  # that "auto" chooses from
KINDS["acceleration"] = KINDS["linear+network"]  # its older name
AUTO = "auto"
BLIND = "linear+network"  # what "auto" takes where it can't compare
NEARLY = 1.1  # times the error of the chosen kind that another one may have to be a rival


@dataclass(frozen=True)
class FitSettings:
    """How a residual is fitted."""

    linear: bool = True
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
    fitted without them, though they chose what it may keep; the residual that is returned has seen all.
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
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)  # fitted value and standard error
    alike: dict[str, dict] = field(default_factory=dict)  # what data can't tell from each, and how much undoes +1 of it
    tried: tuple[Tried, ...] = ()  # what "auto" chose from
    solved: bool = False  # whether the choice leaves next to nothing
    warnings: tuple[str, ...] = ()


def fit_residual(transitions, base, kind=AUTO, seed=0, settings=FitSettings(), parameters=()):
    """Learn what `base` lacks to explain the transitions.

    Args:
        kind: one of `KINDS`, or "auto", which chooses by the flight that each predicts, see `choose_residual`.
        parameters: names that kind "parameters" fits; without any it chooses among all, see `candidates`.

    Returns:
        the fitted `ResidualDynamics`, whose context is unset if it has any, and a `FitReport`.

    Raises:
        InputError: unknown kind, fewer than `MINIMUM` transitions, another system or control period, a number that
            isn't finite, or a state from which the model's own prediction isn't.
    """
    began = time.perf_counter()
    check(transitions, base.system, MINIMUM)
    generator = torch.Generator().manual_seed(seed)
    data = transitions.double()
    if kind == AUTO:
        return _chosen(data, base, seed, settings, began)
    chosen = _kind(kind, parameters)
    settings = replace(settings, linear=chosen.linear, network=settings.network and bool(chosen.network))
    config = _shape(chosen, settings, transitions.context_names, parameters)
    _check_prediction(base, data)
    train, held = data.split(1 - settings.held_out, generator)  # before the network draws its weights
    residual = make_residual(base, config, generator)
    choice, after = chosen.fit(residual, data, train, held, settings, generator)
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


def _chosen(data, base, seed, settings, began):
    """The kind that predicts best, fitted to all data; its report says what was tried."""
    _check_prediction(base, data)

    def fit(part, kind, names=()):
        return fit_residual(part, base, kind, seed, settings, names)

    named = fit(data, "parameters")
    names = named[0].config.parameters  # searched for once; each fold fits their values anew

    def held_out_fit(part, kind):
        if kind == "parameters":
            return fit(part, kind, names)[0] if names else base
        return fit(part, kind)[0]

    try:
        tried, kind, solved = choose(data, base, MENU, held_out_fit)
    except ValueError:  # no flight is long enough to predict, or too few to leave any out
        residual, report = fit(data, BLIND)
        warning = f"flights are too few or too short to tell which kind of residual predicts best; took {BLIND}"
        return residual, replace(report, warnings=(*report.warnings, warning))
    residual, report = named if kind == "parameters" else fit(data, kind)
    return residual, replace(report, tried=tried, solved=solved, seconds=time.perf_counter() - began)


def runner_up(report):
    """The kind that predicted next best to the chosen one, if about as well: the data don't tell them apart."""
    scores = {one.kind: one.score for one in report.tried}
    others = {kind: score for kind, score in scores.items() if kind != report.kind}
    if not others or report.solved:
        return None
    best = min(others, key=others.get)
    return best if others[best] <= NEARLY * scores[report.kind] else None


def _kind(name, parameters):
    if name not in KINDS:
        raise InputError(f"--residual {name}: expected one of {', '.join((AUTO, *KINDS))}")
    if parameters and KINDS[name].form != "parameters":
        raise InputError(f"parameters {', '.join(parameters)}: are fitted by kind parameters, not {name}")
    return KINDS[name]


def _shape(kind, settings, contexts, parameters):
    """The shape of an unfitted residual."""
    if kind.form == "parameters":
        return ResidualConfig("parameters", 0, parameters=tuple(parameters), factors=())
    hidden = (FEATURES if kind.network == "cos" else settings.hidden) if settings.network else 0
    return ResidualConfig(kind.form, hidden, kind.network or "tanh", contexts, (SPEED, *contexts))


def _check_prediction(base, data):
    with torch.no_grad():
        lost = (~base(data.state, data.action).isfinite()).any(-1).nonzero()
    if len(lost):
        raise InputError(
            f"transitions: transition {int(lost[0]) + 1}: {data.system}'s model can't go on from this state; remove it"
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
