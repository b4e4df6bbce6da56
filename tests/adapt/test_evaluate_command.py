"""`python -m adapt.evaluate`: what it prints and writes, and what it refuses."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from envs import make_dynamics
from policies.checkpoints import load_policy
from policies.evaluate import evaluate
from policies.gradients import gradient_statistics
from policies.networks import as_actor

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cart(cartpole_file):
    """Options that fly the rough cart-pole policy."""
    return ("--system", "cartpole", "--policy", cartpole_file)


def test_it_prints_and_writes_what_evaluate_finds(call, cart, rough_cartpole, tmp_path):
    out = tmp_path / "result.json"
    answer = call("evaluate", *cart, "--target", "push=0.5", "--target", "drag=1", "--episodes", 4, "--out", out)
    assert answer.status == 0
    assert answer.errors == []
    task = rough_cartpole.task
    dynamics = make_dynamics("cartpole", "push=0.5 drag=1")
    wanted = evaluate(as_actor(rough_cartpole.network), dynamics, task, task.episodes(4, "test", 0))
    found = json.loads(out.read_text())
    assert {key: found[key] for key in ("mean", "std", "success", "n")} == wanted.summary
    assert found["table"] == wanted.table.to_dict("list")
    assert (found["metric"], found["unit"], found["seed"]) == ("mean cart speed", "m/s", 0)
    assert 0 < found["median_ms"] <= found["p99_ms"]
    assert f"{wanted.summary['mean']:.4f} ± {wanted.summary['std']:.4f} m/s" in answer.out
    assert "time per action" in answer.out
    assert [file.name for file in tmp_path.iterdir()] == ["result.json"]


def test_set_split_and_seed_choose_the_episodes(call, quadrotor_file, tmp_path):
    base = ("--policy", quadrotor_file, "--episodes", 2)
    choices = {"test": (), "seed": ("--seed", 1), "split": ("--split", "validation"), "circle": ("--set", "circle")}
    errors = {}
    for name, options in choices.items():
        assert call("evaluate", *base, *options, "--out", tmp_path / f"{name}.json").status == 0
        errors[name] = json.loads((tmp_path / f"{name}.json").read_text())["table"]["error"]
    assert len({tuple(row) for row in errors.values()}) == 4
    assert errors["circle"][0] == pytest.approx(errors["circle"][1], rel=1e-4)  # one curve only
    assert errors["test"][0] != pytest.approx(errors["test"][1], rel=1e-2)


def test_waypoints_from_a_csv_can_be_flown(call, quadrotor_file, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("t,x,y,z\n0,0,0,1\n5,1,0,1\n12,1,1,1.5\n")
    answer = call("evaluate", "--policy", quadrotor_file, "--set", path, "--episodes", 1)
    assert answer.status == 0
    assert "N = 1" in answer.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sistem", "cartpole"), "--sistem"),
        (("--episodes", "many"), "many"),
        (("--system", "submarine"), "--system submarine: expected one of"),
        (("--target", "gravitas=1"), "--target gravitas=1: cartpole has no 'gravitas'"),
        (("--target", "cart_mass=-1"), "--target cart_mass=-1: cartpole: cart_mass is -1"),
        (("--target", "drag"), "--target drag: expected NAME=VALUE"),
        (("--target", "drag=nan"), "not a finite number"),
        (("--split", "exam"), "--split exam: expected one of train, validation, test"),
        (("--episodes", "0"), "--episodes 0: expected at least 1"),
        (("--threads", "0"), "--threads 0"),
        (("--seed", "-1"), "--seed -1: expected between 0"),
        (("--seed", "9" * 30), "expected between 0 and 2^63 - 1"),
        (("--device", "nonsense"), "--device nonsense"),
        (("--vehicle", "crazyflie"), "--vehicle crazyflie: is a quadrotor, --system says cartpole"),
        (("--vehicle", "zeppelin"), "--vehicle zeppelin"),
    ],
)
def test_bad_options_are_refused(refused, cart, options, words):
    assert words in refused("evaluate", *cart, *options)


@pytest.mark.parametrize("options", [("--set", "slalom"), ("--set", "nowhere.csv")])
def test_an_unknown_set_is_refused(refused, quadrotor_file, options):
    assert options[1] in refused("evaluate", "--policy", quadrotor_file, *options)


def test_bad_checkpoints_are_refused(refused, cartpole_file, tmp_path):
    assert "no such file" in refused("evaluate", "--policy", tmp_path / "none.safetensors")
    assert "trained for cartpole, not for quadrotor" in refused("evaluate", "--policy", cartpole_file)
    torch.save({"weights": torch.zeros(2)}, tmp_path / "policy.pt")
    assert "pickles" in refused("evaluate", "--policy", tmp_path / "policy.pt")


def test_results_are_not_overwritten_unless_asked(call, refused, cart, tmp_path):
    out = tmp_path / "result.json"
    out.write_text("mine")
    assert "exists; name another file or add --overwrite" in refused("evaluate", *cart, "--out", out)
    assert out.read_text() == "mine"
    assert "is a folder" in refused("evaluate", *cart, "--out", tmp_path)
    assert "there is no folder" in refused("evaluate", *cart, "--out", tmp_path / "none" / "a.json")
    assert call("evaluate", *cart, "--episodes", 1, "--out", out, "--overwrite").status == 0
    assert json.loads(out.read_text())["n"] == 1


def test_a_full_disk_is_one_line_and_leaves_nothing(refused, cart, tmp_path, monkeypatch):
    def full(path, *args, **kwargs):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", full)
    line = refused("evaluate", *cart, "--episodes", 1, "--out", tmp_path / "a.json")
    assert "No space left on device; nothing half-written is kept" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_as_a_process_it_ends_the_same(cartpole_file):
    start = [sys.executable, "-m", "adapt.evaluate", "--system", "cartpole", "--episodes", "2", "--policy"]
    good = subprocess.run([*start, cartpole_file], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (good.returncode, good.stderr) == (0, "")
    bad = subprocess.run([*start, "none"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert bad.returncode == 2
    assert bad.stderr == "evaluate: policy none: no such file\n"


def test_controllers_of_several_horizons_can_fly_the_same_paths(call, quadrotor_file, tmp_path):
    out, base = tmp_path / "result.json", ("--policy", quadrotor_file, "--episodes", 2)
    assert call("evaluate", *base, "--episodes-horizon", 15, "--out", out).status == 0
    policy = load_policy(quadrotor_file)
    paths = replace(policy.task, horizon=15).episodes(2, "test", 0)
    wanted = evaluate(as_actor(policy.network), make_dynamics("quadrotor"), policy.task, paths)
    assert json.loads(out.read_text())["table"]["error"] == wanted.table.error.tolist()


def test_paths_that_end_before_the_horizon_are_refused(refused, quadrotor_file):
    line = refused("evaluate", "--policy", quadrotor_file, "--episodes-horizon", 9)
    assert "--episodes-horizon 9: expected at least 10, the horizon of the controller" in line


def test_the_gradient_is_measured_where_there_is_one(call, refused, cart, rough_cartpole, tmp_path):
    out = tmp_path / "result.json"
    assert call("evaluate", *cart, "--episodes", 1, "--gradient", "--out", out).status == 0
    task, found = rough_cartpole.task, json.loads(out.read_text())
    episodes = task.episodes(200, "validation", 0)
    wanted = gradient_statistics(rough_cartpole.network, make_dynamics("cartpole"), task, episodes)
    assert (found["gradient_norm"], found["gradient_variance"]) == (wanted["norm"], wanted["variance"])
    assert "--gradient: is that of apg, mpc has none" in refused("evaluate", "--method", "mpc", "--gradient")
