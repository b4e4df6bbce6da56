"""Carry out many runs of experiments, those that others need first, on this machine or on a Ray cluster.

Every run has a process of its own, so that one that dies takes nothing else with it: its row is missing, and so are
those of the runs that need it.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import partial
from graphlib import TopologicalSorter

from adapt.command import INTERRUPTED
from adapt.experiment_run import finished, run
from adapt.experiment_table import EXPERIMENTS, needed

GRACE = 120  # [s] that an interrupted run gets to save what it has


def chosen(names, seeds):
    """The runs (name, seed) of these experiments and seeds; a planner without anything random has seed 0 alone."""
    return [
        (name, seed)
        for name in names
        for seed in seeds
        if EXPERIMENTS[name].seeds is None or seed < EXPERIMENTS[name].seeds
    ]


def plan(runs, done, has_outputs):
    """What is to be done for these runs: those that aren't done, and whatever they need of which the outputs are gone.

    Args:
        runs: (name, seed).
        done: (name, seed) → whether its row exists.
        has_outputs: (name, seed) → whether what others need of it exists.

    Returns:
        {run: runs of the same answer that come before it}.
    """
    todo = [one for one in runs if not done(one)]
    for name, seed in list(todo):
        todo += [(other, seed) for other in needed(name) if not has_outputs((other, seed))]
    todo = list(dict.fromkeys(todo))
    return {(n, seed): [(o, seed) for o in EXPERIMENTS[n].needs if (o, seed) in todo] for n, seed in todo}


def part(runs, index, of, minutes):
    """The part of the runs that the job `index` of an array of `of` jobs does.

    Runs that need one another stay together. The longest chains are dealt out first, each to the job with the least to
    do, so every job finds the same parts.

    Args:
        minutes: (name, seed) → about how long it takes; the same for every job, whatever is done in the meantime.
    """
    load, parts = [0.0] * of, [[] for _ in range(of)]
    chains = [[one for one in runs if one in chain] for chain in _chains(runs)]
    for chain in sorted(chains, key=lambda chain: (-sum(map(minutes, chain)), chain)):
        least = load.index(min(load))
        load[least] += sum(map(minutes, chain))
        parts[least] += chain
    return parts[index]


def _chains(runs):
    """Sets of runs that need one another or something in common."""
    chains = []
    for name, seed in runs:
        chain = {(name, seed), *((other, seed) for other in needed(name))}
        linked = [other for other in chains if other & chain]
        chains = [*(other for other in chains if not other & chain), chain.union(*linked)]
    return chains


def sweep(tasks, root, engine, jobs, finished_one):
    """Carry out runs, as many at a time as there are jobs; returns {run: what went wrong} of those without a row.

    Args:
        tasks: what `plan` returns.
        engine: (name, seed, root) → row, which blocks.
        finished_one: called with run and row.

    Raises:
        KeyboardInterrupt: after the runs that were going on have saved what they had.
        InputError: a row can't be kept; the runs that were going on have saved what they had, too.
    """
    pool = ThreadPoolExecutor(jobs)
    try:
        return _carry_out(tasks, root, partial(pool.submit, engine), finished_one)
    except BaseException:  # Ctrl-C, or a row that can't be kept
        pool.shutdown(wait=False, cancel_futures=True)
        engine.stop()
        raise
    finally:
        pool.shutdown()


def _carry_out(tasks, root, submit, finished_one):
    """Submit each run when those that it needs have ended, until all have."""
    order, failed, going = TopologicalSorter(tasks), {}, {}
    order.prepare()
    while order.is_active():
        for one in order.get_ready():
            if missing := [other for other in tasks[one] if other in failed]:
                failed[one] = f"{one[0]} seed {one[1]}: left out, as {missing[0][0]} failed"
                order.done(one)
            else:
                going[submit(*one, root)] = one
        ended, _ = wait(going, return_when=FIRST_COMPLETED)
        for future in ended:
            one = going.pop(future)
            if error := future.exception():
                failed[one] = str(error)
            else:
                finished_one(one, future.result())
            order.done(one)
    return failed


class Pool:
    """Engine: a process of this machine for each run."""

    def __init__(self):
        self.context, self.going = multiprocessing.get_context("spawn"), set()

    def __call__(self, name, seed, root):
        """Carry out a run and wait for its row."""
        process = self.context.Process(target=_child, args=(name, seed, str(root)))
        process.start()
        self.going.add(process)
        process.join()
        self.going.discard(process)
        if process.exitcode:
            raise RuntimeError(_what_happened(name, seed, root, process.exitcode))
        return finished(root, name, seed)

    def stop(self):
        """Have the runs save what they have and end."""
        for process in tuple(self.going):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGINT)
        for process in tuple(self.going):
            process.join(GRACE)
            process.kill()


def _child(name, seed, root):
    """The process of a run. It is told to stop by the sweep alone, once, or by the end of the sweep.

    Ctrl-C reaches every process of a terminal; a second one would end the run before it has saved what it has. A sweep
    that is killed takes its runs with it, and they save what they have, too.
    """
    if hasattr(os, "setsid"):
        os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):  # ignored in a process of the background, or deadly
        signal.signal(number, signal.default_int_handler)
    threading.Thread(target=_follow, daemon=True).start()
    try:
        run(name, seed, root)
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
    except RuntimeError:  # its log says what went wrong
        raise SystemExit(1) from None


def _follow():
    """Interrupt this process when the sweep that began it has ended."""
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGINT)


def _what_happened(name, seed, root, exitcode):
    from adapt.experiment_run import place

    log = place(root, name, seed) / "log.txt"
    lines = [line for line in log.read_text().splitlines() if line.strip()] if log.is_file() else []
    said = f"killed by signal {-exitcode}" if exitcode < 0 else (lines or ["no log"])[-1].strip()
    return f"{name} seed {seed}: {said} (log: {log})"


class Ray:
    """Engine: tasks of a Ray cluster, whose machines share the folder of the runs.

    Args:
        address: of a running cluster, "auto" to find it, or "local" to start one on this machine.
        cpus: of a local one.

    Raises:
        ImportError: Ray isn't installed.
        ConnectionError: no cluster answers.
    """

    def __init__(self, address, cpus):
        import ray

        quiet = {"log_to_driver": False, "include_dashboard": False} if address == "local" else {}
        place = {"num_cpus": cpus, "address": "local"} if address == "local" else {"address": address}
        ray.init(**place, **quiet, runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}}, logging_level="ERROR")
        self.ray, self.task, self.going = ray, ray.remote(num_cpus=1, max_calls=1)(run), set()

    @property
    def cpus(self):
        """How many runs the cluster has room for."""
        return max(1, int(self.ray.cluster_resources().get("CPU", 1)))

    def __call__(self, name, seed, root):
        """Carry out a run and wait for its row."""
        task = self.task.remote(name, seed, str(root))
        self.going.add(task)
        try:
            return self.ray.get(task)
        except self.ray.exceptions.RayTaskError as error:
            raise RuntimeError(str(error.cause)) from None
        finally:
            self.going.discard(task)

    def stop(self):
        """Have the runs save what they have and end, then leave the cluster."""
        tasks = list(self.going)
        for task in tasks:
            self.ray.cancel(task, force=False)
        if tasks:
            self.ray.wait(tasks, num_returns=len(tasks), timeout=GRACE)
        self.ray.shutdown()
