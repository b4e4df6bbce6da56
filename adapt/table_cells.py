"""The cells of tables: what rows say, in as few digits as mean something.

A cell of ours is the mean over seeds of `error` ± its standard deviation, and the share of episodes that succeed where
that is below 100 %. "–" stands for what hasn't been run or wasn't published.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from adapt.experiment_table import EXPERIMENTS

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
