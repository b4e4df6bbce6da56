"""A run is carried out once, goes on where it was cut off, and says what it found and how."""

import json
import threading

import pytest

from adapt import evaluate, fewshot, pretrain
from adapt import experiment_run as runs
from adapt.experiment_table import EXPERIMENTS, Experiment, Step, fly, policy_of, trained

TRAINING = {"updates": 4, "batch": 4, "every": 2, "width": 8}


@pytest.fixture
def tiny(monkeypatch):
    """Two experiments of a few seconds, the second of which starts from the policy of the first."""
    train = trained("tiny", "check", "cartpole", flown={"episodes": 2}, **TRAINING)
    flown = fly("cartpole", policy=policy_of("tiny"), target=("push=1",), episodes=2)
    monkeypatch.setitem(EXPERIMENTS, "tiny", train)
    monkeypatch.setitem(EXPERIMENTS, "tiny-push", Experiment("tiny-push", "check", (flown,)))
    runs.step_hash.cache_clear()
    yield
    runs.step_hash.cache_clear()


@pytest.fixture
def calls(monkeypatch):
    """The commands that are carried out, with their options."""
    seen = []
    for module in (pretrain, evaluate, fewshot):

        def counted(options, module=module, main=module.main):
            seen.append((module.__name__.split(".")[-1], options))
            return main(options)

        monkeypatch.setattr(module, "main", counted)
    return seen


def test_a_row_holds_the_figures_of_the_last_step_and_how_they_came_about(tiny, tmp_path):
    row = runs.run("tiny", 1, tmp_path)
    folder = tmp_path / "tiny" / "seed-1"
    found = json.loads((folder / "evaluation.json").read_text())
    assert (row["experiment"], row["seed"], row["system"], row["method"]) == ("tiny", 1, "cartpole", "apg")
    assert (row["success"], row["n"], row["metric"], row["unit"]) == (found["success"], 2, "mean cart speed", "m/s")
    assert row["samples"] == 4 * 4
    assert row["commit"] == found["commit"] and row["threads"] == 1 and row["torch"] == found["torch"]
    assert row["config"] == runs.config_hash("tiny")
    assert json.loads((folder / "row.json").read_text()) == json.loads(json.dumps(row).replace("NaN", "null"))
    assert "validation error" in (folder / "log.txt").read_text()


def test_the_seed_reaches_the_training(tiny, calls, tmp_path):
    runs.run("tiny", 3, tmp_path)
    assert [(name, options.seed) for name, options in calls] == [("pretrain", 3), ("evaluate", 0)]


def test_what_is_done_is_not_done_again(tiny, calls, tmp_path):
    first = runs.run("tiny", 0, tmp_path)
    count = len(calls)
    assert runs.run("tiny", 0, tmp_path) == json.loads(json.dumps(first).replace("NaN", "null"))
    assert len(calls) == count == 2


def test_a_run_goes_on_behind_the_last_finished_step(tiny, calls, tmp_path, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(evaluate, "main", lambda options: 1 / 0)
        with pytest.raises(RuntimeError, match=r"tiny seed 0: division by zero \(log: .*log.txt\)"):
            runs.run("tiny", 0, tmp_path)
    assert runs.finished(tmp_path, "tiny", 0) is None
    assert "ZeroDivisionError" in (tmp_path / "tiny/seed-0/log.txt").read_text()
    runs.run("tiny", 0, tmp_path)
    assert [name for name, _ in calls] == ["pretrain", "evaluate"]


def test_training_that_was_cut_off_is_resumed(tiny, calls, tmp_path, monkeypatch):
    from policies import apg

    train = apg.train

    def cut_off(*arguments):
        for metrics in train(*arguments):
            yield metrics
            if metrics["update"] == 3:
                raise KeyboardInterrupt

    with monkeypatch.context() as broken, pytest.raises(KeyboardInterrupt):
        broken.setattr(apg, "train", cut_off)
        runs.run("tiny", 0, tmp_path)
    row = runs.run("tiny", 0, tmp_path)
    assert [options.resume for name, options in calls if name == "pretrain"] == [False, True]
    runs.run("tiny", 0, tmp_path / "again")
    errors = [[point["error"] for point in runs.curve(root, "tiny", 0)] for root in (tmp_path, tmp_path / "again")]
    assert errors[0] == errors[1] and row["samples"] == 16


def test_a_run_with_other_settings_is_done_again(tiny, calls, tmp_path, monkeypatch):
    runs.run("tiny", 0, tmp_path)
    other = trained("tiny", "check", "cartpole", flown={"episodes": 2}, **{**TRAINING, "updates": 6})
    monkeypatch.setitem(EXPERIMENTS, "tiny", other)
    runs.step_hash.cache_clear()
    assert runs.run("tiny", 0, tmp_path)["samples"] == 6 * 4
    assert [name for name, _ in calls] == ["pretrain", "evaluate", "pretrain", "evaluate"]


def test_an_experiment_flies_what_the_one_that_it_needs_has_trained(tiny, calls, tmp_path):
    runs.run("tiny", 2, tmp_path)
    row = runs.run("tiny-push", 2, tmp_path)
    assert calls[-1][1].policy == str(tmp_path / "tiny/seed-2/training/policy.safetensors")
    assert row["target"] == "push=1"


def test_a_run_in_two_processes_is_done_once(tiny, calls, tmp_path):
    both = [threading.Thread(target=runs._alone(tmp_path / "lock").__enter__) for _ in range(2)]
    with runs._alone(tmp_path / "lock"):
        both[0].start()
        both[0].join(0.3)
        assert both[0].is_alive()
    both[0].join(5)
    assert not both[0].is_alive()


def test_an_adaptation_reports_its_stages(monkeypatch, tmp_path, cartpole_file):
    options = {"system": "cartpole", "target": ("push=1",), "samples": 20, "updates": 2, "watch": 1, "oracle": True}
    options["policy"] = str(cartpole_file)
    step = Step("adapt.fewshot", {**options, "seed": "{seed}"}, "adaptation")
    monkeypatch.setitem(EXPERIMENTS, "tiny-adapt", Experiment("tiny-adapt", "check", (step,), "adaptation/tuning.csv"))
    row = runs.run("tiny-adapt", 0, tmp_path)
    found = json.loads((tmp_path / "tiny-adapt/seed-0/adaptation/metrics.json").read_text())
    assert row["error"] == found["few_shot"]["mean"]
    assert (row["zero_shot"], row["oracle"]) == (found["zero_shot"]["mean"], found["oracle"]["mean"])
    assert row["learned_acceleration"] < row["model_acceleration"]
    points = runs.curve(tmp_path, "tiny-adapt", 0)
    assert [point["update"] for point in points if float(point["error"]) > 0] == ["1", "2"]
    runs.step_hash.cache_clear()


def test_the_curve_of_a_training_run_holds_its_validations(tiny, tmp_path):
    runs.run("tiny", 0, tmp_path)
    points = runs.curve(tmp_path, "tiny", 0)
    assert [(p["experiment"], p["seed"], p["update"], p["samples"]) for p in points] == [
        ("tiny", 0, "2", "8"),
        ("tiny", 0, "4", "16"),
    ]


@pytest.mark.parametrize("name", ["row.json", "evaluation.json.step.json", "training.step.json"])
@pytest.mark.parametrize("content", ["{", "[]", "{}"])
def test_a_damaged_record_counts_as_none(tiny, calls, tmp_path, name, content):
    runs.run("tiny", 0, tmp_path)
    folder = tmp_path / "tiny" / "seed-0"
    (folder / "row.json").unlink()
    (folder / name).write_text(content)
    assert runs.run("tiny", 0, tmp_path)["samples"] == 16
    again = {"row.json": 2, "evaluation.json.step.json": 3, "training.step.json": 3}[name]
    assert len(calls) == again


def test_training_that_cannot_go_on_begins_again(tiny, calls, tmp_path, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(evaluate, "main", lambda options: 1 / 0)
        with pytest.raises(RuntimeError):
            runs.run("tiny", 0, tmp_path)
    folder = tmp_path / "tiny" / "seed-0"
    record = json.loads((folder / "training.step.json").read_text())
    (folder / "training.step.json").write_text(json.dumps(record | {"done": False}))
    (folder / "training" / "training.pt").write_bytes(b"damaged")
    assert runs.run("tiny", 0, tmp_path)["samples"] == 16
    assert [options.resume for name, options in calls if name == "pretrain"] == [False, True, False]
    assert "training.pt is damaged" in (folder / "log.txt").read_text()


def test_the_time_of_all_attempts_and_steps_counts(tiny, tmp_path, monkeypatch):
    row = runs.run("tiny", 0, tmp_path)
    folder = tmp_path / "tiny" / "seed-0"
    for step, seconds in (("training", 100.0), ("evaluation.json", 20.0)):
        record = json.loads((folder / f"{step}.step.json").read_text())
        (folder / f"{step}.step.json").write_text(json.dumps(record | {"seconds": seconds}))
    (folder / "row.json").unlink()
    assert runs.run("tiny", 0, tmp_path)["wall_s"] == 120.0 > row["wall_s"]
    (folder / "row.json").unlink()
    (folder / "evaluation.json.step.json").write_text(json.dumps(record | {"seconds": 20.0, "done": False}))
    assert runs.run("tiny", 0, tmp_path)["wall_s"] > 120.0


def test_a_row_names_every_commit_that_its_steps_were_done_at(tiny, tmp_path):
    runs.run("tiny", 0, tmp_path)
    folder = tmp_path / "tiny" / "seed-0"
    config = json.loads((folder / "training" / "config.json").read_text())
    (folder / "training" / "config.json").write_text(json.dumps(config | {"commit": "0ld"}))
    (folder / "row.json").unlink()
    assert runs.run("tiny", 0, tmp_path)["commit"] == f"0ld {config['commit']}"


def test_who_flies_the_policy_of_another_experiment_tells_its_samples(tiny, tmp_path):
    runs.run("tiny", 0, tmp_path)
    assert runs.run("tiny-push", 0, tmp_path)["samples"] == 16


def test_the_folder_of_the_runs_may_be_spelled_in_any_way(tiny, calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs.run("tiny", 0, "here")
    runs.run("tiny-push", 0, tmp_path / "here")
    assert calls[-1][1].policy == calls[-2][1].policy == str(tmp_path / "here/tiny/seed-0/training/policy.safetensors")
