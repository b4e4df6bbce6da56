"""Parts that the figures of results share: how methods look, means with bands, curves over training, axes."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

from adapt.experiment_table import MODES
from adapt.plot_style import GREY

# Okabe and Ito 2008, in an order of falling importance; markers tell lines apart in print, too.
BLUE, ORANGE, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
MODE_LOOK = dict(zip(MODES, ((BLUE, "o"), (ORANGE, "s"), (GREEN, "D")), strict=True))
METHOD_LOOK = {"apg": (BLUE, "o"), "ppo": (ORANGE, "s"), "pets": (GREEN, "D"), "mpc": (GREY, "^")}
CURRICULUM_LOOK = {"both": BLUE, "none": ORANGE, "threshold": GREEN, "speed": PINK}
BUILD_LOOK = {"compiled": (BLUE, "-"), "eager": (ORANGE, "--")}
SYSTEM_LOOK = {"quadrotor": (BLUE, "o"), "fixed_wing": (ORANGE, "s")}
NOTHING = {"low": np.nan, "mean": np.nan, "high": np.nan}
MOST = 0.9  # share of flights
MANY = 1e6  # that an axis reaches over from its least to its greatest value
FAILING_LOOK = {"linestyle": "none", "marker": "o", "markersize": 7, "markerfacecolor": "white", "markeredgewidth": 2}
PAPER_KEY = {"linestyle": ":", "marker": "o", "markersize": 8, "markerfacecolor": "white", "linewidth": 1.6}


def panels(count, size, **settings):
    """A figure of `size` [inch] with some axes side by side."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(1, count, squeeze=False, **settings)[0]


def logarithmic(axis, plain=True):
    """Make an axis logarithmic and label it at 1 and, of few decades, 3 of each, with plain numbers or 10k, 3M.

    Plain numbers over many decades are powers of ten. To be called when all is drawn; an axis without a number on it
    has no scale and no ticks.
    """
    if not np.isfinite(axis.get_minpos()):
        axis.set_ticks([])
        return
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = axis.get_view_interval()
    many = high / low >= MANY
    axis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 3.0)))
    written = LogFormatterMathtext() if many else FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(written if plain else EngFormatter(sep=""))
    axis.set_minor_formatter(NullFormatter())


def band(axes, x, spreads, look, **settings):
    """Mean and band of some `Spread`s; where most seeds have no number there is a gap, as in `over`."""
    colour, marker = look
    spreads = [one._replace(**NOTHING) if one.failed > one.seeds / 2 else one for one in spreads]
    low, mean, high = (np.array([getattr(one, key) for one in spreads], dtype=float) for key in ("low", "mean", "high"))
    axes.plot(x, mean, color=colour, marker=marker, markersize=7, **settings)
    axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)


def published(axes, x, errors, look):
    """The paper's values: open markers."""
    colour, marker = look
    axes.plot(x, errors, ":", color=colour, marker=marker, markersize=8, markerfacecolor="white", linewidth=1.6)


def over(curves, name, x, column="error"):
    """x, mean, least, greatest over seeds of a curve, at the updates that all of its seeds reached.

    Where fewer than half of the seeds have a number (no flight succeeded) the mean of the rest would flatter: a gap.
    """
    rows = curves[curves.experiment == name]
    groups = rows.groupby("update")
    found = groups[column].agg(["mean", "min", "max", "count"]).set_axis(["mean", "low", "high", "there"], axis=1)
    found["x"] = groups[x].mean() if x != "update" else found.index
    found["seeds"] = groups.seed.nunique()
    found = found[found.seeds == rows.seed.nunique()]
    found.loc[found.there < found.seeds / 2, list(NOTHING)] = np.nan
    return found


def curve(axes, curves, name, x, colour, **settings):
    """Draw `over`; returns whether there was anything to draw."""
    found = over(curves, name, x)
    if found["mean"].notna().any() and found.x.notna().any():
        axes.plot(found.x, found["mean"], color=colour, **settings)
        axes.fill_between(found.x, found.low, found.high, color=colour, alpha=0.2, linewidth=0)
        return True
    return False


def each_seed(axes, curves, name, x, colour):
    """Draw every seed of a curve by a thin line, and the mean of `over` by a thick one."""
    for _, seed in curves[curves.experiment == name].groupby("seed"):
        axes.plot(seed[x], seed.error, color=colour, linewidth=1.2, alpha=0.6)
    found = over(curves, name, x)
    axes.plot(found.x, found["mean"], color=colour, linewidth=3.2)


def mark_failing(axes, curves, name, x, colour):
    """Open circles where less than `MOST` of the flights of a curve succeed: the error is that of the others."""
    found, success = over(curves, name, x), over(curves, name, x, "success")
    found = found[success["mean"] < MOST]
    axes.plot(found.x, found["mean"], color=colour, **FAILING_LOOK)


def legend(axes, **settings):
    """A legend if there is anything to explain; there may be no results yet."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**settings)
