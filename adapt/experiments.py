"""Every number of the tables again: `python -m adapt.experiments run table1 --seeds 0..4`.

`list` shows what there is, `run` carries out what is missing and adds it to results/experiments.csv, `status` says how
far it is. What was begun goes on where it stopped. `adapt.tables` makes tables and figures of the results.
"""

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command, experiment_table
from envs.errors import InputError

MINUTES = {"adapt.pretrain": 2.0, "adapt.evaluate": 0.5, "adapt.fewshot": 0.5, "adapt.vision": 5.0}
Names = Annotated[tuple[str, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class List:
    """Show experiments: the table they are for, what they need, how long a seed takes, the commands behind them."""

    names: Names = ()
    """Experiments, tables such as table1, or patterns such as 'drag-apg-*' (default: all)."""
    commands: bool = False
    """Also show the commands that make a row by hand: those of seed 0."""
    results: str = "results"
    """Folder with experiments.csv."""


@dataclass(frozen=True)
class Run:
    """Carry out what is missing, and add a row for each experiment and seed to experiments.csv."""

    names: Names = ()
    """Experiments, tables such as table1, patterns such as 'drag-apg-*', or all."""
    seeds: str = "0..4"
    """Seeds, such as 0, 0..4 or 0,2."""
    jobs: int | None = None
    """Runs at a time, each with one thread (default: as many as this process may use cores)."""
    ray: str | None = None
    """Use a Ray cluster: its address, auto, or local to start one. Its machines must share --runs."""
    index: int | None = None
    """This job's number in an array, from 0. Rows stay in --runs; gather adds them to the results."""
    of: int | None = None
    """Jobs in the array."""
    runs: str = "runs/experiments"
    """Folder of the runs."""
    results: str = "results"
    """Folder of experiments.csv and curves.csv."""


@dataclass(frozen=True)
class Status:
    """Say what is done, what was done with other settings, what is missing, and how long that will take."""

    names: Names = ()
    """Experiments, tables or patterns (default: all)."""
    seeds: str = "0..4"
    """Seeds that are asked for."""
    results: str = "results"
    """Folder with experiments.csv."""


@dataclass(frozen=True)
class Gather:
    """Add the rows of finished runs, as those of a job array, to experiments.csv."""

    runs: str = "runs/experiments"
    """Folder of the runs."""
    results: str = "results"
    """Folder of experiments.csv and curves.csv."""


Options = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Status, tyro.conf.subcommand("status")]
    | Annotated[Gather, tyro.conf.subcommand("gather")]
)


def main(options):
    """Do what the subcommand says."""
    {List: _list, Run: _run, Status: _status, Gather: _gather}[type(options)](options)


def pick(names):
    """Experiments by name, table or pattern, in the order of the table.

    Raises:
        InputError: a name that nothing answers to.
    """
    known, found = experiment_table.EXPERIMENTS, set()
    for text in names:
        here = {
            name
            for name, one in known.items()
            if text in ("all", one.table) or fnmatchcase(name, text) or one.table.startswith(f"{text}-")
        }
        if not here:
            tables = ", ".join(experiment_table.TABLES)
            raise InputError(
                f"{text}: no such experiment; expected a name or pattern of `list`, all, or one of {tables}"
            )
        found |= here
    return tuple(name for name in known if name in found)


def _seeds(text):
    try:
        return experiment_table.seeds_of(text)
    except ValueError:
        raise InputError(f"--seeds {text}: expected such as 0, 0..4 or 0,2") from None


def _list(options):
    from adapt import experiment_results

    table = experiment_results.read(options.results)
    rows = []
    for name in pick(options.names or ("all",)):
        one = experiment_table.EXPERIMENTS[name]
        minutes = experiment_results.minutes(table, name)
        rows.append((name, one.table, ", ".join(one.needs), minutes and f"{minutes:.1f}", "yes" if one.cluster else ""))
    print(_tabulated(rows, ("experiment", "for", "needs", "minutes", "for a cluster")))
    if options.commands:
        for name, *_ in rows:
            print(f"\n{name}:")
            for step in experiment_table.EXPERIMENTS[name].steps:
                print(f"  {said(step, name)}")


def weight(experiment):
    """About how many minutes a run takes where none has been timed: a matter of its commands alone."""
    return sum(MINUTES[step.command] for step in experiment.steps)


def said(step, name, root="runs/experiments", seed=0):
    """A step as a command line: that of seed 0, in the folders that `run` uses."""
    from adapt.experiment_run import place, resolved

    words = [f"python -m {step.command}"]
    for key, value in resolved(step, Path(root), seed, name).items():
        words += command.flags(key, value)
    return " ".join([*words, f"--out {place(root, name, seed) / step.out}"])


def _tabulated(rows, header):
    from tabulate import tabulate

    return tabulate(rows, header, "simple")


def _run(options):
    from adapt import experiment_results, sweep

    _check_array(options)
    runs = sweep.chosen(_wanted(options), _seeds(options.seeds))
    results = experiment_results.Results(options.results, None if options.index is not None else options.runs)
    if options.index is not None:
        runs = sweep.part(runs, options.index, options.of, lambda one: weight(experiment_table.EXPERIMENTS[one[0]]))
    tasks = sweep.plan(runs, results.done(options.runs), results.outputs(options.runs))
    if not tasks:
        print(f"nothing to do: all {len(runs)} rows are there")
        return
    engine, jobs = _engine(options)
    failed = _sweep(options, tasks, engine, jobs, results)
    print(f"{len(tasks) - len(failed)} of {len(tasks)} runs done; rows in {results.where(options.runs)}")
    if failed:
        first = next(iter(failed.values()))
        raise InputError(f"{len(failed)} runs failed, the first {first}; the same command tries them again")


def _wanted(options):
    """The names that are asked for; what takes a cluster only if it is named, not by a pattern."""
    if not options.names:
        raise InputError("no experiments: name some, such as table1, 'drag-apg-*' or all; `list` shows them")
    known, names = experiment_table.EXPERIMENTS, pick(options.names)
    wanted = [name for name in names if not known[name].cluster or name in options.names]
    if left := [name for name in names if name not in wanted]:
        print(f"left out, as they take a cluster: {', '.join(left)}; name them to run them")
    return wanted


def _check_array(options):
    if options.of is not None and options.of < 1:
        raise InputError(f"--of {options.of}: expected at least 1")
    if (options.index is None) != (options.of is None):
        raise InputError("--index and --of: give both or neither")
    if options.index is not None and not 0 <= options.index < options.of:
        raise InputError(f"--index {options.index}: expected between 0 and {options.of - 1}, one less than --of")
    if options.jobs is not None and options.jobs < 1:
        raise InputError(f"--jobs {options.jobs}: expected at least 1")


def _engine(options):
    """What carries out the runs, and how many at a time."""
    import os

    from adapt import sweep

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if options.ray is None:
        return sweep.Pool(), options.jobs or cores
    try:
        engine = sweep.Ray(options.ray, options.jobs or cores)
    except ImportError:
        raise InputError("--ray: Ray is not installed; pip install 'apg-adapt[ray]'") from None
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {options.ray}: no cluster answers ({str(error).splitlines()[0]})") from None
    return engine, options.jobs or engine.cpus


def _sweep(options, tasks, engine, jobs, results):
    """Carry out the runs under a bar over the minutes that they take; rows are kept as they come."""
    from tqdm import tqdm

    from adapt import sweep

    root, known = Path(options.runs), experiment_table.EXPERIMENTS
    minutes = {one: results.minutes(one[0]) or weight(known[one[0]]) for one in tasks}
    total = sum(minutes.values())
    form = "{l_bar}{bar}| {postfix} [{elapsed}<{remaining}]"
    with tqdm(total=total, desc="experiments", bar_format=form) as bar:
        count = 0

        def finished_one(one, row):
            nonlocal count
            count += 1
            results.add(root, one)
            bar.set_postfix_str(f"{count} of {len(tasks)} runs, last {one[0]} seed {one[1]}: {_error(row)}")
            bar.update(minutes[one])

        try:
            with command.terminated_as_interrupted():
                return sweep.sweep(tasks, root, engine, jobs, finished_one)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"what is done is kept in {root}; the same command goes on from there") from None


def _error(row):
    return "all failed" if row["error"] is None or math.isnan(row["error"]) else f"{row['error']:.4g} {row['unit']}"


def _status(options):
    from adapt import experiment_results, sweep

    names, seeds = pick(options.names or ("all",)), _seeds(options.seeds)
    if not Path(options.results).is_dir():
        raise InputError(
            f"--results {options.results}: no such folder; expected one with experiments.csv, which run makes"
        )
    results = experiment_results.Results(options.results)
    rows, left, untimed = [], 0.0, 0
    for name in names:
        runs = sweep.chosen([name], seeds)
        done = [one for one in runs if results.state(one) == "done"]
        old = [one for one in runs if results.state(one) == "old"]
        minutes = results.minutes(name)
        cluster = experiment_table.EXPERIMENTS[name].cluster
        missing = len(runs) - len(done)
        left += 0.0 if cluster else missing * (minutes or 0.0)
        untimed += 0 if cluster or minutes else missing
        note = "for a cluster" if cluster else ""
        rows.append((name, f"{len(done)} of {len(runs)}", len(old) or "", minutes and f"{minutes:.1f}", note))
    print(_tabulated(rows, ("experiment", "done", "with other settings", "minutes a seed", "")))
    said = [f"about {left:.0f} minutes of one core"] if left or not untimed else []
    if untimed:
        said.append(f"{untimed} runs that have never been timed")
    print(f"left: {' and '.join(said)}")


def _gather(options):
    from adapt import experiment_results

    results = experiment_results.Results(options.results, options.runs)
    print(f"{results.gather(Path(options.runs))} rows added; results in {results.where(options.runs)}")


if __name__ == "__main__":
    command.run("adapt.experiments", Options, main)
