"""`python -m adapt.fewshot`: the whole of it in one command, and one line for whatever goes wrong."""

import contextlib
import io
import json
import math
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from adapt import command, fewshot, report
from adapt.residual_kinds import load_residual
from adapt.transitions import Transitions
from envs import make_dynamics, make_system
from policies import apg
from policies.checkpoints import load_policy
from policies.evaluate import evaluate
from policies.evaluate import test_episodes as draw_tests
from policies.networks import as_actor

ROOT = Path(__file__).parents[2]
FILES = {"config.json", "metrics.json", "policy.safetensors", "residual.safetensors", "transitions.csv"}
FILES |= {"tuning.csv"}
LISTED = {
    "system",
    "target",
    "metric",
    "unit",
    "samples",
    "seed",
    "source",
    "zero_shot",
    "few_shot",
    "prediction",
    "seconds",
}


@pytest.fixture(autouse=True)
def no_pictures(request, monkeypatch):
    """Pictures have tests of their own; they take longer than all the rest."""
    if "pictures" not in request.node.name:
        monkeypatch.setattr(fewshot, "_pictures", lambda options, adaptation, folder: None)


@pytest.fixture(scope="module")
def quick(quadrotor_file):
    """Options of a small adaptation of the rough quadrotor policy."""
    return ("--samples", "100", "--updates", "5", "--ungated", "--policy", str(quadrotor_file))


@pytest.fixture
def cart(cartpole_file):
    """Options of a small adaptation of the rough cart-pole policy."""
    base = ("--system", "cartpole", "--policy", cartpole_file, "--target", "drag=1")
    return (*base, "--samples", 30, "--updates", 3, "--ungated")


@pytest.fixture(scope="module")
def finished(quick, tmp_path_factory):
    """The folder of a small adaptation with an oracle, and what the command printed."""
    folder, printed = tmp_path_factory.mktemp("fewshot") / "run", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(fewshot, "_pictures", lambda options, adaptation, folder: None)
        patch.setattr(sys, "argv", ["fewshot", *quick, "--oracle", "--out", str(folder)])
        command.run("adapt.fewshot", fewshot.Options, fewshot.main)
    return folder, printed.getvalue()


def read(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_it_leaves_everything_that_it_promises_and_nothing_else(finished):
    assert {path.name for path in finished[0].iterdir()} == FILES


def test_the_metrics_have_the_keys_that_others_read(finished):
    metrics = read(finished[0])
    assert LISTED | {"oracle"} <= metrics.keys()
    said = ("quadrotor", "drag=0.3", "mean position error", "m", 100, 0, "paper", 5)
    keys = ("system", "target", "metric", "unit", "samples", "seed", "set", "updates")
    assert tuple(metrics[key] for key in keys) == said
    for name in ("source", "zero_shot", "few_shot", "oracle"):
        assert set(metrics[name]) == {"mean", "std", "success", "n"}
        assert metrics[name]["n"] == 50
        assert 0 <= metrics[name]["success"] <= 1
    assert set(metrics["seconds"]) == {"evaluate", "collect", "fit", "finetune", "oracle"}
    model, learned = metrics["prediction"]["model"], metrics["prediction"]["model + residual"]
    assert model.keys() == learned.keys()
    assert learned["acceleration"] < 0.1 * model["acceleration"]


def test_the_gate_says_what_it_decided_and_why(call, cartpole_file, tmp_path):
    cart = ("--system", "cartpole", "--policy", cartpole_file, "--samples", 30, "--updates", 1, "--out", tmp_path)
    answer = call("fewshot", *cart, "--target", "cart_mass=1.0")  # as in the model
    assert answer.status == 0, answer
    metrics = read(tmp_path)
    assert not metrics["gate"]["accepted"]
    assert f"gate: kept the old policy; {metrics['gate']['reason']}" in answer.out
    assert metrics["few_shot"] == metrics["zero_shot"]
    assert "few-shot, refused" not in answer.out  # what was found is the old policy
    assert load_policy(tmp_path / "policy.safetensors").info == load_policy(cartpole_file).info


def test_the_table_says_what_the_metrics_say(finished):
    metrics, printed = read(finished[0]), finished[1]
    for name in ("source", "zero_shot", "few_shot", "oracle"):
        m = metrics[name]
        (line,) = [x for x in printed.splitlines() if x.startswith(f"{name.replace('_', '-')} ") and "±" in x]
        assert f"{m['mean']:.4f} ± {m['std']:.4f}" in line
        assert float(line.split()[-2]) == round(m["success"], 2)
        assert int(line.split()[-1]) == m["n"]
    assert "unseen transitions, one step" in printed
    assert "seconds (1 thread)" in printed


def test_the_settings_are_written_down(finished, quadrotor_file):
    config = json.loads((finished[0] / "config.json").read_text())
    assert config["options"]["policy"] == str(quadrotor_file)
    assert config["options"]["samples"] == 100
    assert {"seed", "threads", "torch", "commit"} <= config.keys()


def test_policy_and_residual_load_with_one_call_and_fly_as_reported(finished):
    folder = finished[0]
    policy, residual = load_policy(folder / "policy.safetensors"), load_residual(folder / "residual.safetensors")
    assert policy.info["finetuned_updates"] == 5
    target = make_dynamics("quadrotor", "drag=0.3")
    again = evaluate(as_actor(policy.network), target, policy.task, draw_tests(policy.task))
    assert again.summary == read(folder)["few_shot"]
    state = policy.task.start(draw_tests(policy.task), torch.full((50,), 30)).double()
    action = torch.zeros(50, 4, dtype=torch.float64)
    source = make_dynamics("quadrotor")(state, action)
    missed = (residual(state, action) - target(state, action))[:, 7:10].norm()
    assert missed < 0.1 * (source - target(state, action))[:, 7:10].norm()


def test_the_transitions_are_those_of_the_target_and_can_be_given_back(call, finished, quick, tmp_path):
    folder = finished[0]
    transitions = Transitions.load(folder / "transitions.csv", make_system("quadrotor"))
    assert len(transitions) == 100
    predicted = make_dynamics("quadrotor", "drag=0.3")(transitions.state, transitions.action)
    torch.testing.assert_close(predicted, transitions.next_state, rtol=1e-5, atol=1e-5)
    given = ("--transitions", folder / "transitions.csv", "--out", tmp_path / "again", "--target", "drag=0.3")
    assert call("fewshot", *quick, *given).status == 0
    before, after = read(folder), read(tmp_path / "again")
    for key in ("source", "zero_shot", "few_shot", "prediction", "samples", "target"):
        assert after[key] == before[key], key


@pytest.mark.slow
def test_recorded_transitions_alone_stand_for_the_target(call, finished, quick, tmp_path):
    answer = call("fewshot", *quick, "--transitions", finished[0] / "transitions.csv", "--out", tmp_path / "run")
    assert answer.status == 0
    metrics = read(tmp_path / "run")
    assert metrics["target"] == "transitions.csv"
    assert metrics["evaluated_in"] == "model + residual"
    assert metrics["few_shot"]["mean"] == pytest.approx(read(finished[0])["few_shot"]["mean"], rel=0.05)


def test_the_same_seed_gives_the_same_metrics_and_another_seed_others(call, cart, tmp_path):
    found = []
    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        assert call("fewshot", *cart, "--seed", seed, "--out", tmp_path / name).status == 0
        found.append({**read(tmp_path / name), "seconds": None, "seed": None})
    assert found[0] == found[1]
    assert found[0]["few_shot"] != found[2]["few_shot"]
    files = [(tmp_path / name / "transitions.csv").read_bytes() for name in "ab"]
    assert files[0] == files[1]


@pytest.mark.parametrize("kind", ["acceleration", "state"])
def test_the_kind_of_residual_can_be_chosen(call, cart, tmp_path, kind):
    assert call("fewshot", *cart, "--residual", kind, "--out", tmp_path).status == 0
    assert load_residual(tmp_path / "residual.safetensors").config.kind == kind
    assert read(tmp_path)["residual"]["kind"] == kind


def test_targets_combine_and_exploration_and_set_are_passed_on(call, quick, rough_quadrotor, tmp_path):
    options = ("--target", "mass=x1.1", "--target", "push=1,0,0", "--exploration", 0, "--set", "circle")
    assert call("fewshot", *quick, *options, "--out", tmp_path).status == 0
    assert read(tmp_path)["target"] == "mass=x1.1 push=1,0,0"
    flown = Transitions.load(tmp_path / "transitions.csv")
    target = make_dynamics("quadrotor", "mass=x1.1 push=1,0,0")
    torch.testing.assert_close(target(flown.state, flown.action), flown.next_state, rtol=1e-5, atol=1e-5)
    policy = load_policy(tmp_path / "policy.safetensors")
    assert policy.task.set == "circle"
    first = policy.task.start(policy.task.episodes(1, "train", 0), torch.zeros(1, dtype=torch.long))
    torch.testing.assert_close(flown.state[:1], first)
    window = policy.task.window(
        first, policy.task.reference(policy.task.episodes(1, "train", 0), torch.zeros(1).long(), first)
    )
    without_noise = rough_quadrotor.network(policy.task.observe(first), window)[:, 0]
    torch.testing.assert_close(flown.action[:1], without_noise.detach())


def test_the_folder_is_named_after_the_run(call, cart, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("fewshot", *cart, "--target", "mass=x1.2", "--seed", 7).status == 0
    assert {
        path.name for path in (tmp_path / "runs" / "fewshot-cartpole-drag=1-mass=x1.2-n30-seed7").iterdir()
    } == FILES


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sample", "3"), "--sample"),
        (("--samples", "many"), "many"),
        (("--samples", "0"), "--samples 0"),
        (("--samples", "5"), "--samples 5: a residual needs at least 10 transitions"),
        (("--updates", "0"), "--updates 0"),
        (("--exploration", "-1"), "--exploration -1"),
        (("--exploration", "nan"), "--exploration nan"),
        (("--residual", "jerk"), "--residual jerk: expected one of auto, parameters"),
        (("--system", "submarine"), "--system submarine"),
        (("--target", "gravitas=1"), "--target gravitas=1: cartpole has no 'gravitas'"),
        (("--target", "pole_mass=-1"), "pole_mass is -1"),
        (("--target", "cart_mass=x0"), "cart_mass is 0"),
        (("--target", "drag=strong"), "'strong' is not a number"),
        (("--policy", "none.safetensors"), "none.safetensors: no such file"),
        (("--system", "fixed_wing"), "trained for cartpole, not for fixed_wing"),
        (("--vehicle", "crazyflie"), "--vehicle crazyflie: is a quadrotor"),
        (("--transitions", "none.csv"), "none.csv"),
        (("--transitions", "none.txt"), "unknown kind of file '.txt'"),
        (("--log", "a.csv"), "--log"),
        (("--validate", "a.csv"), "--validate: needs --log"),
        (("--mapping", "my.toml"), "--mapping: says what a log's columns are; give the log with --log"),
        (("--transitions", "a.csv", "--rounds", "2"), "--rounds: parts of a flight for data; leave it out"),
        (("--threads", "0"), "--threads 0"),
        (("--seed", "-1"), "--seed -1: expected between 0"),
        (("--seed", "9" * 30), "expected between 0 and 2^63 - 1"),
        (("--device", "nonsense"), "--device nonsense"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(refused, cart, tmp_path, options, words):
    assert words in refused("fewshot", *cart, "--out", tmp_path / "run", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "slalom"), "--set slalom"),
        (("--target", "mass=-1"), "mass is -1"),
        (("--vehicle", "crazyflie"), "this robot has"),
    ],
)
def test_bad_options_of_a_quadrotor_are_refused_too(refused, quick, tmp_path, options, words):
    assert words in refused("fewshot", *quick, "--out", tmp_path / "run", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [None, "t,x,y,z\n0,0,0,1\n", "t,x,y\n0,0,0\n5,1,1\n"])
def test_waypoints_that_can_not_be_flown_are_refused_before_anything_is_lost(
    refused, quick, tmp_path, contents, content
):
    path, folder = tmp_path / "path.csv", tmp_path / "run"
    if content:
        path.write_text(content)
    assert "path.csv" in refused("fewshot", *quick, "--set", path, "--out", folder)
    assert not folder.exists()
    folder.mkdir()
    (folder / "metrics.json").write_text("old")
    refused("fewshot", *quick, "--set", path, "--out", folder, "--overwrite")
    assert contents(folder) == {"metrics.json": b"old"}


def hover_log(path, seconds):
    """A log of a Crazyflie that stands still in the air."""
    columns = "t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,p,q,r,motor1,motor2,motor3,motor4,vbat"
    rows = [f"{k / 100},0,0,1,1,0,0,0,0,0,0,0,0,0,35000,35000,35000,35000,3.7" for k in range(round(100 * seconds))]
    path.write_text("\n".join((columns, *rows)) + "\n")
    return path


def test_validation_flights_must_be_others_than_those_learned_from(refused, quick, tmp_path):
    log, other = hover_log(tmp_path / "a.csv", 3), hover_log(tmp_path / "b.csv", 3)
    given = ("--vehicle", "crazyflie", "--log", other, "--log", log, "--out", tmp_path / "run")
    again = tmp_path / "folder" / ".." / "a.csv"
    line = refused("fewshot", *quick, *given, "--validate", again)
    assert f"--validate {again}: is learned from" in line
    assert not (tmp_path / "run").exists()


def test_a_log_is_given_once(refused, quick, tmp_path):
    log = hover_log(tmp_path / "a.csv", 3)
    line = refused("fewshot", *quick, "--vehicle", "crazyflie", "--log", log, "--log", log, "--out", tmp_path / "run")
    assert "--log: names a file twice" in line
    assert not (tmp_path / "run").exists()


def test_validation_flights_that_are_too_short_are_told_before_the_work(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("adapt.adaptation.adapt", ctrl_c)
    log, short = hover_log(tmp_path / "a.csv", 4), hover_log(tmp_path / "b.csv", 1)
    given = ("--vehicle", "crazyflie", "--log", log, "--validate", short, "--out", tmp_path / "run")
    assert "lasts 1 s" in refused("fewshot", *given)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--system", "fixed_wing"), "--log: needs --vehicle"),
        (("--system", "fixed_wing", "--vehicle", "crazyflie"), "is a quadrotor, --system says fixed_wing; leave --sy"),
        (("--system", "cartpole", "--vehicle", "crazyflie"), "is a quadrotor, --system says cartpole; leave --system"),
        (
            ("--system", "fixed_wing", "--vehicle", "j3cub"),
            "a.csv: flight logs are of quadrotors, j3cub is a fixed_wing",
        ),
        (("--vehicle", "j3cub"), "a.csv: flight logs are of quadrotors, j3cub is a fixed_wing"),
    ],
)
def test_a_log_of_another_robot_is_told_in_one_line(refused, tmp_path, options, words):
    log = hover_log(tmp_path / "a.csv", 3)
    assert words in refused("fewshot", "--log", log, *options, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_table_says_where_was_flown_if_not_in_the_target(finished):
    metrics = read(finished[0])
    assert "flown in" not in report.table(metrics)
    header = report.table({**metrics, "target": "a.csv", "evaluated_in": "model + residual"}).split("\n")[2]
    assert header.startswith("a.csv, flown in model + residual ")


def test_what_an_earlier_run_drew_does_not_stay(call, cart, tmp_path):
    for name in fewshot.PICTURES:
        (tmp_path / name).write_text("old")
    assert call("fewshot", *cart, "--out", tmp_path, "--overwrite").status == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_an_oracle_needs_a_target(refused, finished, quick, tmp_path):
    given = ("--transitions", finished[0] / "transitions.csv", "--oracle", "--out", tmp_path / "run")
    assert "--oracle: needs --target" in refused("fewshot", *quick, *given)
    assert list(tmp_path.iterdir()) == []


def test_a_pickled_checkpoint_is_refused(refused, cart, tmp_path):
    torch.save({"weights": torch.zeros(2)}, tmp_path / "policy.pt")
    assert "pickles" in refused("fewshot", *cart, "--policy", tmp_path / "policy.pt", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def spoilt(lines, how):
    """Lines of a transitions file with one thing wrong: comment, header, rows."""
    comment, header, *data = lines
    if how == "few rows":
        return [comment, header, *data[:4]]
    if how == "column":
        return [comment, header.replace("action_thrust", "thrust"), *data]
    if how == "number":
        return [comment, header, data[0].replace(data[0].split(",")[5], "fast", 1), *data[1:]]
    if how == "system":
        return [comment.replace("system=quadrotor", "system=fixed_wing"), header, *data]
    return []


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("few rows", "4 transitions, at least 10 are needed"),
        ("column", "no column action_thrust"),
        ("number", "row 3"),
        ("system", "recorded on fixed_wing, expected quadrotor"),
        ("empty", "empty"),
    ],
)
def test_transitions_that_can_not_be_used_are_refused_by_row_or_column(refused, finished, quick, tmp_path, how, words):
    lines = (finished[0] / "transitions.csv").read_text().splitlines()
    path = tmp_path / "flown.csv"
    path.write_text("\n".join(spoilt(lines, how)) + "\n")
    line = refused("fewshot", *quick, "--transitions", path, "--out", tmp_path / "run")
    assert words in line
    assert str(path) in line
    assert not (tmp_path / "run").exists()


def test_actions_that_are_refused_leave_an_empty_folder_to_the_mended_command(call, refused, finished, quick, tmp_path):
    right, wrong, out = finished[0] / "transitions.csv", tmp_path / "wrong.csv", tmp_path / "run"
    record = Transitions.load(right)
    replace(record, action=record.action * torch.tensor([1.0, -1.0, 1.0, 1.0])).save(wrong)
    line = refused("fewshot", *quick, "--transitions", wrong, "--out", out)
    assert line.startswith(f"fewshot: {wrong}: the model explains them")
    assert list(out.iterdir()) == []
    assert call("fewshot", *quick, "--transitions", right, "--out", out).status == 0


def test_a_used_folder_is_left_alone_unless_overwriting_is_asked_for(call, refused, cart, tmp_path, contents):
    assert call("fewshot", *cart, "--seed", 1, "--out", tmp_path).status == 0
    (tmp_path / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    assert "already holds results" in refused("fewshot", *cart, "--out", tmp_path)
    assert contents(tmp_path) == before
    assert call("fewshot", *cart, "--seed", 2, "--out", tmp_path, "--overwrite").status == 0
    assert read(tmp_path)["seed"] == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    assert "is a file" in refused("fewshot", *cart, "--out", tmp_path / "file", "--overwrite")
    assert (tmp_path / "file").read_text() == "mine"


def ctrl_c(*args, **kwargs):
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("place", "left"),
    [
        ("adapt.rounds.collect", {"config.json"}),
        ("adapt.residual.fit_residual", {"config.json", "transitions.csv"}),
        ("policies.apg.learning_rate", {"config.json", "transitions.csv", "residual.safetensors"}),
        ("adapt.fewshot._metrics", FILES - {"metrics.json"}),
        ("adapt.fewshot._pictures", FILES),
    ],
)
def test_ctrl_c_at_any_stage_keeps_what_was_finished(call, cart, tmp_path, monkeypatch, place, left):
    monkeypatch.setattr(place, ctrl_c)
    answer = call("fewshot", *cart, "--out", tmp_path)
    assert answer.status == 130
    assert len(answer.errors) == 1
    assert answer.errors[0].startswith("fewshot: interrupted")
    assert {path.name for path in tmp_path.iterdir()} == left
    if "transitions.csv" in left:
        assert len(Transitions.load(tmp_path / "transitions.csv", make_system("cartpole"))) == 30
    if "residual.safetensors" in left:
        assert load_residual(tmp_path / "residual.safetensors").system.name == "cartpole"
    if "policy.safetensors" in left:
        assert load_policy(tmp_path / "policy.safetensors").info["finetuned_updates"] == 3


@pytest.mark.slow
def test_an_interrupted_overwriting_run_does_not_keep_results_of_the_old_one(call, cart, tmp_path, monkeypatch):
    assert call("fewshot", *cart, "--out", tmp_path).status == 0
    monkeypatch.setattr(apg, "learning_rate", ctrl_c)
    assert call("fewshot", *cart, "--seed", 1, "--out", tmp_path, "--overwrite").status == 130
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "transitions.csv", "residual.safetensors"}


@pytest.mark.parametrize("name", ["config.json", "metrics.json", "policy.safetensors", "residual.safetensors"])
def test_a_disk_that_fills_up_leaves_whole_files_only(refused, cart, tmp_path, monkeypatch, name):
    def filling(write, half):
        def written(path, content, *args, **kwargs):
            if name in path.name:
                write(path, half(content), *args, **kwargs)
                raise OSError(28, "No space left on device", str(path))
            return write(path, content, *args, **kwargs)

        return written

    for kind in ("write_text", "write_bytes"):
        monkeypatch.setattr(Path, kind, filling(getattr(Path, kind), lambda content: content[: len(content) // 2]))
    line = refused("fewshot", *cart, "--out", tmp_path)
    assert "No space left on device" in line
    left = {path.name for path in tmp_path.iterdir()}
    assert left <= FILES - {name}
    for path in tmp_path.glob("*.json"):
        json.loads(path.read_text())


def as_process(*options, **more):
    start = [sys.executable, "-m", "adapt.fewshot", *map(str, options)]
    return subprocess.Popen(start, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **more)


@pytest.mark.slow
def test_as_a_process_ctrl_c_in_the_fine_tuning_ends_with_130(cart, tmp_path, stderr_lines):
    run = as_process(*cart, "--updates", 100000, "--out", tmp_path)
    patience = time.monotonic() + 120
    while not (tmp_path / "residual.safetensors").exists() and time.monotonic() < patience:
        time.sleep(0.1)
    time.sleep(1)
    run.send_signal(signal.SIGINT)
    errors = stderr_lines(run.communicate(timeout=60)[1].decode())
    assert run.returncode == 130
    assert errors == [f"fewshot: interrupted; what was finished is in {tmp_path}; --overwrite begins again"]
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "transitions.csv", "residual.safetensors"}
    assert Transitions.load(tmp_path / "transitions.csv", make_system("cartpole"))
    assert load_residual(tmp_path / "residual.safetensors")


@pytest.mark.slow
def test_as_a_process_a_file_that_may_not_grow_ends_with_2(quick, tmp_path, stderr_lines):
    """A limit on the size of files is as near to a full disk as one gets without filling one."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (10000, 10000))

    run = as_process(*quick, "--out", tmp_path, preexec_fn=limit)
    errors = stderr_lines(run.communicate(timeout=300)[1].decode())
    assert run.returncode == 2
    assert len(errors) == 1
    assert "transitions.csv" in errors[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_pictures_and_a_video_come_with_it(call, cart, tmp_path):
    answer = call("fewshot", *cart, "--video", "--gif", "--out", tmp_path)
    assert answer.status == 0, answer
    assert answer.errors == []
    assert {path.name for path in tmp_path.iterdir()} == {*fewshot.RESULTS, *fewshot.PICTURES} > FILES
    assert all(path.stat().st_size > 1000 for path in tmp_path.iterdir() if path.name in fewshot.PICTURES)


@pytest.mark.parametrize(
    ("source", "before", "after", "said"),
    [
        ((1.0, 0.1), (1.0, 0.2), (1.0, 0.1), None),
        ((1.0, 0.1), (1.0, 0.2), (1.0, 0.3), "worse than the old one"),
        ((1.0, 0.1), (1.0, 0.2), (0.9, 0.1), "worse than the old one"),
        ((0.0, math.nan), (0.0, math.nan), (0.0, math.nan), "no flight succeeded even in the model"),
    ],
)
def test_a_result_that_should_not_be_overlooked_is_told(source, before, after, said):
    names = ("source", "zero_shot", "few_shot")
    pairs = zip(names, (source, before, after), strict=True)
    notes = report.notes({name: {"success": success, "mean": mean} for name, (success, mean) in pairs})
    assert len(notes) == (said is not None)
    assert all(said in note for note in notes)


def test_each_update_of_the_fine_tuning_is_written_and_the_target_is_flown_where_asked(call, cart, tmp_path):
    import pandas as pd

    assert call("fewshot", *cart, "--watch", 2, "--out", tmp_path / "watched").status == 0
    watched = pd.read_csv(tmp_path / "watched" / "tuning.csv")
    assert list(watched["update"]) == [1, 2, 3] and watched.seconds.is_monotonic_increasing
    assert list(watched.error.notna()) == [False, True, True]  # and after the last
    seconds = json.loads((tmp_path / "watched" / "metrics.json").read_text())["seconds"]
    assert seconds["watch"] > 0 and seconds["finetune"] > 0
    assert call("fewshot", *cart, "--out", tmp_path / "plain").status == 0
    plain = pd.read_csv(tmp_path / "plain" / "tuning.csv")
    assert "error" not in plain and list(plain.cost) == list(watched.cost)  # to watch changes nothing


def test_to_watch_never_is_refused(refused, cart, tmp_path):
    assert "--watch 0: expected at least 1" in refused("fewshot", *cart, "--watch", 0, "--out", tmp_path / "x")
