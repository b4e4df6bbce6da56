"""results/experiments.csv, one row for each experiment and seed, and results/curves.csv with the errors on the way."""

from pathlib import Path

from adapt import command
from adapt.experiment_run import CURVE, VERSIONS, config_hash, curve, finished
from adapt.experiment_table import EXPERIMENTS
from envs.errors import InputError
from policies.files import read_text_table, replacing

FIGURES = ("error", "std", "success", "n", "source", "zero_shot", "oracle")
FIGURES += (
    "model_acceleration",
    "learned_acceleration",
    "median_ms",
    "p99_ms",
    "gradient_norm",
    "gradient_variance",
    "seconds",
    "wall_s",
)
COLUMNS = ("experiment", "seed", "system", "set", "target", "method", "horizon", "mode", "samples", "metric", "unit")
COLUMNS += (*FIGURES, "threads", *VERSIONS, "commit", "config")
KEY = ["experiment", "seed"]
POINTS = (*KEY, *CURVE)


def read(folder, name="experiments.csv", columns=COLUMNS):
    """A table of results as text, so that what is written again is what was read; empty where there is no file.

    Raises:
        InputError: not a table of this kind.
    """
    import pandas as pd

    path = Path(folder) / name
    table = read_text_table(path, columns, "adapt.experiments")
    numbers = pd.to_numeric(table.seed, errors="coerce")
    if (wrong := numbers.isna() | (numbers < 0) | (numbers % 1 != 0)).any():
        line = int(wrong.to_numpy().argmax()) + 2
        raise InputError(
            f"{path}: line {line}: seed is {table.seed.iloc[line - 2]!r}, expected an integer of at least 0"
        )
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
        if self.keeps:  # told before hours are spent
            read(folder, "curves.csv", POINTS)
            command.output_folder(folder, overwrite=True)
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
        """A function that says whether a run is done: in the table or, if rows stay with the runs, there."""

        outputs = self.outputs(runs)
        return lambda run: self.state(run) == "done" or (not self.keeps and outputs(run))

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
        from filelock import FileLock

        rows = [finished(runs, *one) for one in those]
        with FileLock(self.folder / ".lock"):  # other sweeps may add to the same tables
            self.table = self._write("experiments.csv", COLUMNS, rows)
            self._write("curves.csv", POINTS, [point for one in those for point in curve(runs, *one)])

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
        rows = [finished(runs, name, seed) for name, seed in _folders(runs)]
        kept = [(row["experiment"], row["seed"], row["config"]) for row in rows if row]
        new = [(name, seed) for name, seed, config in kept if self.hashes.get((name, seed)) != config]
        self.add(runs, *new)
        return len(new)


def _folders(runs):
    """(name, seed) of the folders of runs of experiments."""
    paths = sorted(Path(runs).glob("*/seed-*/row.json"))
    parts = [(path.parent.parent.name, path.parent.name.removeprefix("seed-")) for path in paths]
    return [(name, int(seed)) for name, seed in parts if name in EXPERIMENTS and seed.isdecimal()]


def _text(value):
    return "" if value is None else str(value)
