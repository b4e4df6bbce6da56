"""`python -m adapt.pretrain --mode … --horizon …`: what is asked for is trained, said, resumed, gone on with."""

import json
from dataclasses import replace

import pytest
import torch

from adapt import training
from envs import make_system
from policies.checkpoints import load_policy

TINY = ("--system", "cartpole", "--updates", 4, "--every", 2, "--batch", 4, "--width", 8)
pytestmark = pytest.mark.usefixtures("few_validations")


def trained(call, folder, *options):
    answer = call("pretrain", *TINY, "--out", folder, *options)
    assert answer.status == 0, answer.errors
    return load_policy(folder / "policy.safetensors", method=None)


@pytest.mark.parametrize("mode", ["concurrent", "autoregressive", "recurrent"])
def test_the_mode_and_the_horizon_are_those_that_were_asked_for(call, tmp_path, mode):
    policy = trained(call, tmp_path / "run", "--mode", mode, "--horizon", 3)
    assert policy.network.config.mode == mode
    assert policy.network.config.horizon == policy.task.horizon == 3
    assert policy.info["command"].endswith(
        f"--horizon 3 --mode {mode} --seed 0 --updates 4 --batch 4 --width 8 --every 2"
    )
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["mode"] == mode


def test_without_being_asked_it_plans_ten_steps_at_once(call, tmp_path):
    policy = trained(call, tmp_path / "run")
    assert (policy.network.config.mode, policy.task.horizon) == ("concurrent", 10)


def test_a_run_that_was_interrupted_goes_on_with_its_memory(call, tmp_path, monkeypatch):
    options = ("--mode", "recurrent", "--horizon", 2)
    whole = trained(call, tmp_path / "whole", *options)
    saves, save = [], training._save

    def killed(run, job):
        save(run, job)
        saves.append(run.update)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "_save", killed)
        assert call("pretrain", *TINY, "--out", tmp_path / "broken", *options).status == 130
    assert saves == [2]
    resumed = trained(call, tmp_path / "broken", *options, "--resume")
    for name, value in whole.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[name], value)
    flights = [torch.load(tmp_path / name / "training.pt", weights_only=True)["flight"] for name in ("whole", "broken")]
    assert torch.equal(flights[0]["hidden"], flights[1]["hidden"])


def test_a_run_is_resumed_only_in_its_mode_and_with_its_horizon(call, refused, tmp_path):
    trained(call, tmp_path / "run", "--mode", "autoregressive")
    again = ("pretrain", *TINY, "--out", tmp_path / "run", "--resume")
    assert "another mode" in refused(*again)
    assert "another horizon" in refused(*again, "--mode", "autoregressive", "--horizon", 9)


@pytest.mark.parametrize("mode", ["autoregressive", "recurrent"])
def test_a_policy_is_gone_on_with_in_its_own_mode_and_with_its_own_horizon(call, tmp_path, mode):
    start = trained(call, tmp_path / "source", "--mode", mode, "--horizon", 4)
    options = ("--policy", tmp_path / "source" / "policy.safetensors", "--target", "push=1")
    answer = call("pretrain", *TINY[:-2], *options, "--out", tmp_path / "target")
    assert answer.status == 0, answer.errors
    tuned = load_policy(tmp_path / "target" / "policy.safetensors", make_system("cartpole"))
    assert tuned.network.config == start.network.config
    assert tuned.task == start.task
    assert json.loads((tmp_path / "target" / "config.json").read_text())["config"]["mode"] == mode
    assert not torch.equal(tuned.network.head.weight, start.network.head.weight)


@pytest.mark.parametrize("method", ["ppo", "pets"])
def test_other_methods_have_a_horizon_too(call, tmp_path, monkeypatch, method):
    from policies import pets

    small = replace(pets.PRESETS["cartpole"], rounds=2, fit=replace(pets.Config().fit, steps=5))
    monkeypatch.setitem(pets.PRESETS, "cartpole", small)
    options = ("--system", "cartpole", "--method", method, "--samples", 60, "--width", 8, "--every", 1000)
    answer = call(
        "pretrain", *options, *(("--batch", 20) if method == "ppo" else ()), "--horizon", 2, "--out", tmp_path
    )
    assert answer.status == 0, answer.errors
    assert load_policy(tmp_path / "policy.safetensors", method=method).task.horizon == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--mode", "chained"), "--mode chained: expected one of concurrent, autoregressive, recurrent"),
        (("--horizon", "0"), "--horizon 0: expected at least 1"),
        (("--horizon", "ten"), "ten"),
        (("--method", "ppo", "--mode", "recurrent"), "--mode: ppo has no such setting; leave it out"),
        (("--policy", "a.safetensors", "--mode", "recurrent"), "--mode: is that of the policy that --policy names"),
        (("--policy", "a.safetensors", "--horizon", "5"), "--horizon: is that of the policy that --policy names"),
    ],
)
def test_bad_options_are_refused_and_nothing_is_written(refused, tmp_path, options, words):
    assert words in refused("pretrain", "--system", "cartpole", *options, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
