"""What `adapt.online` tells of a flight: errors around each change, lessons, tables, the picture."""

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from adapt.plot_style import COLOURS, DPI, GREY, STYLE, small
from policies.files import whole

BEFORE = 5.0  # [s] before a change whose error counts
LATER = 5.0  # [s] after it from which on the error counts
AFTER = 5.0  # [s] for which it does
RUNNING = 1.0  # [s] of the running mean that is drawn
LINES = {  # name: what it is called, its colour and width
    "undisturbed": ("nothing changes", GREY, 1.6),
    "unadapted": ("without learning", COLOURS["zero_shot"], 2.8),
    "adapted": ("learning", COLOURS["few_shot"], 2.8),
}


def around(schedule, tables, dt):
    """Errors around each change of the `tables` {name: flown}, as a list of dicts; None where it wasn't flown so long.

    `ratio` is the mean error from 5 s to 10 s after a change against that of the 5 s before it. References ask more at
    some times than at others; `path` is the same ratio where nothing changes, and `net` is the ratio without that.
    """
    said, flown = [], tables["adapted"].error.to_numpy()
    ends = [*(phase.begins for phase in schedule.changes), len(flown) * dt][1:]
    for phase, end in zip(schedule.changes, ends, strict=True):
        spans = {"before": (phase.begins - BEFORE, phase.begins)}
        spans["after"] = (phase.begins + LATER, phase.begins + LATER + AFTER)
        complete = spans["after"][1] <= end + dt / 2 and spans["before"][0] >= 0
        errors = {name: {span: _mean(table, *spans[span], dt) for span in spans} for name, table in tables.items()}
        one = {"begins": phase.begins, "what": phase.text, **(errors["adapted"] if complete else {})}
        one["worst"] = _worst(flown, phase.begins, end, dt)
        if complete:
            one["ratio"] = _ratio(errors["adapted"])
        if complete and len(tables) > 1:
            one["unadapted"] = errors["unadapted"]["after"]
            one["path"] = _ratio(errors["undisturbed"])
            one["net"] = one["ratio"] / one["path"]
        said.append(one)
    return said


def _mean(table, first, last, dt):
    errors = table.error.to_numpy()[max(0, round(first / dt)) : round(last / dt)]
    return float(errors.mean()) if len(errors) else float("nan")


def _worst(errors, first, last, dt):
    running = running_mean(errors, dt)[round(first / dt) : round(last / dt)]
    return float(np.nanmax(running)) if len(running) else None


def _ratio(errors):
    return errors["after"] / errors["before"] if errors["before"] > 0 else float("nan")


def running_mean(errors, dt):
    """Mean over the last second of each time, over less at the start."""
    return pd.Series(errors).rolling(max(1, round(RUNNING / dt)), min_periods=1).mean().to_numpy()


def timing(lessons, latency):
    """How many lessons, swaps, seconds; how often a result came later than the flight allowed for.

    Lessons are those whose result was taken. One that is given up at a change has a reason and no seconds; one that was
    under way when the flight ended is unfinished and has neither.
    """
    done = [one for one in lessons if "seconds" in one]
    seconds = [one["seconds"] for one in done]
    return {
        "lessons": len(done),
        "given_up": sum("reason" in one and "seconds" not in one for one in lessons),
        "unfinished": sum("reason" not in one and "seconds" not in one for one in lessons),
        "swaps": sum(one["accepted"] for one in done),
        "latency": latency,
        "median_seconds": float(np.median(seconds)) if done else None,
        "most_seconds": max(seconds, default=None),
        "late": sum(second > latency for second in seconds),
    }


def text(metrics):
    """Tables of the metrics, for people."""
    from tabulate import tabulate

    unit, parts = metrics["unit"], []
    header = (f"mean {metrics['trace']} [{unit}]", "", "lost")
    rows = [(LINES[name][0], f"{one['error']:.4f}", one["lost"]) for name, one in metrics["flights"].items()]
    parts.append(tabulate(rows, header, "simple", disable_numparse=True))
    if metrics["changes"]:
        names = ("before", "worst", "after", "ratio", "path", "net", "unadapted")
        rows = [
            (f"{one['what']} at {one['begins']:g} s", *(_cell(one.get(name)) for name in names))
            for one in metrics["changes"]
        ]
        head = (f"error [{unit}]", "before", "worst", "5 s after", "ratio", "ratio of path", "net", "without learning")
        parts.append(tabulate(rows, head, "simple", disable_numparse=True))
    parts.append(_learned(metrics["learning"]))
    return "\n" + "\n\n".join(parts) + "\n"


def _cell(value):
    return "–" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _learned(said):
    others = {"given up": said["given_up"], "unfinished at the end": said["unfinished"]}
    others = "".join(f", {number} {what}" for what, number in others.items() if number)
    if not said["lessons"]:
        return f"no lesson was finished{others}"
    late = f"{said['late']} of {said['lessons']} took longer than the {said['latency']:g} s that the flight allows for"
    took = f"{said['median_seconds']:.2f} s in the median, {said['most_seconds']:.2f} s at most"
    return f"{said['lessons']} lessons, {said['swaps']} swaps{others}; a lesson took {took}; {late}"


def draw(tables, schedule, lessons, task, path):
    """The picture of the flights {name: table}: error over time, changes and swaps marked."""
    dt = task.system.dt
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 4.6), layout="constrained")
        axes = figure.subplots()
        factor, unit = small(np.concatenate([table.error for table in tables.values()]), task.trace_unit)
        for name, (words, colour, width) in LINES.items():
            if name in tables:
                table = tables[name]
                mean = factor * running_mean(table.error.to_numpy(), dt)
                axes.plot(table.time, np.where(mean > 0, mean, np.nan), color=colour, linewidth=width, label=words)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        _mark(axes, schedule, lessons, len(tables["adapted"]) * dt)
        axes.set(xlabel="time [s]", ylabel=f"{task.trace_name} [{unit}],\nmean of 1 s")
        figure.legend(loc="outside upper center", ncols=4, columnspacing=1.4, handlelength=1.6)
        with whole(path) as partial:
            figure.savefig(partial, format="png", dpi=DPI)


def _mark(axes, schedule, lessons, end):
    """Lines where the target changes, triangles on the time axis where the policy was swapped."""
    for phase in schedule.changes:
        if phase.begins < end:
            axes.axvline(phase.begins, color="black", linewidth=1.6, linestyle=(0, (4, 3)), zorder=1)
            place = (phase.begins, 1.0)
            axes.annotate(
                phase.text, place, (5, -3), xycoords=("data", "axes fraction"), textcoords="offset points", va="top"
            )
    if swaps := [one["due"] for one in lessons if one.get("accepted")]:
        style = {"marker": "^", "markersize": 9, "linestyle": "none", "color": COLOURS["oracle"]}
        axes.plot(swaps, [0.03] * len(swaps), transform=axes.get_xaxis_transform(), label="policy swapped", **style)
    axes.set_xlim(0, end)
    low, high = axes.get_ylim()
    axes.set_ylim(low / (high / low) ** 0.08, high * (high / low) ** 0.1)  # room for the triangles and the words
