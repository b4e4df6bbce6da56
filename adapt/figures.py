"""Figures of the results: horizon, curriculum, fine-tuning, error over transitions and training, compiled and eager.

Lines are means over seeds, bands reach from the least to the greatest seed: on a logarithmic axis a mean less a
standard deviation may have no place. Open markers are the paper's values. Each PNG carries a digest of the rows that it
was drawn from, so that an old one is found without drawing it again.
"""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator

from adapt.evidence import Evidence
from adapt.experiment_table import HORIZONS
from adapt.figure_parts import (
    BUILD_LOOK,
    CURRICULUM_LOOK,
    FAILING_LOOK,
    METHOD_LOOK,
    MODE_LOOK,
    MOST,
    NOTHING,
    PAPER_KEY,
    SYSTEM_LOOK,
    band,
    curve,
    each_seed,
    legend,
    logarithmic,
    mark_failing,
    over,
    panels,
    published,
)
from adapt.plot_style import DPI, GREY, STYLE
from adapt.table_cells import METHODS, MODE_NAMES
from envs.errors import InputError
from policies.files import replacing

TITLES = {"quadrotor": "quadrotor", "fixed_wing": "fixed wing"}
CURRICULA = {"both": "threshold and speed", "threshold": "threshold only", "speed": "speed only", "none": "neither"}
ZERO = 10  # where no transitions stand on a logarithmic axis that begins at 30
WATCHED = 1000  # transitions after which the fine-tuning is watched
EXACT = 1e-6  # [m/s^2] what single precision leaves of nothing


@dataclass(frozen=True)
class Picture:
    """A figure and what it is drawn from.

    Args:
        draw: makes a figure of the evidence that `part` leaves.
        rows: pattern of the experiments whose rows it shows.
        curves: pattern of the experiments whose curves it shows.
        levels: pattern of the experiments whose rows it shows beside; they alone make no figure.
        table: published table that it shows.
    """

    draw: object
    rows: str = ""
    curves: str = ""
    levels: str = ""
    table: str = ""

    def part(self, evidence):
        """The evidence that the figure sees, or None where there is none of it yet."""
        rows, curves = _matching(evidence.experiments, self.rows), _matching(evidence.curves, self.curves)
        if rows.empty and curves.empty:
            return None
        rows = _matching(evidence.experiments, f"{self.rows}|{self.levels}")
        return Evidence(rows, curves, evidence.published[evidence.published.table == self.table])


def _matching(table, pattern):
    return table[table.experiment.str.fullmatch(pattern).astype(bool)]


def digest(part):
    """A digest of the rows behind a figure; the order of lines in the files doesn't matter."""
    text = "".join(table.to_csv(index=False) for table in (part.experiments, part.curves, part.published))
    return hashlib.sha256(text.encode()).hexdigest()


def draw_all(evidence, folder):
    """Draw every figure that there is evidence for.

    Raises:
        InputError: when a file can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in PICTURES.items():
        part = picture.part(evidence)
        if part is None:
            continue
        with matplotlib.rc_context(STYLE), replacing(folder / f"{name}.png") as partial:
            figure = picture.draw(part)
            figure.savefig(partial, format="png", dpi=DPI, metadata={"Evidence": digest(part)})


def check(evidence, folder):
    """Refuse a figure that isn't there or was drawn from other rows.

    Raises:
        InputError: names the first.
    """
    for name, picture in PICTURES.items():
        part, path = picture.part(evidence), Path(folder) / f"{name}.png"
        if part is not None and _said(path) != digest(part):
            told = "was drawn from other results" if path.is_file() else "isn't there"
            raise InputError(f"{path}: {told}; run python -m adapt.tables")


def _said(path):
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.info.get("Evidence")
    except (OSError, UnidentifiedImageError):
        return None


# --- figures ----------------------------------------------------------------------------------------------------------


def _keys(axes, entries, **settings):
    """A legend of black lines that say what a kind of line means."""
    handles = [Line2D([], [], color=GREY, label=label, **look) for label, look in entries.items()]
    axes.legend(handles=handles, **settings)


def draw_horizon(evidence):
    """Error, and norm and variance of the gradient, over the horizon for the three modes."""
    figure, (left, right) = panels(2, (10, 4.8))
    for mode, look in MODE_LOOK.items():
        ran = [horizon for horizon in HORIZONS if evidence.rows(f"horizon-{mode}-{horizon}") is not None]
        of = {
            column: [evidence.spread(f"horizon-{mode}-{horizon}", column) for horizon in ran]
            for column in ("error", "gradient_norm", "gradient_variance")
        }
        if ran:
            band(left, ran, of["error"], look, label=MODE_NAMES[mode])
            band(right, ran, of["gradient_norm"], look)
            band(right, ran, of["gradient_variance"], look, linestyle="--")
        papers = [evidence.paper("table2", "quadrotor", mode, str(horizon)) for horizon in HORIZONS]
        published(left, HORIZONS, [paper.error if paper else np.nan for paper in papers], look)
    left.plot([], [], color=GREY, label="published", **PAPER_KEY)
    left.set(title="error of successful flights", ylabel="position error [m]")
    right.set(title="gradient", ylabel="norm [–], variance [–]")
    legend(left)
    _keys(right, {"norm": {"linestyle": "-"}, "variance": {"linestyle": "--"}})
    for axes in (left, right):
        axes.set(xlabel="horizon T [steps]", xticks=HORIZONS)
        logarithmic(axes.yaxis)
    return figure


def draw_curriculum(evidence):
    """Validation error over training with and without the curriculum and its parts, of each seed and in the mean."""
    figure = Figure(figsize=(7.5, 6.4), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, colour) in zip(grid.flat, CURRICULUM_LOOK.items(), strict=True):
        each_seed(axes, evidence.curves, f"curriculum-{name}", "update", colour)
        mark_failing(axes, evidence.curves, f"curriculum-{name}", "update", colour)
        axes.set_title(CURRICULA[name], color=colour, fontweight="bold")
    logarithmic(grid[0, 0].yaxis)
    for below, beside in zip(grid[1], grid[:, 0], strict=True):
        below.set_xlabel("updates")
        beside.set_ylabel("position error [m]")
    return figure


def draw_adaptation(evidence):
    """What the residual learns from few transitions, then what the controller makes of it while it is tuned."""
    figure, (left, right) = panels(2, (10, 5.2))
    for system, look in SYSTEM_LOOK.items():
        budgets = _budgets(evidence, "apg", system)
        names = [f"drag-apg-{system}-{budget}" for budget in budgets]
        if budgets:
            errors = [evidence.spread(name, "learned_acceleration") for name in names]
            band(left, budgets, [_not_below(EXACT, one) for one in errors], look)
            rows = evidence.experiments[evidence.experiments.experiment.isin(names)]
            left.axhline(rows.model_acceleration.mean(), color=look[0], linestyle=":", linewidth=2)
        _tuning(right, evidence, system, look[0])
    left.set(title="learning the residual", xlabel="transitions in the target")
    left.set_ylabel(f"one-step acceleration error [m/s²]\n(drawn at {EXACT:g} where it is less)")
    right.set(title=f"tuning the controller ({WATCHED} transitions)", xlabel="updates")
    right.set_ylabel("error in the target [m]")
    right.plot([], [], ":", color=GREY, linewidth=2, label="model alone, zero-shot")
    right.plot([], [], "--", color=GREY, linewidth=2, label="flown in the model")
    logarithmic(left.xaxis, plain=False)
    for axes in (left, right):
        logarithmic(axes.yaxis)
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _not_below(least, numbers):
    """The same `Spread`, what is less in it raised to the least."""
    return numbers._replace(**{key: max(getattr(numbers, key), least) for key in NOTHING})


def _tuning(axes, evidence, system, colour):
    """The error in the target while the policy is tuned, between the levels of zero-shot and of the model."""
    name = f"drag-apg-{system}-{WATCHED}"
    spent = over(evidence.curves, name, "seconds").x.max()
    label = TITLES[system] + ("" if np.isnan(spent) else f" (takes {spent:.0f} s)")
    axes.plot([], [], color=colour, label=label)
    if curve(axes, evidence.curves, name, "update", colour):
        levels = {":": evidence.spread(name, "zero_shot"), "--": evidence.spread(f"apg-{system}")}
        for style, level in levels.items():
            if level:
                axes.axhline(level.mean, color=colour, linestyle=style, linewidth=2)


def draw_samples(evidence):
    """Error in the target over the number of transitions there, for every method; 0 is zero-shot."""
    figure, both = panels(2, (10, 4.8))
    shown = (ZERO, *sorted({int(setting) for setting in evidence.published.setting if setting.isdigit()}))
    for axes, system in zip(both, SYSTEM_LOOK, strict=True):
        for method, look in METHOD_LOOK.items():
            budgets = _budgets(evidence, method, system)
            names = {ZERO: f"drag-{method}-{system}-zero"} | {n: f"drag-{method}-{system}-{n}" for n in budgets}
            ran = {x: evidence.spread(name) for x, name in names.items() if evidence.rows(name) is not None}
            label = "MPC (+ residual)" if method == "mpc" else METHODS[method]
            if ran:
                band(axes, list(ran), list(ran.values()), look, label=label)
            _best(axes, evidence, method, system, look[0])
            papers = {n: evidence.paper("table4", system, method, "zero-shot" if n == ZERO else str(n)) for n in shown}
            told = {n: paper.error for n, paper in papers.items() if paper and not np.isnan(paper.error)}
            published(axes, list(told), list(told.values()), look)
        axes.set(xscale="log", title=TITLES[system], xlabel="transitions in the target")
        axes.set(xlim=(ZERO / 1.4, None), ylabel="error [m]")
        logarithmic(axes.yaxis)
        axes.xaxis.set_major_locator(FixedLocator([ZERO, 100, 1000, 10_000, 100_000]))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xticklabels(["0", "100", "1k", "10k", "100k"])
    both[0].plot([], [], color=GREY, label="published", **PAPER_KEY)
    both[0].axhline(np.nan, color=GREY, linestyle="--", linewidth=1.6, label="oracle")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure


def _best(axes, evidence, method, system, colour):
    """The level of the same method in the true target, where it was tuned or planned there."""
    found = {"apg": (f"drag-apg-{system}-{WATCHED}", "oracle"), "mpc": (f"drag-mpc-{system}-target", "error")}
    level = method in found and evidence.spread(*found[method])
    if level and level.failed < level.seeds:
        axes.axhline(level.mean, color=colour, linestyle="--", linewidth=1.6)


def _budgets(evidence, method, system):
    """Numbers of transitions that a method was run with in the target."""
    found = [re.fullmatch(rf"drag-{method}-{system}-(\d+)", name) for name in evidence.experiments.experiment.unique()]
    return sorted(int(match[1]) for match in found if match)


def draw_learning(evidence):
    """Validation error over steps of the environment and over wall-clock time, of APG and PPO from scratch."""
    figure = Figure(figsize=(10, 7.4), layout="constrained")
    rows = figure.subplots(2, 2, sharey="row")
    for row, system in zip(rows, SYSTEM_LOOK, strict=True):
        for axes, x in zip(row, ("samples", "seconds"), strict=True):
            for method in ("apg", "ppo"):
                name, colour = f"{method}-{system}", METHOD_LOOK[method][0]
                curve(axes, evidence.curves, name, x, colour, label=METHODS[method])
                mark_failing(axes, evidence.curves, name, x, colour)
            axes.set_title(TITLES[system])
            logarithmic(axes.xaxis, plain=False)
            logarithmic(axes.yaxis)
            axes.set_xlabel("steps of the environment" if x == "samples" else "training time, validation included [s]")
        row[0].set_ylabel("error of successful flights [m]")
    rows[0][0].plot([], [], color=GREY, label=f"less than {MOST:.0%} succeed", **FAILING_LOOK)
    figure.legend(*rows[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def draw_speed(evidence):
    """Validation error over wall-clock time with compiled and with eager dynamics; the updates are the same."""
    figure, axes = panels(2, (10, 4.2))
    for one, system in zip(axes, SYSTEM_LOOK, strict=True):
        for build, (colour, style) in BUILD_LOOK.items():
            curve(one, evidence.curves, f"speed-{build}-{system}", "seconds", colour, linestyle=style, label=build)
        one.set_title(TITLES[system])
        logarithmic(one.xaxis, plain=False)
        logarithmic(one.yaxis)
        one.set_xlabel("training time, validation included [s]")
    axes[0].set_ylabel("error of successful flights [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


AIRCRAFT = "(quadrotor|fixed_wing)"
PICTURES = {
    "horizon": Picture(draw_horizon, rows=r"horizon-.*", table="table2"),
    "curriculum": Picture(draw_curriculum, curves=r"curriculum-.*"),
    "adaptation": Picture(
        draw_adaptation, rf"drag-apg-{AIRCRAFT}-\d+", rf"drag-apg-{AIRCRAFT}-{WATCHED}", levels=f"apg-{AIRCRAFT}"
    ),
    "samples": Picture(draw_samples, rows=rf"drag-.*-{AIRCRAFT}-(zero|target|\d+)", table="table4"),
    "learning": Picture(draw_learning, curves=rf"(apg|ppo)-{AIRCRAFT}"),
    "speed": Picture(draw_speed, curves=rf"speed-(compiled|eager)-{AIRCRAFT}"),
}
