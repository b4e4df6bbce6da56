"""What `adapt.marker` prints and draws."""

from adapt.report import UNITS

NAMES = {"model": "model", "context_free": "context-free", "conditioned": "sees pictures", "true_mass": "told the mass"}
FLOWN = {"zero_shot": "zero-shot", "context_free": "context-free", "conditioned": "sees pictures"}
COLOURS = {"model": "#595959", "context_free": "#E69F00", "conditioned": "#009E73"}  # Okabe and Ito (2008)
SHOWN = "acceleration"  # the one-step error that is drawn


def table(metrics):
    """One-step errors and flights of a run as text."""
    from tabulate import tabulate

    errors, ratios = metrics["prediction"], metrics["ratios"]
    rows = [(UNITS[row], *(errors[name][row] for name in NAMES), ratios[row]) for row in ratios]
    header = (f"{metrics['n']} unseen transitions, one step", *NAMES.values(), "ratio")
    parts = [tabulate(rows, header, "simple", floatfmt=".3g")]
    flights = metrics["flights"]
    rows = [(_pole(metrics, pole), *(_score(flights[pole][name]) for name in FLOWN)) for pole in flights]
    header = (f"test flights: {metrics['metric']} [{metrics['unit']}]", *FLOWN.values())
    parts.append(tabulate(rows, header, "simple"))
    parts.append(f"largest ratio of one-step errors, sees pictures / context-free: {metrics['ratio']:.3g}")
    spent = ", ".join(f"{name} {seconds:.1f}" for name, seconds in metrics["seconds"].items())
    parts.append(f"seconds ({metrics['threads']} thread{'s' * (metrics['threads'] > 1)}): {spent}")
    parts.extend(f"note: {text}" for text in metrics["warnings"])
    return "\n\n" + "\n\n".join(parts) + "\n"


def _pole(metrics, name):
    return f"{name} pole, {metrics['pole_mass'][name]:g} kg"


def _score(summary):
    """Mean and spread of the flights that succeeded, and the share that did where it isn't all."""
    if not summary["success"]:
        return "all fail"
    said = f"{summary['mean']:.4f} ± {summary['std']:.4f}"
    return said if summary["success"] == 1 else f"{said}, {summary['success']:.0%} succeed"


def save(metrics, frames, path):
    """Draw `marker.png`; the file is there whole or not at all.

    Args:
        frames: a picture (3, height, width), uint8, of each pole.
    """
    import matplotlib

    from adapt.plot_style import DPI, STYLE
    from policies.files import whole

    with matplotlib.rc_context(STYLE):
        figure = draw(metrics, frames)
        with whole(path) as partial:
            figure.savefig(partial, format="png", dpi=DPI)


def draw(metrics, frames):
    """What the camera sees of each pole, beside the one-step errors with it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    grid = figure.subplots(len(frames), 2, width_ratios=(1, 1.35), squeeze=False)
    poles = metrics["prediction_by_pole"]
    longest = max(poles[pole][name][SHOWN] for pole in poles for name in COLOURS)
    for (left, right), pole, frame in zip(grid, poles, frames, strict=True):
        _draw_frame(left, frame)
        left.set_title(_pole(metrics, pole))
        _draw_bars(right, {name: poles[pole][name][SHOWN] for name in COLOURS}, longest)
    grid[-1, 1].set_xlabel("one-step acceleration error [m/s²]")
    figure.suptitle(f"{metrics['samples']} transitions; the colour of the tip tells which pole is mounted")
    return figure


def _draw_frame(axes, frame):
    """The middle half of a picture, pixel by pixel: the robot stays there, and its tip is three pixels wide."""
    width = frame.shape[-1]
    axes.imshow(frame[:, :, width // 4 : width - width // 4].permute(1, 2, 0).numpy(), interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.grid(False)


def _draw_bars(axes, errors, longest):
    from adapt.plot_style import number

    places = range(len(errors))
    axes.barh(places, list(errors.values()), color=[COLOURS[name] for name in errors], height=0.7)
    for place, error in zip(places, errors.values(), strict=True):
        axes.text(error + 0.02 * longest, place, number(error), va="center")
    axes.set_yticks(places, [NAMES[name] for name in errors])
    axes.set_xlim(0, 1.2 * longest)
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)
