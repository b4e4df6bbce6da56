"""results/experiments.csv, one row for each experiment and seed, and results/curves.csv with the errors on the way."""

from pathlib import Path

from adapt.experiment_run import CURVE, VERSIONS, config_hash, curve, finished, place
from adapt.experiment_table import EXPERIMENTS
from envs.errors import InputError
from policies.files import replacing

FIGURES = ("error", "std", "success", "n", "zero_shot", "oracle", "model_acceleration", "learned_acceleration")
FIGURES += ("median_ms", "p99_ms", "gradient_norm", "gradient_variance", "seconds", "wall_s")
COLUMNS = ("experiment", "seed", "system", "set", "target", "method", "horizon", "mode", "samples", "metric", "unit")
COLUMNS += (*FIGURES, "threads", *VERSIONS, "commit", "config")
KEY = ["experiment", "seed"]


def read(folder, name="experiments.csv", columns=COLUMNS):
    """A table of results as text, so that what is written again is what was read; empty where there is no file.

    Raises:
        InputError: not a table of this kind.
    """
    import pandas as pd

    path = Path(folder) / name
    if not path.is_file():
        return pd.DataFrame(columns=list(columns), dtype=str)
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: can't be read ({str(error).splitlines()[0]})") from None
    if missing := [column for column in columns if column not in table]:
        raise InputError(f"{path}: has no column {missing[0]}; expected what adapt.experiments writes")
    if unknown := sorted(set(table.experiment) - set(EXPERIMENTS)):
        raise InputError(f"{path}: names {unknown[0]}, which is no experiment; remove its rows")
    return table


def minutes(table, name):
    """How long a run of an experiment takes by the rows there are, or None."""
    import pandas as pd

    seconds = pd.to_numeric(table.wall_s[table.experiment == name], errors="coerce").dropna()
    return float(seconds.median()) / 60 if len(seconds) else None


class Results:
    """The tables of a folder, to be asked and added to.

    Args:
        folder: of experiments.csv and curves.csv.
        runs: folder of the runs; None: rows stay where they are, nothing is added to the tables.
    """

    def __init__(self, folder, runs=None):
        self.folder, self.keeps = Path(folder), runs is not None
        self.table = read(folder)
        self.hashes = {(row.experiment, int(row.seed)): row.config for row in self.table.itertuples()}

    def minutes(self, name):
        """See `minutes`."""
        return minutes(self.table, name)

    def state(self, run):
        """What the table holds of a run: "done", "old" (with other settings) or "missing"."""
        if run not in self.hashes:
            return "missing"
        return "done" if self.hashes[run] == config_hash(run[0]) else "old"

    def done(self, runs):
        """A function that says whether a run is done: in the table, or in the folder of the runs if rows stay there."""

        def is_done(run):
            if self.keeps:
                return self.state(run) == "done"
            row = finished(runs, *run)
            return row is not None and row["config"] == config_hash(run[0])

        return is_done

    def outputs(self, runs):
        """A function that says whether what others need of a run is there, made with the present settings."""

        def has_outputs(run):
            row = finished(runs, *run)
            return row is not None and row["config"] == config_hash(run[0])

        return has_outputs

    def where(self, runs):
        """Where the rows are."""
        return self.folder / "experiments.csv" if self.keeps else runs

    def add(self, runs, *those):
        """Add the rows and curves of finished runs to the tables; a row that is there is replaced."""
        if not self.keeps:
            return
        rows = [finished(runs, *one) for one in those]
        self.folder.mkdir(parents=True, exist_ok=True)
        self.table = self._write("experiments.csv", COLUMNS, rows)
        self._write("curves.csv", (*KEY, *CURVE), [point for one in those for point in curve(runs, *one)])

    def _write(self, name, columns, rows):
        import pandas as pd

        table = read(self.folder, name, columns)
        new = pd.DataFrame([{column: _text(row.get(column, "")) for column in columns} for row in rows], dtype=str)
        if new.empty:
            return table
        keys = set(map(tuple, new[KEY].to_numpy()))
        kept = table[[(one, seed) not in keys for one, seed in zip(table.experiment, table.seed, strict=True)]]
        table = pd.concat([kept, new], ignore_index=True)
        order = {name: number for number, name in enumerate(EXPERIMENTS)}
        place = [(order[row.experiment], int(row.seed)) for row in table.itertuples()]
        table = table.iloc[sorted(range(len(table)), key=place.__getitem__)].reset_index(drop=True)  # stable
        with replacing(self.folder / name) as partial:
            table.to_csv(partial, index=False)
        return table

    def gather(self, runs):
        """Add all finished runs of a folder that the table doesn't hold; returns how many."""
        found = [(path.parent.parent.name, int(path.parent.name.removeprefix("seed-"))) for path in _rows(runs)]
        new = [one for one in found if one[0] in EXPERIMENTS and self.hashes.get(one) != finished(runs, *one)["config"]]
        self.add(runs, *new)
        return len(new)


def _rows(runs):
    return sorted(Path(runs).glob("*/seed-*/row.json"))


def _text(value):
    return "" if value is None else str(value)


__all__ = ["COLUMNS", "FIGURES", "Results", "minutes", "place", "read"]
