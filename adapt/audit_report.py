"""What `adapt.audit` prints and draws: how far errors changed, how often for the worse, with the gate and without."""

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from adapt.audit_case import BETTER, FEWER, WORSE
from adapt.figure_parts import BLUE, ORANGE, panels
from adapt.plot_style import DPI, GREY, STYLE
from policies.files import whole

NOTICED = 1.2  # times the error in the model that a target must cost before the gap to it means anything
SPAN = (0.01, 4.0)  # of the ratios that are drawn; beyond stands for all and none
BOTH = {"ratio": ("with the gate", BLUE, "-"), "ratio_ungated": ("without", ORANGE, "--")}


def numbers(table):
    """The table of `adapt.audit.read` with numbers where it has any."""
    text = ("system", "target", "corruption", "kind", "parameters", "unit", "reason", "refused_data", "crash", "commit")
    other = [column for column in table if column not in (*text, "accepted", "python", *_packages(table))]
    rows = table.copy()
    rows[other] = rows[other].replace("nan", "").apply(pd.to_numeric)
    rows["accepted"] = rows.accepted == "True"
    return rows


def _packages(table):
    return [name for name in ("torch", "torchrl", "tensordict", "casadi") if name in table]


def table(rows):
    """The figures of each system as text."""
    from tabulate import tabulate

    columns = {name: figures(part) for name, part in rows.groupby("system", sort=False)}
    lines = [(key, *(column[key] for column in columns.values())) for key in next(iter(columns.values()))]
    episodes = "/".join(f"{n:g}" for n in sorted(rows.episodes.dropna().unique()))
    note = f"\nratio: new over old error on {episodes} test episodes, over those that both policies fly"
    note += (
        f"\nworse: more flights fail, or the ratio is above {WORSE:g}; better: fewer fail, or it is below {BETTER:g}"
    )
    key, name = _bound(rows)
    quiet = "" if key == "oracle" else ", noisy targets left out"
    note += f"\ngap: (zero-shot - few-shot) / (zero-shot - {name}), where that costs {NOTICED - 1:.0%} or more{quiet}"
    note += "".join(f"\ncrash: {row.system} {row.Index}: {row.crash}" for row in _crashed(rows).itertuples())
    return "\n" + tabulate(lines, ("", *columns), "simple", disable_numparse=True) + "\n" + note + "\n"


def _crashed(rows):
    """Cases that crashed, by their index."""
    return rows[rows.crash != ""].set_index("index")


def figures(rows):
    """{what: text} of the cases of a system."""
    crashed, rows = rows[rows.crash != ""], rows[rows.crash == ""]
    found = {"cases": str(len(rows) + len(crashed)), "crashes or NaN": str(len(crashed))}
    found["data refused"] = str(int((rows.refused_data != "").sum()))
    found["gate accepts"] = _percent(rows.accepted)
    for column, (name, *_) in BOTH.items():
        ratio = rows[column]
        found[f"worse, {name}"] = f"{_percent(ratio > WORSE)} ({int((ratio > WORSE).sum())})"
        found[f"better, {name}"] = _percent(_better(rows, column))
        found[f"ratio, {name}: median"] = f"{_quantile(ratio, 0.5):.3f}"
        found[f"ratio, {name}: 95 % quantile"] = f"{_quantile(ratio, 0.95):.3f}"
    found["success: old, gated, ungated"] = ", ".join(
        f"{rows[f'{name}_success'].mean():.3f}" for name in ("zero_shot", "gated", "ungated")
    )
    closed = gap(rows, "gated").dropna()
    quartiles = " … ".join(f"{closed.quantile(q):.3f}" for q in (0.25, 0.75)) if len(closed) else "–"
    found["gap closed: median (quartiles), N"] = f"{closed.median():.3f} ({quartiles}), {len(closed)}"
    for name in ("fit", "finetune", "gate"):
        found[f"seconds of {name}: median"] = f"{rows[f'seconds_{name}'].median():.1f}"
    found["processor seconds of a case: median"] = f"{rows.cpu_seconds.median():.1f}"
    return {what: text.replace("nan", "–") for what, text in found.items()}


def _better(rows, column):
    """Which cases got better: fewer flights fail, or errors are smaller and no more flights fail."""
    success = rows["gated_success" if column == "ratio" else "ungated_success"]
    return (rows[column] < BETTER) | (success - rows.zero_shot_success > FEWER)


def _percent(which):
    return f"{which.mean():.1%}"


def _quantile(ratio, share):
    """Of all cases, infinite ones among them; nothing is interpolated."""
    return float(np.quantile(ratio, share, method="inverted_cdf")) if len(ratio) else np.nan


def gap(rows, name):
    """Share of what a target costs that a policy wins back, NaN where it costs little or policies fly other episodes.

    Without an oracle nothing says what measurement noise costs for good, so noisy targets are left out.
    """
    column = _bound(rows)[0]
    bound = rows[f"{column}_error"]
    cost = rows.zero_shot_error - bound
    told = (cost > (NOTICED - 1) * bound) & ((rows.noise.fillna(0) == 0) | (column == "oracle"))
    for other in (name, column):  # each error is that of the episodes that the policy flies
        told &= rows[f"{other}_success"] == rows.zero_shot_success
    return ((rows.zero_shot_error - rows[f"{name}_error"]) / cost).where(told)


def _bound(rows):
    """Key and name of the error that can be reached: by an oracle where every case that adapted has one."""
    told = rows[rows.source_error.notna()].oracle_error.notna()
    return ("oracle", "oracle") if len(told) and told.all() else ("source", "error in the model")


def save(rows, path):
    """Draw `audit.png`; the file is there whole or not at all."""
    with matplotlib.rc_context(STYLE):
        figure = draw(rows)
        with whole(path) as partial:
            figure.savefig(partial, format="png", dpi=DPI)


def draw(rows):
    """For each system the share of cases up to each ratio of new to old error, gated and ungated."""
    names = list(dict.fromkeys(rows.system))
    figure, axes = panels(len(names), (3.6 * len(names) + 0.4, 4.5), sharey=True)
    for one, name in zip(axes, names, strict=True):
        part = rows[(rows.system == name) & (rows.crash == "")]
        _draw(one, part)
        one.set_title(f"{name.replace('_', ' ')}, N = {len(part)}")
    axes[0].set_ylabel("share of cases")
    label = ("error of the adapted policy", "/ of the old one [-]")  # in two lines under a single panel
    figure.supxlabel(("\n" if len(names) == 1 else " ").join(label), fontsize=STYLE["axes.labelsize"])
    handles = [Line2D([], [], color=colour, linestyle=style, label=name) for name, colour, style in BOTH.values()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return figure


def _draw(axes, rows):
    axes.axvspan(WORSE, SPAN[1], color="#EFEFEF", linewidth=0)
    axes.axvline(1.0, color=GREY, linewidth=1.2)
    write = {"ha": "right", "va": "bottom", "transform": axes.transAxes}
    for line, (column, (name, colour, style)) in enumerate(reversed(BOTH.items())):
        ratio = np.sort(rows[column].clip(*SPAN))
        shares = np.arange(1, len(ratio) + 1) / max(len(ratio), 1)
        ends = [SPAN[0], *ratio, SPAN[1]], [0, *shares, 1]
        axes.step(*ends, color=colour, linestyle=style, where="post", label=name)
        axes.text(0.97, 0.03 + 0.09 * line, _percent(rows[column] > WORSE), color=colour, fontweight="bold", **write)
    axes.text(0.97, 0.03 + 0.09 * len(BOTH), "worse", color=GREY, **write)
    if (rows.ratio == 0).any():
        clear = (rows[list(BOTH)] < 8 * SPAN[0]).mean().max() + 0.02  # of the lines, as far as the words reach
        axes.text(SPAN[0] * 1.15, clear, "only the new\none flies", color=GREY, fontsize="small", va="bottom")
    axes.set(xscale="log", xlim=SPAN, ylim=(0, 1.02))
    axes.set_xticks((0.01, 0.1, 1.0))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
