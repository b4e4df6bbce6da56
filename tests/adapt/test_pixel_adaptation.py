"""Few-shot adaptation of a policy that sees pictures."""

import json
from dataclasses import replace

import pytest
import torch

from adapt import adapt, adaptation
from adapt.finetuning import finetune, finetuning
from adapt.flying import film_transitions, filmed
from envs import InputError, make_dynamics, make_task, parse_target
from envs.camera import Camera
from policies import apg_pixels
from policies.checkpoints import Policy, load_policy, save_policy
from policies.modes import plan_cost

TASK = make_task("cartpole", camera=Camera(height=16, width=32, scale=6.0), steps=40)
TARGET = "pole_mass=x3 brightness=0.8"


@pytest.fixture(scope="module")
def rough():
    """A policy from pictures after a few updates."""
    config = replace(apg_pixels.PRESETS["cartpole"], samples=200, updates=60, batch=16, episodes=20)
    dynamics, banks = make_dynamics("cartpole"), [TASK.episodes(20, "train", 0)]
    run = apg_pixels.begin(dynamics, TASK, banks, config, 0)
    list(apg_pixels.train(run, dynamics, TASK, banks, config))
    return Policy(run.network, TASK, {}, "apg-pixels")


def target_of(policy):
    domain = parse_target(TARGET, policy.task.system)
    return make_dynamics(policy.task.system, domain), domain.seen(policy.task)


def test_footage_of_a_target_becomes_transitions_in_order_of_time(rough):
    target, seen = target_of(rough)
    footage = filmed(rough, target, seen, seen.episodes(20, "train", 1), 105, 0.2)
    transitions = film_transitions(footage, seen.system)
    assert len(footage) == len(transitions) == 105
    assert (transitions.trajectory.diff() >= 0).all()
    together = transitions.trajectory[1:] == transitions.trajectory[:-1]
    assert torch.equal(transitions.state[1:][together], transitions.next_state[:-1][together])
    torch.testing.assert_close(target(transitions.state, transitions.action), transitions.next_state)
    assert int(footage.frames.max()) <= round(0.8 * 255)  # the target's picture


def test_it_learns_the_difference_and_tunes_a_policy_of_the_same_method(rough):
    target, seen = target_of(rough)
    config = replace(finetuning(rough), updates=5, batch=16)
    before = {name: value.clone() for name, value in rough.network.state_dict().items()}
    result = adapt(
        rough, target, samples=200, exploration=0.2, config=config, seen=seen, oracle=True, rounds=2, gate=False
    )
    assert result.policy.method == "apg-pixels"
    assert set(result.evaluations) == {"source", "zero_shot", "few_shot", "oracle"}
    assert result.prediction["model + residual"]["velocity"] < 0.3 * result.prediction["model"]["velocity"]
    assert len(result.history) == 5
    assert len(result.transitions) == 200
    after = rough.network.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert not all(torch.equal(value, before[name]) for name, value in result.policy.network.state_dict().items())


def test_the_target_is_seen_as_it_looks_there_and_the_source_as_it_looks_in_the_model(rough, monkeypatch):
    target, seen = target_of(rough)
    shown, whole = [], adaptation.evaluate

    def noted(actor, dynamics, task, episodes):
        shown.append((dynamics is target, task.camera.brightness))
        return whole(actor, dynamics, replace(task, steps=2), episodes[:2])

    monkeypatch.setattr(adaptation, "evaluate", noted)
    adapt(
        rough,
        target,
        samples=60,
        config=replace(finetuning(rough), updates=3),
        seen=seen,
        oracle=True,
        rounds=1,
        gate=False,
    )
    assert shown == [(False, 1.0), (True, 0.8), (True, 0.8), (True, 0.8)]


def test_few_transitions_are_flown_in_as_many_rounds_as_they_last_for(rough):
    target, seen = target_of(rough)
    result = adapt(rough, target, samples=25, config=replace(finetuning(rough), updates=3), seen=seen)
    assert len(result.transitions) == 25


def test_fine_tuning_lowers_the_cost_of_its_plans_in_the_target(rough):
    target, seen = target_of(rough)
    footage = filmed(rough, target, seen, seen.episodes(20, "train", 1), 200, 0.2)
    config = replace(finetuning(rough), updates=80, batch=32, learning_rate=3e-3)
    tuned, history = finetune(rough, target, config, 0, footage=footage)
    with torch.no_grad():
        plans = [policy.network(footage.pixels(torch.arange(200))) for policy in (rough, tuned)]
    reference = seen.reference(None, None, footage.state)
    before, after = (plan_cost(target, seen, footage.state, plan, reference).mean() for plan in plans)
    assert after < 0.8 * before
    assert len(history) == 80


def test_pictures_can_not_be_had_from_recorded_transitions(rough):
    with pytest.raises(InputError, match="a policy that sees pictures learns from them, and has to fly in the target"):
        adapt(rough, samples=20)


@pytest.fixture
def checkpoint(rough, tmp_path):
    path = tmp_path / "image.safetensors"
    save_policy(path, rough.network, rough.task, {}, rough.method)
    return path


def test_the_command_adapts_it_and_writes_everything(call, checkpoint, tmp_path):
    options = (
        "--system",
        "cartpole",
        "--pixels",
        "--policy",
        checkpoint,
        "--samples",
        60,
        "--updates",
        3,
        "--rounds",
        2,
    )
    answer = call("fewshot", *options, *(f"--target={item}" for item in TARGET.split()), "--out", tmp_path / "run")
    assert answer.status == 0, answer.errors
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written >= {"metrics.json", "policy.safetensors", "residual.safetensors", "transitions.csv", "flight.png"}
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["target"] == TARGET
    assert metrics["samples"] == 60
    assert load_policy(tmp_path / "run" / "policy.safetensors", method="apg-pixels").task == TASK


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--system", "quadrotor", "--pixels"), "--system quadrotor: can't be drawn, so no policy can see it"),
        (("--system", "cartpole", "--target", "blur=2"), "--target blur=2: changes the picture, but this policy sees"),
        (("--system", "cartpole", "--pixels", "--transitions", "t.csv"), "--pixels: learns from pictures"),
        (("--system", "cartpole", "--rounds", "0"), "--rounds 0: expected at least 1"),
        (
            ("--system", "cartpole", "--samples", "30", "--rounds", "4"),
            "--rounds 4: expected at least 1, and at least 10",
        ),
        (("--system", "cartpole", "--pixels", "--target", "height=64"), "cartpole has no 'height'"),
    ],
)
def test_what_makes_no_sense_is_refused(refused, options, line):
    assert line in refused("fewshot", *options)


def test_a_policy_that_sees_the_state_is_not_taken_for_one_that_sees_pictures(refused, checkpoint):
    line = refused("fewshot", "--system", "cartpole", "--policy", checkpoint)
    assert "was made by the method 'apg-pixels', expected 'apg'" in line


def test_it_is_flown_in_a_changed_picture(call, refused, checkpoint, tmp_path):
    options = ("--system", "cartpole", "--method", "apg-pixels", "--policy", checkpoint, "--episodes", 2)
    for target in ("pole_mass=x1.1", "brightness=0.5"):
        out = tmp_path / f"{target}.json"
        assert call("evaluate", *options, "--target", target, "--out", out).status == 0
        assert json.loads(out.read_text())["n"] == 2
