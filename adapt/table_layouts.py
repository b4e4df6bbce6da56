"""What stands where in the tables: rows, columns and notes, the paper's value beside each of ours.

A cell of ours is the mean over seeds of `error` ± its standard deviation, and the share of episodes that succeed where
that is below 100 %. "–" stands for what hasn't been run or wasn't published.
"""

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

from adapt.experiment_table import EXPERIMENTS, HORIZONS, MODES, SYSTEMS

NONE, CLUSTER = "–", "cluster"
METHODS = {"mpc": "MPC", "ppo": "PPO", "pets": "PETS", "apg": "APG"}
SYSTEM_NAMES = {"cartpole": "CartPole [m/s]", "quadrotor": "quadrotor [m]", "fixed_wing": "fixed wing [m]"}
MODE_NAMES = {"concurrent": "concurrent", "autoregressive": "autoregressive", "recurrent": "LSTM"}
HOW = (
    "Mean ± standard deviation over seeds of the mean error over the test episodes that succeed; in brackets"
    " their share, where it is below 100 %. Published: ± over test episodes. **Bold**: at or below the best published"
    " learning-based value for the same system and setting, with no fewer successes."
)
SAMPLES = "Samples: transitions learned from."


@dataclass(frozen=True)
class Table:
    """A table as text: `rows` of cells under `columns`, with **bold** as in Markdown; `HOW` says how to read them."""

    title: str
    columns: tuple[str, ...]
    rows: list
    note: str


class Bar(NamedTuple):
    """What a value of ours has to reach to be bold."""

    error: float
    success: float


# --- cells ------------------------------------------------------------------------------------------------------------


def decimals(value):
    """Digits behind the point that leave two or three that mean something, and no more than four."""
    return 4 if abs(value) < 0.1 else 3 if abs(value) < 1 else 2


def amount(numbers, success=1.0):
    """A `Spread` in words: mean ± standard deviation, the mean alone of one seed, and how much of it fails."""
    if numbers is None:
        return NONE
    if numbers.failed == numbers.seeds:
        return "fails" if numbers.seeds == 1 else f"fails (all {numbers.seeds} seeds)"
    digits = decimals(numbers.mean)
    text = f"{numbers.mean:.{digits}f}" + (f" ± {numbers.std:.{digits}f}" if numbers.seeds > 1 else "")
    remarks = [percent(success)] if 0 < success < 1 else []
    remarks += [f"{numbers.failed} of {numbers.seeds} seeds fail"] if numbers.failed else []
    return text + (f" ({', '.join(remarks)})" if remarks else "")


def ours(evidence, name, bar=None):
    """The cell of an experiment, bold where it reaches the bar."""
    numbers = evidence.spread(name)
    if numbers is None:
        return CLUSTER if name in EXPERIMENTS and EXPERIMENTS[name].cluster else NONE
    success = evidence.rows(name).success.mean()
    text = amount(numbers, success)
    return f"**{text}**" if bar and _reaches(numbers, success, bar) else text


def percent(share):
    """A share in words; what is short of all is never rounded to all, nor a little to nothing."""
    digits = 0 if 0.01 <= share <= 0.99 else 1
    return f"{min(max(100 * share, 0.1), 99.9) if digits else 100 * share:.{digits}f} %"


def _reaches(numbers, success, bar):
    # A published success has two digits, so ours is compared with as many.
    return not numbers.failed and numbers.mean <= bar.error and round(success, 2) >= bar.success


def bar_of(evidence, table, system, setting):
    """The best published learning-based value; where all of them fail, whatever always succeeds is better.

    Returns:
        a `Bar`, or None where nothing was published.
    """
    rows = evidence.published
    rows = rows[(rows.table == table) & (rows.system == system) & (rows.setting == setting) & (rows.method != "mpc")]
    if rows.empty:
        return None
    if rows.error.isna().all():
        return Bar(math.inf, 1.0)
    best = rows.loc[rows.error.idxmin()]
    return Bar(best.error, 1.0 if math.isnan(best.success) else best.success)


def theirs(row):
    """The cell of a published value, with two digits as in print, or what was printed in place of a number."""
    if row is None:
        return NONE
    if math.isnan(row.error):
        return row.note
    text = f"{row.error:.2f} ± {row.std:.2f}"
    return text + (f" ({percent(row.success)})" if row.success < 1 else "")


def milliseconds(value):
    """A time per action with about two digits."""
    return NONE if value is None or math.isnan(value) else f"{value:.{2 if value < 1 else 1 if value < 100 else 0}f}"


def time(evidence, name):
    """The median time per action [ms] of an experiment, that of the median seed."""
    rows = evidence.rows(name)
    return None if rows is None else rows.median_ms.median()


def count(number):
    """A number of transitions: 1000, 150 k, 1.5 M."""
    if number < 10_000:
        return f"{number:.0f}"
    return f"{number / 1e3:.3g} k" if number < 999_500 else f"{number / 1e6:.3g} M"


def counts(evidence, *names):
    """The numbers of transitions of some experiments, "least–greatest" where they differ."""
    parts = [evidence.rows(name).samples for name in names if evidence.rows(name) is not None]
    found = [number for part in parts for number in part.dropna()]
    return "–".join(dict.fromkeys(map(count, (min(found), max(found))))) if found else NONE


def seeds(evidence, *names):
    """The number of seeds of each of some experiments, once where it is the same for all."""
    found = [NONE if evidence.rows(name) is None else str(len(evidence.rows(name))) for name in names]
    return found[0] if len(set(found)) == 1 else " / ".join(found)


# --- tables -----------------------------------------------------------------------------------------------------------


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
}
