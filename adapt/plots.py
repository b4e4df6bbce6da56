"""Pictures of an adaptation: the flight before and after, error over time, residual against truth, training.

Each is drawn on a `Figure` of its own, without pyplot, so that nothing is shared and no window is opened.
"""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from adapt.plot_style import (
    COLOURS,
    DPI,
    ERROR_MAP,
    GREY,
    LIGHT,
    LINES,
    STYLE,
    axis_of,
    label,
    number,
    small,
    smoothed,
)
from adapt.report import NAMES
from adapt.residual_plot import draw_residual
from policies.files import whole

PANEL = 2.7  # [inch] width of one picture of a flight


def draw_all(adaptation, folder):
    """Draw every picture into a folder; a file is there whole or not at all.

    Returns:
        the paths of the PNG files.
    """
    paths = []
    for name, draw in PICTURES.items():
        with matplotlib.rc_context(STYLE):
            figure = draw(adaptation)
            with whole(Path(folder) / f"{name}.png") as partial:
                figure.savefig(partial, format="png", dpi=DPI)
        paths.append(Path(folder) / f"{name}.png")
    return paths


# --- what is shown ----------------------------------------------------------------------------------------------------


def representative(adaptation):
    """The test episode with the median error before the adaptation."""
    errors = adaptation.evaluations["zero_shot"].table.error.to_numpy(dtype=float)
    order = np.argsort(np.where(np.isfinite(errors), errors, np.inf), kind="stable")
    return int(order[len(order) // 2])


def last_steps(task, evaluation):
    """The step (N,) at which each episode ended; states behind it repeat the last one."""
    episodes, states = evaluation.episodes, evaluation.states
    ended = torch.full((len(episodes),), task.steps, device=states.device)
    for t in reversed(range(1, task.steps + 1)):
        step = torch.full_like(ended, t)
        over = task.arrived(episodes, step, states[:, t]) | task.diverged(episodes, step, states[:, t])
        ended = torch.where(over, step, ended)
    return ended.cpu().numpy()


def traces(task, evaluation):
    """The error (N, steps + 1) over time, NaN behind the end of an episode and where the state isn't finite."""
    with torch.no_grad():
        trace = task.trace(evaluation.episodes, evaluation.states).cpu().double().numpy()
    after = np.arange(trace.shape[1]) > last_steps(task, evaluation)[:, None]
    return np.where(after | ~np.isfinite(trace), np.nan, trace)


def score(evaluation, scale):
    """The mean metric of an evaluation in words, and how many flights failed if any did."""
    factor, unit = scale
    summary = evaluation.summary
    mean, flights = summary["mean"], summary["n"]
    failed = round((1 - summary["success"]) * flights)
    if failed == flights:
        return f"all {flights} flights fail"
    return f"{number(factor * mean)} {unit}" + (f", {failed} of {flights} fail" if failed else "")


def _say_score(axes, name, evaluation, scale, side):
    """The same as a title, in its colour; failed flights in a line of their own, so that two titles have room."""
    said = f"{NAMES[name]}: {score(evaluation, scale)}".replace(", ", ",\n").replace(": all ", ":\nall ")
    axes.set_title(said, loc=side, color=COLOURS[name], fontweight="bold")


def score_scale(adaptation):
    """The scale in which all scores are told."""
    means = [evaluation.summary["mean"] for evaluation in adaptation.evaluations.values()]
    return small(means, adaptation.evaluations["zero_shot"].unit)


def views_of(task):
    """Pairs of states to draw flights in; a task that names none gets its first two reference entries over time."""
    return task.views or tuple(("t", name) for name in task.reference_names[:2])


# --- flight -----------------------------------------------------------------------------------------------------------


def draw_flight(adaptation):
    """One test episode before and after: the flown path, coloured by its error, on its reference."""
    task, names = adaptation.policy.task, ("zero_shot", "few_shot")
    row, views = representative(adaptation), views_of(task)
    evaluations = [adaptation.evaluations[name] for name in names]
    columns = [_columns(task, evaluation, row) for evaluation in evaluations]
    errors = [traces(task, evaluation)[row] for evaluation in evaluations]
    known = np.concatenate(errors)
    known = known[np.isfinite(known)]
    largest = float(np.quantile(known, 0.98)) if len(known) else 0.0  # a plant that is dead flies no step
    factor, unit = small([largest], task.trace_unit)
    norm = Normalize(0, max(factor * largest, 1e-9))
    proportions = [_proportion(task.system, columns, view) for view in views]
    heights = [PANEL * (0.55 if proportion is None else max(proportion, 0.65)) for proportion in proportions]
    figure = Figure(figsize=(7.2, 0.9 + 0.6 * len(views) + sum(heights)), layout="constrained")
    grid = figure.subplots(len(views), 2, sharex="row", sharey="row", height_ratios=heights, squeeze=False)
    for i, (view, proportion) in enumerate(zip(views, proportions, strict=True)):
        for axes, shown, error in zip(grid[i], columns, errors, strict=True):
            lines = _draw_view(axes, task.system, shown, view, factor * error, norm)
            axes.set_aspect("auto" if proportion is None else "equal")
            axes.set_xlabel(label(axis_of(task.system, view[0])))
        grid[i, 0].set_ylabel(label(axis_of(task.system, view[1])))
    for axes, name, evaluation in zip(grid[0], names, evaluations, strict=True):
        _say_score(axes, name, evaluation, score_scale(adaptation), "center")
    bar = figure.colorbar(lines, ax=grid, aspect=30, pad=0.02, extend="max", ticks=MaxNLocator(5))
    bar.set_label(f"{task.trace_name} [{unit}]")
    bar.outline.set_visible(False)
    grid[0, 0].legend(loc="best", handlelength=1.5)
    figure.suptitle(f"{evaluations[0].metric} of {evaluations[0].summary['n']} test flights", color=GREY)
    return figure


def _proportion(system, columns, view):
    """Height over width of a picture in space, or None where both directions can't have one scale."""
    axes = [axis_of(system, name) for name in view]
    if axes[0].unit != axes[1].unit or "t" in view:
        return None
    values = [np.concatenate([part[name] for pair in columns for part in pair if name in part]) for name in view]
    spans = [abs(axis.factor) * (np.nanmax(v) - np.nanmin(v)) for axis, v in zip(axes, values, strict=True)]
    proportion = spans[1] / max(spans[0], 1e-9)
    return proportion if 1 / 3 < proportion < 3 / 2 else None


def _columns(task, evaluation, row):
    """Reference and flown values by state name, and the time, of one episode up to its end."""
    count = last_steps(task, evaluation)[row] + 1
    with torch.no_grad():
        path = task.path(evaluation.episodes[row : row + 1])[0].cpu().double().numpy()
    flown = evaluation.states[row, :count].cpu().double().numpy()
    reference = dict(zip(task.reference_names, path.T, strict=True))
    states = dict(zip(task.system.State._fields, flown.T, strict=True))
    time = task.system.dt * np.arange(len(path))
    return {**reference, "t": time}, {**states, "t": time[:count]}


def _draw_view(axes, system, columns, view, error, norm):
    """Reference in grey, flown path in the colours of its error; returns the coloured lines."""
    reference, flown = columns
    factors = [axis_of(system, name).factor for name in view]
    if all(name in reference for name in view):
        wanted = [factor * reference[name] for factor, name in zip(factors, view, strict=True)]
        axes.plot(*wanted, color=LIGHT, linewidth=7, zorder=1, label="reference")
    path = np.stack([factor * flown[name] for factor, name in zip(factors, view, strict=True)], -1)
    lines = LineCollection(np.stack((path[:-1], path[1:]), 1), cmap=ERROR_MAP, norm=norm, linewidth=3, zorder=3)
    lines.set_array(error[1 : len(path)])
    lines.set_capstyle("round")
    axes.add_collection(lines)
    axes.plot(*path[0], "o", color="black", markersize=8, zorder=4, label="start")
    axes.autoscale_view()
    axes.locator_params(nbins=5)
    return lines


# --- error ------------------------------------------------------------------------------------------------------------


def draw_error(adaptation):
    """Error over time: mean of all test flights, and the band that holds eight of ten."""
    task, evaluations = adaptation.policy.task, adaptation.evaluations
    found = {name: traces(task, evaluations[name]) for name in COLOURS if name in evaluations}
    means = [np.nanmean(trace[:, _flying(trace)], 0) for trace in found.values()]  # of a dead plant, without a step
    factor, unit = small(np.concatenate(means), task.trace_unit)
    figure = Figure(figsize=(7, 4.4), layout="constrained")
    axes = figure.subplots()
    for name, trace in found.items():
        flying = _flying(trace)
        time, error = task.system.dt * np.arange(trace.shape[1])[flying], factor * trace[:, flying]
        said = f"{NAMES[name]}: {score(evaluations[name], score_scale(adaptation))}"
        axes.plot(time, np.nanmean(error, 0), linestyle=LINES.get(name, "-"), color=COLOURS[name], label=said)
        if flying.any():
            low, high = np.nanquantile(error, (0.1, 0.9), axis=0)
            axes.fill_between(time, low, high, color=COLOURS[name], alpha=0.15, linewidth=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{task.trace_name} [{unit}]")
    axes.set_ylim(bottom=0)
    axes.margins(x=0)
    count = evaluations["zero_shot"].summary["n"]
    axes.set_title(f"mean of {count} test flights, band: 10–90 %", loc="left", color=GREY)
    axes.legend(loc="best", title=evaluations["zero_shot"].metric, alignment="left")
    return figure


def _flying(trace):
    """Columns in which at least half of the episodes go on."""
    return np.isfinite(trace).mean(0) >= 0.5


# --- training ---------------------------------------------------------------------------------------------------------


def draw_training(adaptation):
    """Cost and gradient norm over the updates of the fine-tuning."""
    history, evaluations, scale = adaptation.history, adaptation.evaluations, score_scale(adaptation)
    update, cost, norm = (np.array([row[key] for row in history]) for key in ("update", "cost", "gradient_norm"))
    figure = Figure(figsize=(7, 4.8), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1))
    colour = COLOURS["few_shot"]
    for axes, values, room in ((top, cost, 7), (bottom, norm, 3)):
        axes.plot(update, values, color=colour, alpha=0.35, linewidth=1.5, label="each update")
        axes.plot(update, smoothed(values), color=colour, label="smoothed")
        _log_scale(axes, values, room)
    top.set_ylabel("cost [-]")
    top.legend(loc="best")
    bottom.set_ylabel("gradient\nnorm [-]")
    bottom.set_xlabel("update of the fine-tuning in model + residual")
    for name, side in (("zero_shot", "left"), ("few_shot", "right")):
        _say_score(top, name, evaluations[name], scale, side)
    figure.align_ylabels()
    return figure


def _log_scale(axes, values, room):
    """A logarithmic scale with plain numbers, about as many as there is room for."""
    known = values[np.isfinite(values) & (values > 0)]
    decades = np.log10(known.max() / known.min()) if len(known) else 0.0
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if 3 * decades <= room else (1,), numticks=room))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


PICTURES = {"flight": draw_flight, "error": draw_error, "residual": draw_residual, "training": draw_training}
