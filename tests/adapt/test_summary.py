"""`python -m adapt.summary`: one row per run, one line per group, and one line for whatever can't be told apart."""

import json
import math

import pandas as pd
import pytest

SUMMARY = {"mean": 0.1, "std": 0.02, "success": 1.0, "n": 50}
ENVIRONMENT = {"torch": "2", "commit": "abc"}


def fewshot_run(folder, error=0.1, kind="acceleration", **changes):
    """A folder with the results that `adapt.fewshot` leaves, as far as the tables read them; None leaves a key out."""
    metrics = {"system": "quadrotor", "target": "drag=0.3", "samples": 1000, "seed": 0, "metric": "error", "unit": "m"}
    metrics |= {"set": "paper", "updates": 200, "residual": {"kind": kind}, "threads": 1}
    metrics |= {"seconds": {"fit": 1.0, "finetune": 2.0, "oracle": 50.0}}
    metrics |= {"zero_shot": SUMMARY, "few_shot": {**SUMMARY, "mean": error}, **changes}
    folder.mkdir()
    kept = {key: value for key, value in metrics.items() if value is not None}
    (folder / "metrics.json").write_text(json.dumps(kept))
    (folder / "config.json").write_text(json.dumps(ENVIRONMENT))
    return folder


def evaluation(path, seed, method="apg", **info):
    """A file as `adapt.evaluate` writes it, as far as the tables read it."""
    info = {"seed": seed, **info}
    metrics = {"method": method, "horizon": 10, "seed": 0, "policy_info": info, **SUMMARY}
    metrics |= {"options": {"vehicle": None, "system": "cartpole", "target": [], "policy": "a"}, "set": "paper"}
    metrics |= {"metric": "error", "unit": "m", "median_ms": 0.1}
    path.write_text(json.dumps(metrics | {"p99_ms": 0.2, "threads": 1, **ENVIRONMENT}))
    return path


def lines(answer):
    """The rows of the printed table as dictionaries."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in answer.out.splitlines()]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[2:]]


def test_runs_of_a_group_are_averaged_over_their_seeds(call, tmp_path):
    runs = [fewshot_run(tmp_path / str(seed), error, seed=seed) for seed, error in enumerate((0.1, 0.2, 0.6))]
    (line,) = lines(call("summary", *runs, "--csv", tmp_path / "a.csv"))
    spread = math.sqrt((0.2**2 + 0.1**2 + 0.3**2) / 3)
    assert line["few_shot"] == f"0.3000 ± {spread:.4f}"
    assert line["seeds"] == "3"
    assert line["seconds"] == "3.0 ± 0.0"  # without the oracle
    assert pd.read_csv(tmp_path / "a.csv").few_shot_mean.tolist() == [0.1, 0.2, 0.6]


@pytest.mark.parametrize("change", [{"set": "fast"}, {"updates": 600}, {"kind": "state"}, {"samples": 100}])
def test_runs_that_differ_in_more_than_their_seed_are_not_averaged(call, tmp_path, change):
    runs = [fewshot_run(tmp_path / "a", 0.1), fewshot_run(tmp_path / "b", 0.2, **change)]
    assert {line["few_shot"] for line in lines(call("summary", *runs))} == {"0.1000 ± 0.0000", "0.2000 ± 0.0000"}


def test_older_results_without_set_and_updates_are_read(call, tmp_path):
    runs = [fewshot_run(tmp_path / str(seed), seed=seed, set=None, updates=None) for seed in (0, 1)]
    (line,) = lines(call("summary", *runs))
    assert line["seeds"] == "2"
    newer = fewshot_run(tmp_path / "newer")
    assert len(lines(call("summary", *runs, newer))) == 2


def test_a_run_in_which_none_succeeded_is_shown_as_such(call, tmp_path):
    nothing = {"mean": None, "std": None, "success": 0.0, "n": 50}
    (line,) = lines(call("summary", fewshot_run(tmp_path / "a", oracle=nothing)))
    assert line["oracle"] == "nan ± nan"
    assert line["oracle success"] == "0"


def test_evaluations_and_adaptations_stand_in_one_table(call, tmp_path):
    runs = [evaluation(tmp_path / f"{seed}.json", seed) for seed in (0, 1)]
    (line,) = lines(call("summary", *runs))
    assert line["error"] == "0.1000 ± 0.0000"
    assert len(lines(call("summary", *runs, fewshot_run(tmp_path / "a")))) == 2


def test_methods_and_what_they_were_trained_in_and_with_are_not_averaged(call, tmp_path):
    ways = [{}, {"method": "ppo"}, {"method": "ppo", "trained_in": "drag=0.3"}, {"method": "ppo", "samples": 1000}]
    ways += [{"method": "mpc", "solver": "rti", "model": "source"}, {"method": "mpc", "solver": "rti", "compile": True}]
    runs = [evaluation(tmp_path / f"{i}-{seed}.json", seed, **way) for i, way in enumerate(ways) for seed in (0, 1)]
    table = lines(call("summary", *runs))
    assert len(table) == len(ways)
    assert {line["seeds"] for line in table} == {"2"}


def test_two_runs_of_a_group_with_one_seed_are_refused_by_name(refused, tmp_path):
    runs = [fewshot_run(tmp_path / name, error) for name, error in (("a", 0.1), ("b", 0.2))]
    line = refused("summary", *runs, "--csv", tmp_path / "a.csv")
    assert str(runs[0]) in line
    assert str(runs[1]) in line
    assert not (tmp_path / "a.csv").exists()
    older = [fewshot_run(tmp_path / name, set=None) for name in "cd"]
    assert "same seed" in refused("summary", runs[0], *older)


def test_there_must_be_runs(refused):
    assert "no runs: name folders" in refused("summary")


def test_what_holds_no_results_is_refused(refused, tmp_path):
    (tmp_path / "a.json").write_text("{}")
    assert "holds no results" in refused("summary", tmp_path / "a.json")
    assert "can't be read" in refused("summary", tmp_path / "none.json")


def test_a_csv_is_written_only_where_it_can_be_and_nothing_is_lost(call, refused, tmp_path):
    run = fewshot_run(tmp_path / "run")
    assert "there is no folder" in refused("summary", run, "--csv", tmp_path / "nodir" / "x.csv")
    assert "is a folder" in refused("summary", run, "--csv", tmp_path)
    path = tmp_path / "x.csv"
    path.write_text("mine")
    assert "exists; name another file or add --overwrite" in refused("summary", run, "--csv", path)
    assert path.read_text() == "mine"
    assert call("summary", run, "--csv", path, "--overwrite").status == 0
    assert len(pd.read_csv(path)) == 1


def test_runs_from_pictures_make_a_row_for_each_way_that_was_tried(call, tmp_path):
    same = {"steps": 250.0, "median_ms": 1.0, "p99_ms": 2.0}
    metrics = {
        "system": "cartpole",
        "target": "source",
        "samples": 1000,
        "metric": "speed",
        "unit": "m/s",
        "threads": 1,
    }
    metrics |= {"camera": {"height": 48}, **ENVIRONMENT, **SUMMARY, **same}
    for seed in (0, 1):
        trained = {"method": "apg", "seed": seed, "training": {"seconds": 9.0, "update": 50}}
        planned = {"method": "mpc", "seed": seed, "training": {}}
        planned |= {"attempts": [{"method": "mpc, other", **SUMMARY, **same, "mean": None, "success": 0.0}]}
        for own in (trained, planned):
            (tmp_path / f"{own['method']}{seed}").mkdir()
            (tmp_path / f"{own['method']}{seed}" / "metrics.json").write_text(json.dumps(metrics | own))
    answer = call("summary", *sorted(tmp_path.iterdir()), "--csv", tmp_path / "vision.csv")
    assert answer.status == 0, answer.errors
    table = pd.read_csv(tmp_path / "vision.csv")
    assert table.method.value_counts().to_dict() == {
        f"{name} from pictures": 2 for name in ("apg", "mpc", "mpc, other")
    }
    assert table.error_mean[table.method.str.contains("other")].isna().all()
    assert (table.seconds[table.method.str.startswith("apg")] == 9.0).all()
