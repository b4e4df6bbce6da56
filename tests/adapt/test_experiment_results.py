"""results/experiments.csv: a row for each run, replaced when it is run again, in the order of the table."""

import json

import pytest

from adapt import experiment_results as results
from adapt.experiment_run import config_hash, place
from adapt.experiment_table import EXPERIMENTS
from envs.errors import InputError


def finish(runs, name, seed, **figures):
    """A run that has ended with these figures."""
    folder = place(runs, name, seed)
    folder.mkdir(parents=True, exist_ok=True)
    row = {"experiment": name, "seed": seed, "error": 0.5, "wall_s": 60.0, "config": config_hash(name), **figures}
    (folder / "row.json").write_text(json.dumps(row))
    return name, seed


@pytest.fixture
def tables(tmp_path):
    return results.Results(tmp_path / "results", tmp_path / "runs")


def test_rows_are_kept_in_the_order_of_the_table_whatever_comes_first(tables, tmp_path):
    names = ["drag-apg-quadrotor-30", "mpc-cartpole", "apg-quadrotor"]
    for name, seed in [(names[0], 1), (names[0], 0), (names[1], 0), (names[2], 10), (names[2], 2)]:
        tables.add(tmp_path / "runs", finish(tmp_path / "runs", name, seed))
    table = results.read(tmp_path / "results")
    assert list(zip(table.experiment, table.seed, strict=True)) == [
        ("mpc-cartpole", "0"),
        ("apg-quadrotor", "2"),
        ("apg-quadrotor", "10"),
        ("drag-apg-quadrotor-30", "0"),
        ("drag-apg-quadrotor-30", "1"),
    ]


def test_a_row_that_is_run_again_is_replaced_and_no_digit_of_the_others_changes(tables, tmp_path):
    digits = 0.1 + 0.2
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 0, error=digits))
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 1, error=1.0))
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 1, error=2.0))
    assert list(results.read(tmp_path / "results").error) == ["0.30000000000000004", "2.0"]


def test_nothing_that_succeeded_is_an_empty_cell(tables, tmp_path):
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 0, error=None))
    assert list(results.read(tmp_path / "results").error) == [""]


def test_a_row_made_with_other_settings_is_old(tables, tmp_path):
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 0))
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 1, config="other"))
    fresh = results.Results(tmp_path / "results")
    assert [fresh.state(("apg-quadrotor", seed)) for seed in range(3)] == ["done", "old", "missing"]


def test_rows_of_an_array_stay_with_the_runs_until_they_are_gathered(tmp_path):
    array = results.Results(tmp_path / "results")
    one = finish(tmp_path / "runs", "apg-quadrotor", 0)
    array.add(tmp_path / "runs", one)
    assert not (tmp_path / "results").exists()
    assert array.done(tmp_path / "runs")(one) and not array.done(tmp_path / "runs")(("apg-quadrotor", 1))
    gathered = results.Results(tmp_path / "results", tmp_path / "runs")
    assert (gathered.gather(tmp_path / "runs"), gathered.gather(tmp_path / "runs")) == (1, 1)
    assert results.Results(tmp_path / "results", tmp_path / "runs").gather(tmp_path / "runs") == 0
    assert len(results.read(tmp_path / "results")) == 1


def test_the_curve_goes_into_a_table_of_its_own(tables, tmp_path):
    one = finish(tmp_path / "runs", "apg-quadrotor", 0)
    folder = place(tmp_path / "runs", *one) / "training"
    folder.mkdir()
    (folder / "log.csv").write_text(
        "update,samples,cost,seconds,error,success\n1,8,3.0,0.5,0.25,1.0\n2,16,2.0,1.0,,0.0\n"
    )
    tables.add(tmp_path / "runs", one)
    tables.add(tmp_path / "runs", one)
    lines = (tmp_path / "results" / "curves.csv").read_text().splitlines()
    assert lines == ["experiment,seed,update,samples,seconds,error,success", "apg-quadrotor,0,1,8,0.5,0.25,1.0"]


def test_the_time_of_a_run_is_the_median_of_its_rows(tables, tmp_path):
    for seed, seconds in enumerate((30, 60, 600)):
        tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", seed, wall_s=seconds))
    assert tables.minutes("apg-quadrotor") == 1.0
    assert tables.minutes("ppo-quadrotor") is None


def test_a_row_of_no_experiment_is_refused(tables, tmp_path):
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 0))
    path = tmp_path / "results" / "experiments.csv"
    path.write_text(path.read_text().replace("apg-quadrotor", "gone"))
    with pytest.raises(InputError, match=r"experiments\.csv: names gone, which is no experiment"):
        results.read(tmp_path / "results")


def test_another_table_is_refused(tmp_path):
    (tmp_path / "experiments.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="has no column experiment"):
        results.read(tmp_path)


def add_rows(folder, name, count):
    table = results.Results(folder / "results", folder / "runs")
    for seed in range(count):
        table.add(folder / "runs", finish(folder / "runs", name, seed))


def test_two_sweeps_that_add_to_the_same_tables_lose_no_row(tmp_path):
    import multiprocessing

    names = ("apg-quadrotor", "ppo-quadrotor")
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=add_rows, args=(tmp_path, name, 15)) for name in names]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert len(results.read(tmp_path / "results")) == 30


def test_a_policy_of_other_settings_is_not_taken_for_one_that_is_needed(tables, tmp_path):
    one = finish(tmp_path / "runs", "apg-quadrotor", 0)
    other = finish(tmp_path / "runs", "apg-quadrotor", 1, config="other")
    has = tables.outputs(tmp_path / "runs")
    assert has(one) and not has(other) and not has(("apg-quadrotor", 2))


def test_an_array_does_not_repeat_rows_that_the_results_hold(tables, tmp_path):
    one = finish(tmp_path / "runs", "apg-quadrotor", 0)
    tables.add(tmp_path / "runs", one)
    assert results.Results(tmp_path / "results").done(tmp_path / "elsewhere")(one)


@pytest.mark.parametrize("seed", ["x", "-1", "1.5", ""])
def test_a_seed_that_is_none_is_refused(tables, tmp_path, seed):
    tables.add(tmp_path / "runs", finish(tmp_path / "runs", "apg-quadrotor", 0))
    path = tmp_path / "results" / "experiments.csv"
    path.write_text(path.read_text().replace("apg-quadrotor,0,", f"apg-quadrotor,{seed},"))
    with pytest.raises(InputError, match=f"line 2: seed is '{seed}', expected an integer"):
        results.read(tmp_path / "results")


def test_what_cannot_be_kept_is_told_before_the_first_run(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file, expected a folder"):
        results.Results(tmp_path / "file", tmp_path / "runs")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "curves.csv").write_text("a,b\n")
    with pytest.raises(InputError, match=r"curves\.csv: has no column experiment"):
        results.Results(tmp_path / "results", tmp_path / "runs")


def test_other_folders_among_the_runs_are_not_gathered(tmp_path):
    for folder in ("other/seed-0", "apg-quadrotor/seed-x", "apg-quadrotor/seed-1"):
        (tmp_path / "runs" / folder).mkdir(parents=True)
        (tmp_path / "runs" / folder / "row.json").write_text("{")
    assert results.Results(tmp_path / "results", tmp_path / "runs").gather(tmp_path / "runs") == 0


def test_the_committed_results_name_experiments_that_exist():
    """`read` refuses others; an empty folder is a project without results."""
    from pathlib import Path

    table = results.read(Path(__file__).parents[2] / "results")
    assert set(table.experiment) <= set(EXPERIMENTS)
