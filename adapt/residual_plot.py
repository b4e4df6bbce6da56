"""Picture of a residual: what the model lacks in each transition, measured, against what the residual adds."""

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from adapt.plot_style import COLOURS, LIGHT, axis_of, number
from adapt.prediction import GROUPS, predict


def draw_residual(adaptation):
    """What the model lacks in each transition, measured, against what the residual adds."""
    system, transitions = adaptation.policy.task.system, adaptation.transitions
    lack, added = lacks(adaptation)
    rows = _rows(matters(system, transitions, lack, added))
    width = max(len(names) for names in rows)
    panel = min(max(2.2, 5.6 / width), 3.6)
    figure = Figure(figsize=(0.7 + panel * width, 1.0 + (0.35 + panel) * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), width, squeeze=False)
    for axes in grid.flat:
        axes.set_visible(False)
    for names, row in zip(rows, grid, strict=True):
        for axes, name in zip(row, names, strict=False):
            place, axis = system.accelerations.index(name), axis_of(system, name)
            axes.set_visible(True)
            _draw_lack(axes, lack[:, place], added[:, place])
            axes.set_title(axis.label)
            axes.set_xlabel(f"[{axis.unit}²]" if axis.unit else "")
    figure.supxlabel("acceleration that the model lacks")
    figure.supylabel("residual adds")
    figure.suptitle(_prediction(adaptation, [name for names in rows for name in names]))
    return figure


def _rows(names):
    """Names in rows of at most three, as even as they go."""
    width = 2 if len(names) == 4 else 3
    return [names[i : i + width] for i in range(0, len(names), width)]


def lacks(adaptation):
    """Accelerations (N, k) that the model lacks by the transitions, and those that the residual adds.

    Both are differences over one control period, divided by it, of the rows `accelerations` of the state.
    """
    residual, transitions = adaptation.residual, adaptation.transitions
    rows = [transitions.state_names.index(name) for name in residual.system.accelerations]
    with torch.no_grad():
        model, learned = predict(residual.base, transitions), predict(residual, transitions)
    differences = (transitions.next_state - model, learned - model)
    return tuple((d[:, rows] / transitions.dt).cpu().double().numpy() for d in differences)


def matters(system, transitions, lack, added, share=0.01):
    """Names of accelerations that the model lacks, or the residual adds, by more than a share of what is flown.

    What turns and what moves are measured apart, each by its largest acceleration. The largest stays if none matters.
    """
    rows = [transitions.state_names.index(name) for name in system.accelerations]
    change = ((transitions.next_state - transitions.state)[:, rows] / transitions.dt).cpu().double().numpy()
    flown, size = (np.sqrt(np.square(part).mean(0)) for part in (change, np.maximum(np.abs(lack), np.abs(added))))
    turning = np.array([name in GROUPS["rates"] for name in system.accelerations])
    largest = [flown[turning == turns].max() for turns in turning]
    ratio = size / np.maximum(largest, 1e-9)
    chosen = ratio > min(share, 0.999 * ratio.max())
    chosen[ratio.argmax()] = True
    return [name for name, on in zip(system.accelerations, chosen, strict=True) if on]


def _draw_lack(axes, lack, added):
    """Points on and around the diagonal; both directions have the same scale."""
    both = np.concatenate((lack, added))
    middle, reach = (both.max() + both.min()) / 2, max(0.55 * (both.max() - both.min()), 0.01)
    limits = (middle - reach, middle + reach)
    axes.plot(limits, limits, color=LIGHT, linewidth=7, zorder=1)
    size = float(np.clip(6000 / len(lack), 8, 40))
    axes.scatter(lack, added, s=size, color=COLOURS["few_shot"], alpha=0.6, linewidth=0, zorder=2)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(3))


def _prediction(adaptation, names):
    """One-step errors on held-out transitions before and after, of the groups that are shown."""
    before, after = (adaptation.prediction[name] for name in ("model", "model + residual"))
    units = {"acceleration": ("velocity", "m/s²"), "angular_acceleration": ("rates", "rad/s²")}
    said = []
    for key, (group, unit) in units.items():
        if key in before and set(names) & set(GROUPS[group]):
            said.append(f"{number(before[key])} → {number(after[key])} {unit}")
    return "RMS on held-out transitions\n" + ", ".join(said)
