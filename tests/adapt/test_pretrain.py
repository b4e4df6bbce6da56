"""`python -m adapt.pretrain`: it trains, can be interrupted and continued exactly, and refuses what makes no sense."""

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from adapt import pretrain, training
from envs import make_dynamics, make_system
from envs.vehicles import load_vehicle
from policies import apg, compiled_dynamics, evaluate
from policies.checkpoints import load_policy
from policies.generated_code import CompilerError
from policies.networks import as_actor, network_for

ROOT = Path(__file__).parents[2]
TINY = ("--system", "cartpole", "--updates", 12, "--every", 4, "--batch", 4, "--width", 8)
FILES = {"config.json", "log.csv", "policy.safetensors", "training.pt"}
pytestmark = pytest.mark.usefixtures("few_validations")


def rows(folder):
    with (folder / "log.csv").open() as file:
        return list(csv.DictReader(file))


def trained_weights(folder):
    """Everything that training changed, but for the time it took."""
    saved = torch.load(folder / "training.pt", weights_only=True)
    return saved["network"], saved["flight"], saved["update"]


def assert_same(one, two):
    """Bit for bit the same nested tensors."""
    if isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            assert_same(one[key], two[key])
    elif isinstance(one, tuple | list):
        for a, b in zip(one, two, strict=True):
            assert_same(a, b)
    else:
        assert torch.equal(torch.as_tensor(one), torch.as_tensor(two))


def test_it_leaves_a_policy_a_log_its_settings_and_what_resumes_it(call, tmp_path):
    folder = tmp_path / "run"
    answer = call("pretrain", *TINY, "--out", folder, "--seed", 3)
    assert answer.status == 0
    assert answer.errors == []
    assert {path.name for path in folder.iterdir()} == FILES
    assert [int(row["update"]) for row in rows(folder)] == [4, 8, 12]
    named = {"update", "samples", "seconds", "cost", "gradient_norm", "threshold", "stage", "resets", "skipped"}
    assert set(rows(folder)[0]) == named | {"error", "success"}
    assert [int(row["samples"]) for row in rows(folder)] == [4 * 4, 8 * 4, 12 * 4]
    policy = load_policy(folder / "policy.safetensors", make_system("cartpole"))
    assert policy.info["seed"] == 3
    assert policy.info["update"] in (4, 8, 12)
    config = json.loads((folder / "config.json").read_text())
    assert config["options"]["seed"] == 3
    assert config["config"]["batch"] == 4
    assert torch.load(folder / "training.pt", weights_only=True)["update"] == 12
    assert f"{folder}/policy.safetensors: validation error" in answer.out


def test_the_best_policy_by_validation_is_kept(tmp_path, call, monkeypatch):
    scores = iter([(0.0, float("nan")), (0.5, 2.0), (0.5, 3.0), (1.0, 9.0), (1.0, 8.0), (0.9, 0.1)])
    monkeypatch.setattr(
        training, "validate", lambda *_: dict(zip(("success", "mean"), next(scores), strict=True)) | {"std": 0, "n": 1}
    )
    kept = []
    whole = training._keep

    def noted(*args):
        before = args[-1]
        kept.append(whole(*args) != before)
        return whole(*args)

    monkeypatch.setattr(training, "_keep", noted)
    answer = call("pretrain", *TINY, "--every", 2, "--out", tmp_path)
    assert kept == [True, True, False, True, True, False]
    info = load_policy(tmp_path / "policy.safetensors").info
    assert (info["update"], info["success"], info["validation"]) == (10, 1.0, 8.0)
    assert "validation error 8.0000 m/s, success 1.00" in answer.out


def test_a_policy_is_saved_even_if_no_validation_succeeds(call, tmp_path):
    call("pretrain", *TINY, "--updates", 2, "--out", tmp_path)
    assert float(rows(tmp_path)[0]["success"]) == 0  # what makes this test one
    assert load_policy(tmp_path / "policy.safetensors").info["success"] == 0


def test_the_same_seed_trains_the_same_policy(call, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert call("pretrain", *TINY, "--updates", 4, "--out", tmp_path / name, "--seed", seed).status == 0
    networks = [trained_weights(tmp_path / name)[0] for name in "abc"]
    assert_same(networks[0], networks[1])
    assert not torch.equal(networks[0]["head.weight"], networks[2]["head.weight"])


@pytest.mark.parametrize("update", [1, 5])
def test_ctrl_c_within_an_update_and_resume_end_where_an_uninterrupted_run_does(call, tmp_path, monkeypatch, update):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert call("pretrain", *TINY, "--out", whole).status == 0
    rate = apg.learning_rate

    def pressed(config, now):
        if now == update:
            signal.raise_signal(signal.SIGINT)
        return rate(config, now)

    with monkeypatch.context() as patch:
        patch.setattr(apg, "learning_rate", pressed)
        answer = call("pretrain", *TINY, "--out", broken)
    assert answer.status == 130
    assert answer.errors == [f"pretrain: interrupted; continue with the same options, --resume and --out {broken}"]
    assert trained_weights(broken)[2] == update + 1
    assert {path.name for path in broken.iterdir()} <= FILES
    assert call("pretrain", *TINY, "--out", broken, "--resume").status == 0
    assert_same(trained_weights(broken), trained_weights(whole))
    one, two = (load_policy(folder / "policy.safetensors") for folder in (broken, whole))
    assert_same(one.network.state_dict(), two.network.state_dict())
    assert {**one.info, "seconds": 0} == {**two.info, "seconds": 0}
    logs = [[{**row, "seconds": 0} for row in rows(folder)] for folder in (broken, whole)]
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_what_was_logged_after_the_last_save_is_done_again(call, tmp_path):
    """A run that is killed between writing its log and its state."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    call("pretrain", *TINY, "--out", whole)
    with pytest.MonkeyPatch.context() as patch:
        save = training._save
        patch.setattr(training, "_save", lambda run, *rest: die() if run.update > 4 else save(run, *rest))
        with pytest.raises(RuntimeError):
            call("pretrain", *TINY, "--out", killed)
    assert [row["update"] for row in rows(killed)] == ["4", "8"]
    assert trained_weights(killed)[2] == 4
    assert call("pretrain", *TINY, "--out", killed, "--resume").status == 0
    assert [row["error"] for row in rows(killed)] == [row["error"] for row in rows(whole)]
    assert_same(trained_weights(killed), trained_weights(whole))


def die():
    raise RuntimeError("killed")


def test_a_run_is_resumed_only_as_what_it_was(call, refused, tmp_path, contents):
    call("pretrain", *TINY, "--updates", 4, "--out", tmp_path)
    before = contents(tmp_path)
    resume = ("--resume", "--out", tmp_path)
    same = ("pretrain", *TINY, "--updates", 4, *resume)
    assert "another seed; give the same" in refused(*same, "--seed", 1)
    assert "another target" in refused(*same, "--target", "drag=0.3")
    assert "another batch" in refused(*same, "--batch", 5)
    assert "another system, vehicle" in refused(*same, "--system", "fixed_wing")
    assert contents(tmp_path) == before
    assert call(*same).status == 0  # nothing left to do


def test_there_must_be_something_to_resume(refused, tmp_path):
    assert "holds no training.pt" in refused("pretrain", *TINY, "--resume", "--out", tmp_path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half", b"not torch"])
def test_a_damaged_state_is_refused(refused, tmp_path, content):
    (tmp_path / "training.pt").write_bytes(content)
    assert "training.pt is damaged" in refused("pretrain", *TINY, "--resume", "--out", tmp_path)


@pytest.mark.parametrize("missing", ["identity", "seed", "network", "flight", "everything", "a dictionary"])
def test_a_state_that_lacks_something_is_refused(call, refused, tmp_path, missing):
    run = ("pretrain", *TINY, "--updates", 4, "--out", tmp_path)
    assert call(*run).status == 0
    saved = torch.load(tmp_path / "training.pt", weights_only=True)
    spoilt = {
        "identity": {**saved, "identity": "cartpole"},
        "seed": {**saved, "identity": {key: value for key, value in saved["identity"].items() if key != "seed"}},
        "network": {key: value for key, value in saved.items() if key != "network"},
        "flight": {**saved, "flight": None},
        "everything": {},
        "a dictionary": [1, 2],
    }
    torch.save(spoilt[missing], tmp_path / "training.pt")
    assert "training.pt is damaged or not of this command" in refused(*run, "--resume")


def test_waypoints_that_can_not_be_read_are_refused_before_anything_is_lost(refused, tmp_path, contents):
    options = ("--system", "quadrotor", "--updates", 1, "--batch", 4, "--width", 8, "--set", tmp_path / "nope.csv")
    assert "nope.csv" in refused("pretrain", *options, "--out", tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "policy.safetensors").write_text("old")
    refused("pretrain", *options, "--out", tmp_path, "--overwrite")
    assert contents(tmp_path) == {"policy.safetensors": b"old"}


def test_a_state_that_holds_code_is_refused_and_the_code_does_not_run(refused, tmp_path):
    trace = tmp_path / "ran"

    class Code:
        def __reduce__(self):
            return Path.touch, (trace,)

    torch.save({"identity": Code()}, tmp_path / "training.pt")
    assert "training.pt is damaged" in refused("pretrain", *TINY, "--resume", "--out", tmp_path)
    assert not trace.exists()


def test_it_stops_early_where_asked(call, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "validate", lambda *_: {"mean": 0.04, "success": 1.0})
    call("pretrain", *TINY, "--stop-at", 0.05, "--out", tmp_path)
    assert [row["update"] for row in rows(tmp_path)] == ["4"]


@pytest.mark.slow
def test_targets_repeat_and_combine(call, tmp_path):
    """Training in a pushed and heavier robot differs from training in either alone."""
    weights = []
    for name, targets in (("a", ["push=3"]), ("b", ["mass=x2"]), ("c", ["push=3", "mass=x2"])):
        options = [word for target in targets for word in ("--target", target)]
        assert call("pretrain", *TINY, "--updates", 4, *options, "--out", tmp_path / name).status == 0
        weights.append(trained_weights(tmp_path / name)[0]["head.weight"])
    assert not torch.equal(weights[0], weights[2])
    assert not torch.equal(weights[1], weights[2])


def test_skipped_updates_are_reported(call, tmp_path, monkeypatch):
    clip = torch.nn.utils.clip_grad_norm_
    norms = iter([float("nan"), 1.0, float("inf")])
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda *a: clip(*a) * next(norms, 1.0))
    answer = call("pretrain", *TINY, "--out", tmp_path)
    assert "2 updates were skipped because their gradient was not finite" in answer.out
    assert [row["skipped"] for row in rows(tmp_path)] == ["2", "2", "2"]


def test_the_paper_preset_and_changes_to_it():
    system = make_system("quadrotor")
    paper = pretrain.configuration(pretrain.Options(preset="paper"), system)
    assert paper == apg.PRESETS["paper"]
    changed = pretrain.configuration(pretrain.Options(preset="paper", updates=7, learning_rate=0.5), system)
    assert changed == replace(paper, updates=7, learning_rate=0.5)
    assert pretrain.configuration(pretrain.Options(curriculum=0.0), system) == replace(
        apg.PRESETS["quadrotor"], curriculum=0.0
    )


def test_the_paper_preset_runs(call, tmp_path):
    answer = call("pretrain", "--system", "cartpole", "--preset", "paper", "--updates", 3, "--out", tmp_path)
    assert answer.status == 0
    assert json.loads((tmp_path / "config.json").read_text())["config"]["optimizer"] == "sgd"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sistem", "cartpole"), "--sistem"),
        (("--updates", "many"), "many"),
        (("--system", "submarine"), "--system submarine: expected one of"),
        (("--target", "gravitas=1"), "--target gravitas=1"),
        (("--target", "pole_mass=-1"), "pole_mass is -1"),
        (("--preset", "best"), "--preset best: expected one of"),
        (("--updates", "0"), "--updates 0"),
        (("--every", "0"), "--every 0: expected at least 1"),
        (("--learning-rate", "-1"), "--learning-rate -1"),
        (("--curriculum", "2"), "--curriculum 2"),
        (("--exploration", "nan"), "--exploration nan"),
        (("--threads", "0"), "--threads 0"),
        (("--seed", "-1"), "--seed -1: expected between 0"),
        (("--seed", "9" * 30), "expected between 0 and 2^63 - 1"),
        (("--device", "nonsense"), "--device nonsense"),
        (("--vehicle", "crazyflie"), "--vehicle crazyflie: is a quadrotor"),
        (("--vehicle", "none.toml"), "none.toml"),
        (("--system", "quadrotor", "--set", "slalom"), "--set slalom"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(refused, tmp_path, options, words):
    assert words in refused("pretrain", *TINY, "--out", tmp_path / "run", *options)
    assert list(tmp_path.iterdir()) == []


def test_a_vehicle_needs_no_system_beside_it(call, tmp_path):
    small = ("--updates", 1, "--batch", 2, "--width", 8, "--out", tmp_path / "run")
    assert call("pretrain", "--vehicle", "j3cub", *small).status == 0
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert policy.task.system == load_vehicle("j3cub").system
    assert "--system fixed_wing" in policy.info["command"]


def test_training_on_exact_states_is_said_where_sensors_err(call, tmp_path):
    said = "trains on exact states: sensors err in the validation flights alone"
    noisy, exact = (call("pretrain", *TINY, "--target", f"noise={n}", "--out", tmp_path / str(n)) for n in (1, 0))
    assert said in noisy.out
    assert said not in exact.out
    weights = [torch.load(tmp_path / n / "training.pt", weights_only=True)["network"] for n in ("1", "0")]
    assert_same(*weights)


def test_a_used_folder_is_left_alone_unless_overwriting_is_asked_for(call, refused, tmp_path, contents):
    call("pretrain", *TINY, "--updates", 4, "--out", tmp_path, "--seed", 5)
    (tmp_path / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    assert "already holds results" in refused("pretrain", *TINY, "--out", tmp_path)
    assert contents(tmp_path) == before
    assert call("pretrain", *TINY, "--updates", 4, "--out", tmp_path, "--overwrite").status == 0
    assert load_policy(tmp_path / "policy.safetensors").info["seed"] == 0
    assert len(rows(tmp_path)) == 1
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_an_interrupted_overwriting_run_does_not_keep_the_policy_of_the_old_one(call, tmp_path, monkeypatch):
    call("pretrain", *TINY, "--updates", 4, "--out", tmp_path)
    monkeypatch.setattr(apg, "learning_rate", lambda *_: signal.raise_signal(signal.SIGINT) or 0.1)
    assert call("pretrain", *TINY, "--out", tmp_path, "--overwrite", "--seed", 1).status == 130
    assert not (tmp_path / "policy.safetensors").exists()
    assert not (tmp_path / "log.csv").exists()
    assert json.loads((tmp_path / "config.json").read_text())["seed"] == 1


def test_a_file_in_the_way_is_refused(refused, tmp_path):
    (tmp_path / "run").write_text("mine")
    assert "is a file, expected a folder" in refused("pretrain", *TINY, "--out", tmp_path / "run", "--overwrite")
    assert "can't be written to" in refused("pretrain", *TINY, "--out", tmp_path / "run" / "below")
    assert (tmp_path / "run").read_text() == "mine"


@pytest.mark.parametrize("when", [1, 2, 3])
def test_a_disk_that_fills_up_leaves_whole_files_only(refused, tmp_path, monkeypatch, when):
    """The first file is the policy, the second the state to resume from, the third the next state."""
    write, left = Path.write_bytes, [when]

    def fills(path, content):
        left[0] -= 1
        if left[0] < 0:
            write(path, content[: len(content) // 2])
            raise OSError(28, "No space left on device", str(path))
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", fills)
    line = refused("pretrain", *TINY, "--out", tmp_path)
    assert "No space left on device; nothing half-written is kept" in line
    assert {path.name for path in tmp_path.iterdir()} <= FILES
    assert load_policy(tmp_path / "policy.safetensors")
    if when > 1:
        assert torch.load(tmp_path / "training.pt", weights_only=True)["update"] >= 4


def test_a_compiler_that_is_missing_does_not_stop_it(call, monkeypatch, tmp_path):
    def none(source):
        raise CompilerError("no C compiler found (tried gcc)")

    monkeypatch.setattr(compiled_dynamics, "shared_library", none)
    answer = call("pretrain", *TINY, "--out", tmp_path)
    assert answer.status == 0, answer
    assert "ten times slower: no C compiler found (tried gcc)" in answer.out
    assert load_policy(tmp_path / "policy.safetensors")


def test_validation_is_not_the_test(rough_cartpole, monkeypatch):
    asked = []
    whole = evaluate.test_episodes
    monkeypatch.setattr(evaluate, "test_episodes", lambda task, n, split: asked.append(split) or whole(task, n, split))
    task = rough_cartpole.task
    training.validate(as_actor(network_for(task)), make_dynamics("cartpole"), task, 100)
    assert asked == ["validation"]


@pytest.mark.slow
def test_as_a_process_ctrl_c_ends_with_130_and_what_it_promised(tmp_path, stderr_lines):
    start = [sys.executable, "-m", "adapt.pretrain", "--system", "cartpole", "--batch", "4", "--width", "8"]
    run = subprocess.Popen(
        [*start, "--updates", "100000", "--every", "10", "--out", str(tmp_path)], cwd=ROOT, stderr=subprocess.PIPE
    )
    patience = time.monotonic() + 120
    while not (tmp_path / "training.pt").exists() and time.monotonic() < patience:
        time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    errors = stderr_lines(run.communicate(timeout=60)[1].decode())
    assert run.returncode == 130
    assert errors == [f"pretrain: interrupted; continue with the same options, --resume and --out {tmp_path}"]
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == FILES
    assert load_policy(tmp_path / "policy.safetensors")
    assert torch.load(tmp_path / "training.pt", weights_only=True)["update"] >= 10
