"""`python -m adapt.pretrain --method …`, `--policy` and `--residual`: other methods, and going on with a policy."""

import csv
import json

import pytest
import torch

from adapt import training, training_log
from adapt.residual_kinds import make_residual
from envs import make_dynamics
from policies.checkpoints import load_policy

TINY = {
    "ppo": ("--samples", 600, "--batch", 20, "--width", 8, "--every", 1000),
    "pets": ("--samples", 60, "--width", 8, "--every", 1000),
}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """One short validation flight, no TensorBoard, little fitting."""
    from dataclasses import replace

    from policies import pets

    whole = training.validate
    short = {"steps": 10}
    monkeypatch.setattr(
        training, "validate", lambda actor, dynamics, task, n: whole(actor, dynamics, replace(task, **short), n=1)
    )
    monkeypatch.setattr(training_log, "_tensorboard", lambda folder: None)
    small = replace(pets.PRESETS["cartpole"], rounds=2, fit=replace(pets.Config().fit, steps=20))
    monkeypatch.setitem(pets.PRESETS, "cartpole", small)


def trained(call, folder, method, *options):
    answer = call("pretrain", "--system", "cartpole", "--method", method, *TINY[method], "--out", folder, *options)
    assert answer.status == 0, answer.errors
    return load_policy(folder / "policy.safetensors", method=method)


def weights(policy):
    return policy.network.state_dict()


def same(one, other):
    return all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize("method", TINY)
def test_a_method_trains_within_its_budget_and_says_how(call, tmp_path, method):
    policy = trained(call, tmp_path / "run", method, "--seed", 3)
    budget = TINY[method][1]
    assert 0 < policy.info["samples"] <= budget
    assert policy.info["method"] == method
    assert policy.info["seed"] == 3
    said = policy.info["command"]
    assert said.startswith(f"python -m adapt.pretrain --system cartpole --method {method} --seed 3 --samples {budget}")
    assert "--out" not in said
    with (tmp_path / "run" / "log.csv").open() as file:
        assert int(list(csv.DictReader(file))[-1]["samples"]) == policy.info["samples"]
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["samples"] == budget


@pytest.mark.parametrize("method", TINY)
def test_the_same_seed_trains_the_same_and_another_seed_does_not(call, tmp_path, method):
    one, two, other = (trained(call, tmp_path / str(i), method, "--seed", seed) for i, seed in enumerate((0, 0, 1)))
    assert same(weights(one), weights(two))
    assert not same(weights(one), weights(other))


@pytest.mark.parametrize("method", TINY)
def test_training_goes_on_in_a_target_and_the_last_policy_is_kept(call, tmp_path, method, monkeypatch):
    start = trained(call, tmp_path / "source", method)
    worse = {"mean": 9.0, "std": 0.0, "success": 0.0, "n": 1}
    monkeypatch.setattr(training, "validate", lambda *_: worse)
    path = tmp_path / "source" / "policy.safetensors"
    options = ("--policy", path, "--target", "push=1", "--samples", 40, "--out", tmp_path / "a")
    answer = call("pretrain", "--system", "cartpole", "--method", method, *options)
    assert answer.status == 0, answer.errors
    tuned = load_policy(tmp_path / "a" / "policy.safetensors", method=method)
    assert 0 < tuned.info["samples"] <= 40
    assert not same(weights(start), weights(tuned))
    assert tuned.info["trained_in"] == "push=1"
    assert tuned.info["finetuned"] is True
    assert start.info["finetuned"] is False


def test_a_policy_can_be_trained_in_a_model_with_a_residual(call, tmp_path):
    residual = make_residual(make_dynamics("cartpole"))
    residual.bias[0] = 2.0
    residual.save(tmp_path / "residual.safetensors")
    inside = trained(call, tmp_path / "a", "ppo", "--residual", tmp_path / "residual.safetensors")
    plain = trained(call, tmp_path / "b", "ppo")
    assert inside.info["trained_in"] == "model + residual"
    assert not same(weights(inside), weights(plain))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--method", "mpc"), "--method mpc: expected one of apg, apg-pixels, ppo, ppo-pixels, pets"),
        (("--method", "ppo", "--samples", "0"), "--samples 0: expected at least 1"),
        (("--method", "pets", "--samples", "0"), "--samples 0: expected at least 1"),
        (("--method", "apg", "--samples", "100"), "--samples: apg has no such setting"),
        (("--method", "pets", "--curriculum", "0.1"), "--curriculum: pets has no such setting"),
        (("--method", "ppo", "--preset", "paper"), "--preset paper: expected one of"),
        (("--residual", "a.safetensors", "--target", "push=1"), "leave --target out"),
        (("--residual", "none.safetensors"), "none.safetensors: can't read a residual"),
        (("--policy", "none.safetensors"), "policy none.safetensors: no such file"),
        (("--method", "ppo", "--policy", "cartpole.safetensors"), "no such file"),
        (("--policy", "a.safetensors", "--width", "8"), "--width: is that of the policy"),
    ],
)
def test_bad_options_are_refused_and_nothing_is_written(refused, tmp_path, options, words):
    out = tmp_path / "run"
    assert words in refused("pretrain", "--system", "cartpole", *options, "--out", out)
    assert not out.exists()


def test_a_policy_of_another_method_is_not_gone_on_with(refused, cartpole_file, tmp_path):
    line = refused(
        *("pretrain", "--system", "cartpole", "--method", "ppo", "--policy", cartpole_file, "--out", tmp_path / "run")
    )
    assert "was made by the method 'apg', expected 'ppo'" in line
