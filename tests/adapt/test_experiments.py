"""The command: what it shows, what it refuses, and that a sweep that is killed goes on where it stopped."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adapt.experiments import pick
from envs.errors import InputError

ROOT = Path(__file__).parents[2]


def test_experiments_are_picked_by_name_table_and_pattern_in_the_order_of_the_table():
    assert pick(("drag-mpc-quadrotor-30", "mpc-cartpole")) == ("mpc-cartpole", "drag-mpc-quadrotor-30")
    assert len(pick(("table2",))) == 21
    assert pick(("curriculum-*",)) == tuple(f"curriculum-{part}" for part in ("both", "none", "threshold", "speed"))
    assert set(pick(("table4",))) == set(pick(("table4-quadrotor", "table4-fixed_wing")))
    assert "mpc-cartpole" in pick(("all",))


def test_a_name_that_nothing_answers_to_is_refused():
    with pytest.raises(InputError, match=r"table9: no such experiment; expected a name or pattern"):
        pick(("table9",))


def test_list_shows_what_is_needed_and_the_commands(call):
    answer = call("experiments", "list", "drag-mpc-quadrotor-30", "--commands")
    assert answer.status == 0
    assert "drag-apg-quadrotor-30" in answer.out
    folder = "runs/experiments/drag-apg-quadrotor-30/seed-0/adaptation"
    command = "python -m adapt.evaluate --system quadrotor --method mpc-residual --target drag=0.3 --residual "
    assert f"{command}{folder}/residual.safetensors --out runs/experiments/drag-mpc" in answer.out


def test_status_counts_what_is_missing(call, tmp_path):
    answer = call("experiments", "status", "curriculum", "--seeds", "0..2", "--results", tmp_path)
    assert answer.status == 0
    assert answer.out.count("0 of 3") == 4
    assert answer.out.endswith("left: 12 runs that have never been timed\n")


def test_status_of_a_folder_that_is_not_there_is_refused(refused, tmp_path):
    line = refused("experiments", "status", "curriculum", "--results", tmp_path / "nothing")
    assert f"--results {tmp_path / 'nothing'}: no such folder" in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run",), "no experiments: name some"),
        (("run", "table9"), "table9: no such experiment"),
        (("run", "table1", "--seeds", "x"), "--seeds x: expected such as 0, 0..4 or 0,2"),
        (("run", "table1", "--index", "0"), "--index and --of: give both or neither"),
        (("run", "table1", "--index", "2", "--of", "2"), "--index 2: expected between 0 and 1"),
        (("run", "table1", "--index", "0", "--of", "0"), "--of 0: expected at least 1"),
        (("run", "table1", "--jobs", "0"), "--jobs 0: expected at least 1"),
        (("run", "table1", "--seeds", "5..2"), "--seeds 5..2: expected such as"),
        (("walk",), "experiments: Unrecognized options: walk (see"),
    ],
)
def test_wrong_options_end_in_one_line(refused, arguments, said, tmp_path):
    end = ("--results", tmp_path / "results", "--runs", tmp_path / "runs") if arguments[0] == "run" else ()
    assert said in refused("experiments", *arguments, *end)
    assert not (tmp_path / "runs").exists()


def test_what_takes_a_cluster_is_run_only_if_it_is_named(capsys):
    from adapt.experiments import Run, _wanted

    assert "drag-pets-quadrotor-150000" not in _wanted(Run(("drag-pets-*",)))
    assert "left out, as they take a cluster: drag-pets-quadrotor-150000" in capsys.readouterr().out
    assert _wanted(Run(("drag-pets-quadrotor-150000",))) == ["drag-pets-quadrotor-150000"]


def sweep(folder, *more, **settings):
    start = [sys.executable, "-m", "adapt.experiments", "run", "check", "--seeds", "0..1", "--jobs", "2"]
    places = ["--runs", str(folder / "runs"), "--results", str(folder / "results")]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "RL_LOGGING_LEVEL": "ERROR"}
    return subprocess.Popen([*start, *places, *more], env=env, stderr=subprocess.PIPE, text=True, **settings)


def figures(folder):
    """The rows without what depends on time and load."""
    import pandas as pd

    table = pd.read_csv(folder / "results" / "experiments.csv", dtype=str)
    return table.drop(columns=["median_ms", "p99_ms", "seconds", "wall_s"])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The rows of a sweep that nothing happened to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    _, err = (process := sweep(folder)).communicate()
    assert process.returncode == 0, err
    return figures(folder)


def alive(folder):
    """Whether a process still works on a run of the folder."""
    from filelock import FileLock, Timeout

    try:
        for path in folder.glob("runs/*/*/lock"):
            FileLock(path, timeout=0).acquire().lock.release()
    except Timeout:
        return True
    return False


def wait_for(condition, seconds=240):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("all_processes", [True, False])  # as a terminal does it or a scheduler, and as `kill` does
def test_a_sweep_that_is_ended_goes_on_without_losing_or_repeating_a_row(how, all_processes, tmp_path, undisturbed):
    log = tmp_path / "runs" / "check-train" / "seed-0" / "training" / "log.csv"
    process = sweep(tmp_path, start_new_session=True)
    wait_for(log.is_file)
    os.killpg(process.pid, how) if all_processes else process.send_signal(how)
    _, err = process.communicate(timeout=200)
    assert process.returncode == (-how if how == signal.SIGKILL else 130), err
    if how != signal.SIGKILL:
        assert "goes on from there" in err.splitlines()[-1] and "Traceback" not in err
    wait_for(lambda: not alive(tmp_path))  # what a killed sweep began saves what it has, and ends
    rows = {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/*/*/row.json")}
    begun = log.read_text().splitlines()[1]
    _, err = (again := sweep(tmp_path)).communicate()
    assert again.returncode == 0, err
    assert figures(tmp_path).equals(undisturbed)
    assert log.read_text().splitlines()[1] == begun  # with its seconds: not trained from the start again
    assert all(path.stat().st_mtime_ns == then for path, then in rows.items())
    before = (tmp_path / "results" / "experiments.csv").read_bytes()
    _, err = (once_more := sweep(tmp_path)).communicate()
    assert once_more.returncode == 0
    assert (tmp_path / "results" / "experiments.csv").read_bytes() == before


@pytest.mark.slow
def test_two_jobs_of_an_array_and_gather_make_the_same_rows(tmp_path, undisturbed):
    jobs = [sweep(tmp_path, "--index", str(index), "--of", "2") for index in range(2)]
    for job in jobs:
        _, err = job.communicate()
        assert job.returncode == 0, err
    assert not (tmp_path / "results").exists()
    places = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
    subprocess.run([sys.executable, "-m", "adapt.experiments", "gather", *places], cwd=ROOT, check=True)
    assert figures(tmp_path).equals(undisturbed)


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_rows(tmp_path, undisturbed):
    pytest.importorskip("ray", reason="the extra `ray` isn't installed")
    _, err = (process := sweep(tmp_path, "--ray", "local")).communicate()
    assert process.returncode == 0, err
    assert figures(tmp_path).equals(undisturbed)
