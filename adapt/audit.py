"""Can adaptation make things worse? `python -m adapt.audit --targets 200` asks it of random targets and bad data.

For each system it draws targets, flies, spoils some of the records, adapts, and flies the old policy, the new one and
the one that the gate let pass in the truth. audit.csv has a row for each case; what is there isn't done again.
"""

import multiprocessing
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError
from policies.files import read_text_table, replacing

Repeatable = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
TABLE, PICTURE = "audit.csv", "audit.png"
SCORES = ("source", "zero_shot", "gated", "ungated", "oracle")
COLUMNS = (
    *(
        "system",
        "index",
        "seed",
        "target",
        "corruption",
        "transitions",
        "noise",
        "kind",
        "parameters",
        "unit",
        "episodes",
    ),
    *(f"{name}_{what}" for name in SCORES for what in ("error", "success")),
    *("ratio", "ratio_ungated", "accepted", "confidence", "reason", "gain", "share", "distance"),
    *("refused_data", "crash", "seconds_fit", "seconds_finetune", "seconds_gate", "seconds", "cpu_seconds"),
    *("threads", "python", "torch", "torchrl", "tensordict", "casadi", "commit"),
)
KEY = ("system", "index", "seed")


@dataclass(frozen=True)
class Options:
    """Adapt to random targets, from good and bad data, and report how often a policy got worse, gated and not.

    Adds a row for each case to audit.csv, prints a table and draws audit.png. Cases that are there are left out, unless
    they crashed.
    """

    targets: int = 200
    """Random targets for each system."""
    system: Repeatable = ()
    """Robot: cartpole, quadrotor or fixed_wing; may be repeated (default: all)."""
    seed: int = 0
    """Seed of everything that is drawn; cases of other seeds in the same folder stay and are not reported on."""
    episodes: int = 20
    """Test episodes that each policy is flown on."""
    oracle: bool = False
    """Also fine-tune in the true target, which bounds what can be gained; otherwise the error in the model does."""
    jobs: int | None = None
    """Cases at a time, each with one thread (default: as many as this process may use cores)."""
    out: str = "runs/audit"
    """Folder of audit.csv and audit.png."""
    summary: bool = False
    """Only print the table and draw the picture of what is there."""


def main(options):
    """Carry out the cases of a seed that are missing, then report on all of that seed."""
    _check(options)
    from adapt import audit_report

    folder = Path(options.out)
    if not options.summary:
        _audit(options, command.output_folder(folder, overwrite=True))
    table = read(folder)
    rows = audit_report.numbers(table[table.seed == str(options.seed)])
    if rows.empty:
        known = f", only of {', '.join(sorted(set(table.seed)))}" if len(table) else ""
        none = f"there are no cases of --seed {options.seed}{known}"
        raise InputError(f"{folder / TABLE}: {none}; leave out --summary to make some")
    print(audit_report.table(rows))
    audit_report.save(rows, folder / PICTURE)
    print(f"cases in {folder / TABLE}, picture in {folder / PICTURE}")


def _check(options):
    from envs.registry import make_system

    for name in ("targets", "episodes", "jobs"):
        if (number := getattr(options, name)) is not None and number < 1:
            raise InputError(f"--{name} {number}: expected at least 1")
    command.check_seed(options.seed)
    for name in options.system:
        make_system(name)


def _audit(options, folder):
    """Carry out what is missing, under a bar; each row is in the file as soon as its case has ended."""
    from tqdm import tqdm

    from adapt import sweep
    from adapt.audit_case import WORSE
    from envs.registry import SYSTEMS

    names = dict.fromkeys(options.system or SYSTEMS)
    done = _done(read(folder), options)
    tasks = {(name, i): [] for i in range(options.targets) for name in names if (name, i) not in done}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    engine, worse = Processes(options.seed, options.episodes, options.oracle), 0
    with tqdm(total=len(tasks), desc="audit", unit="case", smoothing=0) as bar:

        def finished(one, row):
            nonlocal worse
            add(folder, row)
            worse += row.get("ratio", 1.0) > WORSE
            bar.set_postfix_str(f"{worse} worse, last {one[0]} {one[1]}")
            bar.update()

        try:
            with command.terminated_as_interrupted():
                failed = sweep.sweep(tasks, folder, engine, options.jobs or cores, finished)
        except KeyboardInterrupt:
            done = f"what is done is in {folder / TABLE}" if (folder / TABLE).exists() else "no case is done yet"
            raise KeyboardInterrupt(f"{done}; the same command goes on from there") from None
    if failed:
        raise RuntimeError(next(iter(failed.values())))


def _done(table, options):
    """(system, index) of the cases of this seed that needn't be done.

    Raises:
        InputError: they were flown on another number of test episodes.
    """
    rows = table[(table.seed == str(options.seed)) & (table.crash == "")]
    for row in rows.itertuples():
        if row.episodes != str(options.episodes):
            raise InputError(f"--out {options.out}: has cases of --episodes {row.episodes}; name another folder")
    without = rows.oracle_success == ""
    rows = rows[~without | (rows.refused_data != "")] if options.oracle else rows
    return set(zip(rows.system, rows["index"].astype(int), strict=True))


def read(folder):
    """The table of a folder as text, so that what is written again is what was read; empty where there is no file.

    Raises:
        InputError: not a table of this command.
    """
    path = Path(folder) / TABLE
    table = read_text_table(path, COLUMNS, "adapt.audit")
    if not table["index"].str.isdecimal().all():
        raise InputError(f"{path}: an index is no number; expected what adapt.audit writes")
    return table[list(COLUMNS)]


def add(folder, row):
    """Put a row into the table of a folder, in place of one of the same case."""
    import pandas as pd
    from filelock import FileLock

    text = {column: "" if (value := row.get(column)) is None else str(value) for column in COLUMNS}
    with FileLock(Path(folder) / ".lock"):  # other audits may add to the same table
        table = read(folder)
        same = (table[list(KEY)] == [text[key] for key in KEY]).all(axis=1)
        table = pd.concat([table[~same], pd.DataFrame([text])], ignore_index=True)
        order = sorted(range(len(table)), key=lambda i: (table.seed[i], table.system[i], int(table["index"][i])))
        with replacing(Path(folder) / TABLE) as partial:
            table.iloc[order].to_csv(partial, index=False)


class Processes:
    """Engine of `adapt.sweep.sweep`: a process of this machine for each case, which may die without harm to others.

    Where the system can, they are copies of one process that has imported all already.
    """

    def __init__(self, seed, episodes, oracle):
        kind = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        self.context, self.going, self.settings = multiprocessing.get_context(kind), set(), (seed, episodes, oracle)
        if kind == "forkserver":
            self.context.set_forkserver_preload(["adapt.audit_case"])

    def __call__(self, system, index, root):
        """Carry out a case and wait for its row; one whose process died is a crash."""
        from adapt.audit_targets import draw

        here, there = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_child, args=(there, (system, index, *self.settings)), daemon=True)
        process.start()
        there.close()
        self.going.add(process)
        try:
            return here.recv()
        except EOFError:
            process.join()
            died = {"crash": f"the process of the case ended with status {process.exitcode}"}
            return draw(system, index, self.settings[0]).row | {"episodes": self.settings[1]} | died
        finally:
            process.join()
            self.going.discard(process)

    def stop(self):
        """End the cases that are going on; nothing is kept of them."""
        for process in tuple(self.going):
            process.terminate()


def _child(pipe, arguments):
    """Send the row of a case into a pipe; what is compiled for it is good for no other case and isn't kept."""
    import tempfile

    import torch

    from adapt.audit_case import case

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; `stop` ends this one
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        pipe.send(case(*arguments))


if __name__ == "__main__":
    command.run("adapt.audit", Options, main)
