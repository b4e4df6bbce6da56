"""Tables beyond the paper's: other targets, what the choice of a residual costs, third-party simulators."""

from adapt.evidence import spread
from adapt.experiment_table import AIRCRAFT, ALL, ALL_SLIGHTLY, CHANGES, FEW, FEWEST, KINDS_TRIED, NOISY, SIMULATED
from adapt.table_cells import NONE, SYSTEM_NAMES, Table, amount, decimals, ours, percent, seeds

NAMES = {
    "drag": "drag 0.3",
    "push": "push 0.5",
    "wind": "wind 3 / 2",
    "mass": "mass × 1.3",
    "thrust": "thrust × 0.85",
    "quadratic": "quadratic drag 0.1 / 0.02",
    "all": "all together",
}
SHIPPED = "The policy that ships, `adapt.fewshot` as it comes."


def in_other_targets(evidence):
    """Targets × aircraft: error before and after, and how much of what could be gained was."""
    lines = [("drag", samples, "") for samples in sorted((*FEWEST, FEW))]
    lines += [(change, FEW, "") for change in CHANGES if change != "drag"]
    lines += [(change, NOISY, "-noisy") for change in CHANGES]
    rows = []
    for change, samples, noisy in lines:
        names = [f"target-{change}{noisy}-{system}-{samples}" for system in AIRCRAFT]
        cells = [NAMES[change] + (" through sensors" if noisy else ""), str(samples)]
        for name in names:
            found = evidence.rows(name)
            cells += [plain(found, "zero_shot"), ours(evidence, name), plain(found, "oracle")]
            cells.append(gap_closed(found, "oracle"))
        rows.append([*cells, seeds(evidence, *names)])
    before = [SYSTEM_NAMES[system].replace(" [", ", zero-shot [") for system in AIRCRAFT]
    columns = [column for name in before for column in (name, "few-shot", "oracle", "gap closed")]
    note = (
        f"{SHIPPED} Two strengths: of the quadrotor / of the fixed wing, which has less thrust to spare. All together:"
        f" {' '.join(ALL)} / {' '.join(ALL_SLIGHTLY)}. Oracle: tuned as long in the true target. Gap closed:"
        " (zero-shot - few-shot) / (zero-shot - oracle), mean over seeds, in brackets the least; above 1 where few-shot"
        " happens to end closer than the oracle. Sensors err by 1 mm, 0.02 m/s, 0.5 degrees and 0.05 rad/s."
    )
    return Table("Table V: other targets", ("target", "transitions", *columns, "seeds"), rows, note)


def by_kind(evidence):
    """Targets × kinds of residual: the error after adaptation with each, and what `auto` gives away."""
    rows = []
    for system in AIRCRAFT:
        for change in CHANGES:
            names = [f"kinds-{change}-{system}-{kind}" for kind in KINDS_TRIED]
            *kinds, chosen = same_seeds([evidence.rows(name) for name in (*names, f"target-{change}-{system}-{FEW}")])
            cells = [f"{SYSTEM_NAMES[system]}, {NAMES[change]}", *map(plain, (*kinds, chosen)), regret(kinds, chosen)]
            rows.append([*cells, next((str(len(found)) for found in kinds if found is not None), NONE)])
    note = (
        f"{SHIPPED} {FEW} transitions; kinds that were named fly without the gate. Regret: how much larger the error of"
        " auto is than that of the best kind in hindsight. Mean over the seeds that were run with all kinds."
    )
    return Table("Table VI: kinds of residual", ("target", *KINDS_TRIED, "auto", "regret", "seeds"), rows, note)


def in_simulators(evidence):
    """Third-party simulators: error in our model, before and after."""
    rows = []
    for plant in SIMULATED:
        name = f"simulator-{plant}"
        table = evidence.rows(name)
        flights = NONE if table is None else f"{table.n.max():.0f}"
        cells = [plant, flights, plain(table, "source"), plain(table, "zero_shot")]
        rows.append([*cells, ours(evidence, name), gap_closed(table, "source"), seeds(evidence, name)])
    columns = ("simulator", "test flights", "in our model", "zero-shot", "few-shot", "gap closed", "seeds")
    note = (
        f"{SHIPPED} {FEW} transitions. Errors in m, of MuJoCo's CartPole in m/s. Gap closed: (zero-shot - few-shot) /"
        " (zero-shot - in our model), mean over seeds, in brackets the least."
    )
    return Table("Table VII: third-party simulators", columns, rows, note)


def plain(rows, column="error"):
    """The mean of a column over seeds, without its spread; of `error` with the share that succeeds, where some fail."""
    numbers = None if rows is None or rows.empty else spread(rows[column])
    if numbers is None or numbers.failed:
        return amount(numbers)
    success = rows.success.mean() if column == "error" else 1.0
    return f"{numbers.mean:.{decimals(numbers.mean)}f}" + (f" ({percent(success)})" if success < 1 else "")


def same_seeds(tables):
    """The rows of the seeds that every table has; a table that is None stays so."""
    shared = set.intersection(*([set(rows.seed) for rows in tables if rows is not None] or [set()]))
    return [None if rows is None else rows[rows.seed.isin(shared)] for rows in tables]


def gap_closed(rows, bound):
    """(zero-shot - few-shot) / (zero-shot - bound): mean and least over the seeds where there is a gap to close."""
    if rows is None:
        return NONE
    cost = rows.zero_shot - rows[bound]
    closed = ((rows.zero_shot - rows.error) / cost.where(cost > 0)).dropna()
    return NONE if closed.empty else f"{closed.mean():.2f} ({closed.min():.2f})"


def regret(kinds, chosen):
    """By how much the mean error of the chosen residual is above that of the best kind that flies as much, in words."""
    if any(rows is None or rows.empty for rows in (*kinds, chosen)) or chosen.error.isna().any():
        return NONE
    flying = [rows for rows in kinds if rows.success.mean() >= chosen.success.mean()]
    errors = [rows.error.mean() for rows in flying if rows.error.notna().all()]
    return f"{chosen.error.mean() / min(errors) - 1:+.0%}".replace("%", " %") if errors else NONE


LAYOUTS = {"targets": in_other_targets, "kinds": by_kind, "simulators": in_simulators}
