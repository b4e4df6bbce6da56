"""How pictures look: made to be read at half the width of a page.

Large type, thick lines, colours that colour-blind people tell apart (Okabe and Ito 2008), and a sequential map (plasma,
without its pale end) for the error along a path; numbers of few digits, in units that are easy to read.
"""

import matplotlib
import numpy as np
from matplotlib.colors import LinearSegmentedColormap

from envs.system import Axis

DPI = 150
GREY, LIGHT = "#595959", "#BDBDBD"
COLOURS = {"source": GREY, "zero_shot": "#D55E00", "few_shot": "#0072B2", "oracle": "#009E73"}
LINES = {"source": "--", "oracle": (0, (2, 2))}  # what lies below the oracle's line, as few-shot should, is seen
STYLE = {
    "font.size": 13,
    "axes.titlesize": 14,
    "axes.labelsize": 13,
    "figure.titlesize": 15,
    "legend.fontsize": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.linewidth": 1.2,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 1.0,
    "lines.linewidth": 2.8,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "figure.facecolor": "white",
}
ERROR_MAP = LinearSegmentedColormap.from_list("error", matplotlib.colormaps["plasma"](np.linspace(0.0, 0.82, 256)))


def small(values, unit):
    """Factor and unit in which lengths or speeds are easy to read: centimetres where all are below one metre."""
    finite = np.abs(np.asarray(values, dtype=float))
    finite = finite[np.isfinite(finite)]
    if unit.split("/")[0] == "m" and len(finite) and finite.max() < 1:
        return 100.0, "c" + unit
    return 1.0, unit


def number(value):
    """Two significant digits, without an exponent."""
    if not np.isfinite(value):
        return "–"
    if value and abs(value) < 1e-3:
        return "< 0.001"
    digits = 1 - int(np.floor(np.log10(abs(value) or 1.0)))
    return f"{value:.{min(max(digits, 0), 3)}f}"


def axis_of(system, name):
    """How a state, or the time "t", is shown."""
    return Axis("time", "s") if name == "t" else system.axes.get(name, Axis(name, ""))


def label(axis, power=""):
    """An axis label with its unit."""
    return f"{axis.label} [{axis.unit}{power}]" if axis.unit else axis.label


def smoothed(values):
    """Running median over a tenth of the values, shorter at both ends, without those that aren't finite."""
    half = max(1, len(values) // 20)
    windows = [values[max(0, i - half) : i + half + 1] for i in range(len(values))]
    finite = [window[np.isfinite(window)] for window in windows]
    return np.array([np.median(window) if len(window) else np.nan for window in finite])
