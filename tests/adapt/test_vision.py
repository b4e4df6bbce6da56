"""`python -m adapt.vision`: a policy from pictures is trained within its budget, flown, and shown."""

import contextlib
import csv
import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from adapt import training, training_log, vision, vision_pictures
from envs import make_dynamics
from envs.camera import Camera
from policies.checkpoints import load_policy

SMALL = ("--camera", "height=24", "--camera", "width=48", "--camera", "scale=9")
TINY = ("--samples", 60, "--updates", 6, "--episodes", 2, *SMALL)
FILES = {
    "config.json", "metrics.json", "policy.safetensors", "log.csv", "training.pt",
    "learning.png", "frames.png", "saliency.png", "balance.mp4",
}  # fmt: skip


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """One validation flight, no TensorBoard."""
    whole = training.validate
    monkeypatch.setattr(training, "validate", lambda actor, dynamics, task, n: whole(actor, dynamics, task, n=1))
    monkeypatch.setattr(training_log, "_tensorboard", lambda folder: None)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What a run of the command printed, and its folder."""
    folder, out = tmp_path_factory.mktemp("vision") / "run", io.StringIO()
    settings = {"samples": 60, "updates": 6, "episodes": 2, "seed": 3, "camera": SMALL[1::2], "out": str(folder)}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(training_log, "_tensorboard", lambda folder: None)
        vision.main(vision.Options(**settings))
    return out.getvalue(), folder


def test_it_leaves_a_policy_numbers_pictures_and_a_film(made):
    out, folder = made
    assert {path.name for path in folder.iterdir()} == FILES
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["samples"] == 60
    assert metrics["training"]["samples"] == 60
    assert metrics["n"] == 2
    assert metrics["camera"]["height"] == 24
    assert metrics["seed"] == 3
    assert 0 < metrics["steps"] <= 250
    assert 0 < metrics["median_ms"] <= metrics["p99_ms"]
    assert "full episodes" in out
    for name in ("learning", "frames", "saliency"):
        picture = cv2.imread(str(folder / f"{name}.png"))
        assert min(picture.shape[:2]) > 200
        assert picture.std() > 5


def test_its_policy_is_the_last_one_and_knows_its_camera(made):
    _, folder = made
    policy = load_policy(folder / "policy.safetensors", method="apg-pixels")
    assert policy.task.camera.shape == (12, 24, 48)
    assert policy.info["update"] == 6
    last = torch.load(folder / "training.pt", weights_only=True)["network"]
    assert all(torch.equal(last[name], value) for name, value in policy.network.state_dict().items())


def test_the_film_plays_in_real_time(made):
    film = cv2.VideoCapture(str(made[1] / "balance.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(20)
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 5


def test_a_run_is_continued_and_nothing_is_overwritten_unasked(made, call, refused):
    _, folder = made
    line = refused("vision", *TINY, "--seed", 3, "--out", folder)
    assert "already holds results; name another folder or add --overwrite" in line
    with (folder / "log.csv").open() as file:
        before = list(csv.DictReader(file))
    assert call("vision", *TINY, "--seed", 3, "--out", folder, "--resume").status == 0
    with (folder / "log.csv").open() as file:
        assert list(csv.DictReader(file)) == before


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--method", "pets"), "--method pets: expected one of apg, ppo, mpc"),
        (("--samples", 0), "--samples 0: expected at least 1"),
        (("--episodes", 0), "--episodes 0: expected at least 1"),
        (("--camera", "focus=3"), "--camera focus: expected NAME=VALUE with one of height, width, scale"),
        (("--camera", "height=2"), "camera: height is 2, expected at least 8"),
        (("--camera", "height=2.5"), "camera: height is '2.5', expected a number"),
        (("--target", "brightness=no"), "--target brightness=no: camera: brightness is 'no', expected a number"),
        (("--method", "mpc", "--resume"), "--resume: mpc has nothing to continue"),
        (("--method", "ppo", "--updates", 3), "--updates: ppo has no such setting"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_written(refused, tmp_path, options, line):
    assert line in refused("vision", "--out", tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()


def test_saliency_is_the_change_of_the_action_for_a_change_of_a_pixel(made):
    policy = load_policy(made[1] / "policy.safetensors", method="apg-pixels")
    actor, task = policy.actor(), policy.task
    states = torch.cumsum(0.01 * torch.randn(6, 4, generator=torch.Generator().manual_seed(0)), 0)
    seen = vision_pictures.stacks(task, make_dynamics("cartpole"), states)[5]
    strength = vision_pictures.saliency(actor, seen)
    assert strength.shape == (4, 24, 48)
    frame, row, column = np.unravel_index(int(strength.argmax()), strength.shape)
    network = policy.network

    def action(levels):
        with torch.no_grad():
            hidden = network.encoder.changes(levels.unsqueeze(0))
            for layer in network.encoder.convolutions:
                hidden = torch.relu(layer(hidden))
            return torch.tanh(network.head(torch.relu(network.encoder.layer(hidden.flatten(1)))))[0, 0]

    total = 0.0
    for colour in range(3):
        step = torch.zeros_like(seen, dtype=torch.float32)
        step[3 * frame + colour, row, column] = 0.05
        total += abs(float(action(seen.float() + step) - action(seen.float() - step))) / 0.1
    assert total == pytest.approx(float(strength.max()), rel=0.05)


def test_the_stack_of_a_flight_begins_with_its_first_picture(made):
    policy = load_policy(made[1] / "policy.safetensors", method="apg-pixels")
    states = torch.cumsum(0.01 * torch.ones(6, 4), 0)
    seen = vision_pictures.stacks(policy.task, make_dynamics("cartpole"), states)
    assert all(torch.equal(seen[0, :3], seen[0, 3 * k : 3 * k + 3]) for k in range(4))
    assert all(torch.equal(seen[5, 3 * k : 3 * k + 3], seen[5 - k, :3]) for k in range(4))


def test_any_number_of_pictures_is_shown_and_a_flight_may_be_short():
    task = load_task()
    states = torch.cumsum(0.01 * torch.ones(9, 4), 0)
    six = replace(task, camera=Camera(height=24, width=48, scale=9.0, frames=6))
    seen = vision_pictures.stacks(six, make_dynamics("cartpole"), states)
    assert all(torch.equal(seen[8, 3 * k : 3 * k + 3], seen[8 - k, :3]) for k in range(6))
    assert vision_pictures.stacks(six, make_dynamics("cartpole"), states[:2]).shape[0] == 2


def test_steps_survived_count_to_the_end_of_each_flight():
    class Result:
        episodes = None
        states = torch.zeros(2, 11, 4)

    Result.states[1, 4:, 2] = 1.0  # fell in the fourth step
    task = load_task()
    assert vision.steps_survived(task, Result) == {"steps": (10 + 3) / 2}


def load_task():
    from envs import make_task

    return make_task("cartpole")
