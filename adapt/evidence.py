"""The evidence behind tables and figures: experiments.csv, curves.csv and published.csv of a folder, read and checked.

experiments.csv has one row for each experiment and seed, curves.csv the errors on the way, published.csv the numbers
of the paper. Whatever a mean could silently be wrong by is refused: an unknown column, two rows of one seed, seeds that
were run with different settings.
"""

import csv
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from adapt.experiment_table import EXPERIMENTS
from envs.errors import InputError


@dataclass(frozen=True)
class Column:
    """What the cells of a column hold: text, or numbers from `low` to `high`.

    Args:
        low: None for text.
        whole: only integers.
        gaps: cells may be empty, numbers also nan.
    """

    low: float | None = None
    high: float = math.inf
    whole: bool = False
    gaps: bool = False

    @property
    def expected(self):
        """What an error message says was expected."""
        if self.low is None:
            return "some text"
        limits = f"from {self.low:g} to {self.high:g}" if math.isfinite(self.high) else f"of at least {self.low:g}"
        return f"{'an integer' if self.whole else 'a number'} {limits}"

    def value(self, text):
        """The value of a cell; None for one that isn't as expected."""
        if self.low is None:
            return text if text or self.gaps else None
        if text in ("", "nan"):
            return math.nan if self.gaps else None
        try:
            number = int(text) if self.whole else float(text)
        except ValueError:
            return None
        return number if self.low <= number <= self.high and math.isfinite(number) else None


NAME, TEXT, COUNT, SIZE = Column(), Column(gaps=True), Column(0, whole=True), Column(0, gaps=True)
SHARE, PERHAPS_SHARE = Column(0, 1), Column(0, 1, gaps=True)
ROW = {"experiment": NAME, "seed": COUNT, "system": NAME, "set": TEXT, "target": TEXT, "method": NAME, "horizon": TEXT}
ROW |= {"mode": TEXT, "samples": SIZE, "metric": NAME, "unit": NAME, "error": SIZE, "std": SIZE, "success": SHARE}
ROW |= {"n": Column(1, whole=True)}
FURTHER = dict.fromkeys(("source", "zero_shot", "oracle", "model_acceleration", "learned_acceleration"), SIZE)
FURTHER |= dict.fromkeys(("median_ms", "p99_ms", "gradient_norm", "gradient_variance", "seconds", "wall_s"), SIZE)
FURTHER |= dict.fromkeys(("threads", "python", "torch", "torchrl", "tensordict", "casadi", "commit", "config"), TEXT)
CURVE = {"experiment": NAME, "seed": COUNT, "update": COUNT, "samples": SIZE, "seconds": SIZE, "error": SIZE}
CURVE |= {"success": PERHAPS_SHARE}
PUBLISHED = {"table": NAME, "system": NAME, "method": NAME, "setting": NAME, "error": SIZE, "std": SIZE}
PUBLISHED |= {"success": PERHAPS_SHARE, "runtime_ms": SIZE, "samples": SIZE, "note": TEXT, "source": NAME}


class Spread(NamedTuple):
    """Numbers of several seeds: mean and standard deviation, least and greatest, over those that have one."""

    mean: float
    std: float
    low: float
    high: float
    seeds: int
    failed: int  # seeds without a number


def spread(values):
    """The `Spread` of a column; its standard deviation is that of the seeds at hand (ddof 0)."""
    return Spread(values.mean(), values.std(ddof=0), values.min(), values.max(), len(values), int(values.isna().sum()))


@dataclass(frozen=True)
class Evidence:
    """The three tables as data frames, to be asked by the names of experiments."""

    experiments: object
    curves: object
    published: object
    asked: set = field(default_factory=set)  # keys of the published rows that were looked for

    @cached_property
    def _rows(self):
        return dict(tuple(self.experiments.groupby("experiment")))

    @cached_property
    def _papers(self):
        return {(row.table, row.system, row.method, row.setting): row for row in self.published.itertuples()}

    def rows(self, name):
        """The rows of an experiment, one for each seed, or None where it hasn't been run."""
        return self._rows.get(name)

    def spread(self, name, column="error"):
        """The `Spread` of a column over the seeds of an experiment, or None where it hasn't been run."""
        rows = self.rows(name)
        return None if rows is None else spread(rows[column])

    def paper(self, table, system, method, setting):
        """A row of published.csv, or None."""
        self.asked.add((table, system, method, setting))
        return self._papers.get((table, system, method, setting))

    def unused(self):
        """What published.csv holds and nobody has asked for: the words that tell a row, of the first."""
        return next((" ".join(key) for key in self._papers if key not in self.asked), None)

    def old(self):
        """Experiments whose rows were made with other settings than those of the present code."""
        from adapt.experiment_run import config_hash

        configs = self.experiments.groupby("experiment", sort=False).config.first()
        return [name for name, config in configs.items() if config and config != config_hash(name)]


def read(folder):
    """The evidence of a folder; without curves.csv there are no curves.

    Raises:
        InputError: names file, line and column of what is missing, unknown, repeated or contradictory.
    """
    folder = Path(folder)
    path = folder / "experiments.csv"
    experiments = read_table(path, ROW, FURTHER, ("experiment", "seed"))
    _check_experiments(path, experiments)
    path = folder / "curves.csv"
    curves = read_table(path, CURVE, {}, ("experiment", "seed", "update"), may_be_missing=True)
    _check_names(path, curves)
    path = folder / "published.csv"
    published = read_table(path, PUBLISHED, {}, ("table", "system", "method", "setting"))
    _refuse(path, published, published.error.isna() & (published.note == ""), "note is empty, expected why no error is")
    _refuse(path, published, published.error.notna() & published["std"].isna(), "std is empty, expected a number")
    return Evidence(experiments, curves, published)


def read_table(path, columns, further, key, may_be_missing=False):
    """A CSV as a data frame, sorted by `key`, with its lines in the file as index.

    Args:
        columns: {name: Column} that must be there.
        further: those that may be there; without it a column is empty.
        key: columns that tell rows apart.

    Raises:
        InputError: see `read`.
    """
    import pandas as pd

    lines = [] if may_be_missing and not path.exists() else list(_lines(path))
    header = lines[0][1] if lines else list(columns)
    known = {**columns, **further}
    _check_header(path, header, columns, known)
    rows, numbers, empty = [], [], {name: column.value("") for name, column in further.items()}
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise InputError(f"{path}: line {number}: has {len(cells)} cells, expected {len(header)} as in the header")
        row = {name: known[name].value(cell) for name, cell in zip(header, cells, strict=True)}
        if wrong := [name for name, value in row.items() if value is None]:
            said = cells[header.index(wrong[0])]
            raise InputError(f"{path}: line {number}: {wrong[0]} is {said!r}, expected {known[wrong[0]].expected}")
        rows.append(empty | row)
        numbers.append(number)
    table = pd.DataFrame(rows, columns=list(known), index=numbers)
    for name, column in known.items():
        table[name] = table[name].astype(str) if column.low is None else pd.to_numeric(table[name])
    _refuse_repeated(path, table, list(key))
    return table.sort_values(list(key), kind="stable")


def _lines(path):
    """(line number, cells) of each line of a CSV that isn't empty."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, cells) for cells in reader if cells]
    except OSError as error:
        advice = "name a folder of results with --results, or run python -m adapt.experiments"
        raise InputError(f"{path}: can't be read ({error.strerror}); {advice}") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is no CSV ({error})") from None
    if not lines:
        raise InputError(f"{path}: is empty, expected a header")
    return lines


def _check_header(path, header, needed, known):
    for name in header:
        if name not in known:
            raise InputError(f"{path}: line 1: unknown column {name!r}; expected {', '.join(known)}")
        if header.count(name) > 1:
            raise InputError(f"{path}: line 1: column {name!r} stands there twice; leave one out")
    if missing := [name for name in needed if name not in header]:
        raise InputError(f"{path}: line 1: has no column {missing[0]!r}; expected {', '.join(known)}")


def _refuse_repeated(path, table, key):
    first = {}
    for line, values in zip(table.index, table[key].itertuples(index=False), strict=True):
        if values in first:
            said = ", ".join(f"{name} {value}" for name, value in zip(key, values, strict=True))
            raise InputError(f"{path}: line {line}: repeats line {first[values]} ({said}); leave one out")
        first[values] = line


def _refuse(path, table, wrong, message):
    if wrong.any():
        raise InputError(f"{path}: line {table.index[wrong].min()}: {message}")


def _check_names(path, table):
    unknown = ~table.experiment.isin(EXPERIMENTS)
    if unknown.any():
        line = table.index[unknown].min()
        advice = "see python -m adapt.experiments list"
        raise InputError(f"{path}: line {line}: {table.experiment[line]!r} is no experiment; {advice}")


def _check_experiments(path, table):
    _check_names(path, table)
    nothing = table.success == 0
    _refuse(path, table, table.error.isna() & ~nothing, "error is empty, but success isn't 0")
    _refuse(path, table, table.error.notna() & nothing, "has an error, but success is 0")
    for name, rows in table.groupby("experiment"):
        for column in ("config", "system", "set", "target", "method", "horizon", "mode", "unit"):
            values = rows[column].unique()
            if len(values) > 1:
                said = " and ".join(map(repr, values[:2]))
                advice = f"run python -m adapt.experiments run {name}"
                raise InputError(f"{path}: seeds of {name} differ in {column} ({said}): no mean of them; {advice}")
