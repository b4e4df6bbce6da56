"""What stands where in the paper's tables: rows, columns and notes, the paper's value beside each of ours."""

import math
import re

from adapt import target_tables
from adapt.experiment_table import EXPERIMENTS, HORIZONS, MODES, SYSTEMS
from adapt.table_cells import (
    CLUSTER,
    METHODS,
    MODE_NAMES,
    NONE,
    SAMPLES,
    SYSTEM_NAMES,
    Table,
    amount,
    bar_of,
    count,
    counts,
    milliseconds,
    ours,
    seeds,
    theirs,
    time,
)


def in_the_model(evidence):
    """Table I: methods × systems."""
    lines = [(f"{m}-{s}", SYSTEM_NAMES[s], METHODS[m], s, m, "source") for s in SYSTEMS for m in METHODS]
    lines += [(f"{m}-quadrotor-fast", "quadrotor at 3 m/s [m]", METHODS[m], None, m, None) for m in ("ppo", "apg")]
    lines += [("apg-quadrotor-paper", "quadrotor [m]", "APG, optimiser of the paper", "quadrotor", "apg", "source")]
    rows = []
    for name, system_name, method_name, system, method, setting in lines:
        paper = evidence.paper("table1", system, method, setting)
        bar = None if method == "mpc" else bar_of(evidence, "table1", system, setting)
        cells = [system_name, method_name, ours(evidence, name, bar), theirs(paper)]
        cells += [milliseconds(time(evidence, name)), milliseconds(paper and paper.runtime_ms)]
        rows.append([*cells, counts(evidence, name), seeds(evidence, name)])
    columns = ("system", "method", "error", "published", "ms per action", "published", "samples", "seeds")
    note = f"Time: median per action on one thread. {SAMPLES}"
    return Table("Table I: error in the model", columns, rows, note)


def by_horizon(evidence):
    """Table II: horizon × mode."""
    rows = []
    for horizon in HORIZONS:
        names = [f"horizon-{mode}-{horizon}" for mode in MODES]
        bar = bar_of(evidence, "table2", "quadrotor", str(horizon))
        cells = [str(horizon)]
        for mode, name in zip(MODES, names, strict=True):
            cells += [ours(evidence, name, bar), theirs(evidence.paper("table2", "quadrotor", mode, str(horizon)))]
        rows.append([*cells, counts(evidence, *names), seeds(evidence, *names)])
    columns = [column for mode in MODES for column in (MODE_NAMES[mode], "published")]
    note = f"Quadrotor, position error [m] over paths that are the same for all horizons. {SAMPLES}"
    return Table("Table II: horizon", ("T", *columns, "samples", "seeds"), rows, note)


def from_pictures(evidence):
    """Table III: CartPole from pictures, and the adaptation of a policy that sees pictures."""
    rows = []
    for method in ("mpc", "ppo", "apg"):
        name, paper = f"pictures-{method}", evidence.paper("table3", "cartpole", method, "pictures")
        bar = None if method == "mpc" else bar_of(evidence, "table3", "cartpole", "pictures")
        with_samples = paper is not None and not math.isnan(paper.samples)
        cells = [METHODS[method], NONE, ours(evidence, name, bar), theirs(paper), counts(evidence, name)]
        rows.append([*cells, count(paper.samples) if with_samples else NONE, seeds(evidence, name)])
    for name, what in {"push": "a steady push", "background": "another background"}.items():
        name = f"pictures-apg-{name}"
        cells = [f"APG, adapted to {what}", amount(evidence.spread(name, "zero_shot")), ours(evidence, name)]
        rows.append([*cells, NONE, counts(evidence, name), NONE, seeds(evidence, name)])
    columns = ("method", "zero-shot", "error", "published", "samples", "published with", "seeds")
    note = "CartPole, mean cart speed [m/s]. Samples: transitions whose pictures were used."
    return Table("Table III: CartPole from pictures", columns, rows, note)


def in_drag(system):
    """The function that makes Table IV of a system."""
    return lambda evidence: _in_drag(evidence, system)


def _in_drag(evidence, system):
    methods = ("ppo", "pets", "apg", "mpc")
    rows = []
    for setting, title in _settings(evidence, system).items():
        bar = bar_of(evidence, "table4", system, setting)
        names = [_experiment(system, method, setting) for method in methods]
        cells = [title]
        for method, name in zip(methods, names, strict=True):
            by_oracle = setting == "oracle" and method == "apg"
            cells.append(
                _oracle(evidence, name) if by_oracle else ours(evidence, name, bar if method != "mpc" else None)
            )
            if method != "mpc":
                cells.append(theirs(evidence.paper("table4", system, method, setting)))
        rows.append([*cells, seeds(evidence, *names)])
    columns = ("transitions in the target", *(c for m in methods[:3] for c in (METHODS[m], "published")), "MPC")
    note = (
        "MPC plans in the nominal model, in model + residual of as many transitions and, last, in the true target; APG"
        " is tuned there in the last row. Seeds: of PPO / PETS / APG / MPC."
    )
    if any(CLUSTER in row for row in rows):
        note += f" {CLUSTER.capitalize()}: takes more than a machine with two cores, not run."
    name = SYSTEM_NAMES[system]
    return Table(f"Table IV: adaptation to drag 0.3, {name}", (*columns, "seeds"), rows, note)


def _settings(evidence, system):
    """Setting → title of the rows of Table IV: every budget that there is an experiment or a published value for."""
    found = [re.fullmatch(rf"drag-\w+-{system}-(\d+)", name) for name in EXPERIMENTS]
    budgets = {int(match[1]) for match in found if match}
    rows = evidence.published
    published = rows.setting[(rows.table == "table4") & (rows.system == system)]
    budgets |= {int(setting) for setting in published if setting.isdigit()}
    titles = {"source": "in the model", "zero-shot": "0 (zero-shot)"}
    titles |= {
        str(budget): f"{budget:,}".replace(",", " ") if budget > 9999 else str(budget) for budget in sorted(budgets)
    }
    return titles | {"residual": "150 000 in model + residual", "oracle": "oracle"}


def _experiment(system, method, setting):
    """The experiment behind a cell of Table IV; there need not be one of that name."""
    if setting == "source":
        return f"{method}-{system}"
    if setting == "oracle":
        return f"drag-{method}-{system}-{'1000' if method == 'apg' else 'target'}"
    return f"drag-{method}-{system}-{'zero' if setting == 'zero-shot' else setting}"


def _oracle(evidence, name):
    numbers = evidence.spread(name, "oracle")
    return NONE if numbers is None or numbers.failed == numbers.seeds else amount(numbers)


LAYOUTS = {
    "table1": in_the_model,
    "table2": by_horizon,
    "table3": from_pictures,
    "table4-quadrotor": in_drag("quadrotor"),
    "table4-fixed_wing": in_drag("fixed_wing"),
    **target_tables.LAYOUTS,
}
