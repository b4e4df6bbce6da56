"""`python -m adapt.marker`: a residual that sees which pole is mounted learns both, one that doesn't learns neither."""

import contextlib
import io
import json
import sys
from dataclasses import replace

import cv2
import matplotlib
import pytest
import torch

from adapt import command, marker, marker_report
from adapt.picture_features import HUES
from adapt.prediction import prediction_error
from adapt.residual import fit_residual
from envs.drawing import draw
from envs.dynamics import Dynamics
from policies.checkpoints import load_policy, pretrained, save_policy

MASSES = (0.2, 3.0)
SAMPLES = 400


@pytest.fixture(scope="module")
def policy():
    return load_policy("cartpole")


@pytest.fixture(scope="module")
def targets(policy):
    return [marker.mounted(policy.task, mass, tip) for mass, tip in zip(MASSES, marker.TIPS.values(), strict=True)]


@pytest.fixture(scope="module")
def recordings(policy, targets):
    """What is learned from, and what is predicted."""
    flown = marker.record(policy, targets, SAMPLES, "train", 7, 0.2)
    return flown, marker.record(policy, targets, SAMPLES, "validation", 8, 0.2)


@pytest.fixture(scope="module")
def residuals(policy, recordings):
    data = marker.contexts(recordings[0], MASSES)
    source = Dynamics(policy.task.system)
    return {name: fit_residual(data[name], source, "linear+network")[0] for name in marker.RESIDUALS}


@pytest.fixture(scope="module")
def finished(policy, tmp_path_factory):
    """The folder of a small run with short test flights, and what the command printed."""
    folder, printed = tmp_path_factory.mktemp("marker") / "run", io.StringIO()
    path = folder.with_name("policy.safetensors")
    save_policy(path, policy.network, replace(policy.task, steps=30), policy.info)
    options = ("--samples", "81", "--updates", "2", "--policy", str(path), "--out", str(folder))
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", ["marker", *options])
        command.run("adapt.marker", marker.Options, marker.main)
    return folder, printed.getvalue()


def errors(residuals, recording):
    data = marker.contexts(recording, MASSES)
    return {name: prediction_error(residual, data[name])["acceleration"] for name, residual in residuals.items()}


def read(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_the_targets_differ_in_mass_and_in_the_tip_and_in_nothing_else(policy, targets):
    for target, mass, tip in zip(targets, MASSES, marker.TIPS.values(), strict=True):
        assert target.dynamics.system == replace(policy.task.system, pole_mass=mass)
        assert target.camera.tip_colour == tip
    assert replace(targets[0].camera, tip_colour=targets[1].camera.tip_colour) == targets[1].camera


def test_half_of_the_transitions_are_flown_with_each_pole_in_turn(recordings):
    for recording in recordings:
        assert torch.bincount(recording.pole).tolist() == [SAMPLES // 2, SAMPLES // 2]
        flights = recording.transitions.trajectory
        assert (flights.diff() >= 0).all()
        assert torch.equal(flights % 2, recording.pole)
        assert len(flights.unique()) >= marker.FLIGHTS


def test_each_transition_is_one_of_the_target_whose_marker_its_picture_shows(policy, targets, recordings):
    flown = recordings[0]
    for place, target in enumerate(targets):
        rows = flown.pole == place
        part = flown.transitions.select(rows)
        torch.testing.assert_close(target.dynamics(part.state, part.action), part.next_state)
        assert torch.equal(flown.pictures[rows], draw(target.camera, policy.task.system, part.state))


def test_the_same_seed_gives_the_same_starts_and_noise_and_another_seed_others(policy, targets):
    one, same, other = (marker.record(policy, targets, 80, "train", seed, 0.2).transitions for seed in (1, 1, 2))
    assert torch.equal(one.state, same.state) and torch.equal(one.action, same.action)
    assert not torch.equal(one.state[0], other.state[0])
    with torch.no_grad():
        noise = [part.action - policy.network(part.state, part.state[:, None, :0])[:, 0] for part in (one, other)]
    assert noise[0].std() > 0.1 and (noise[0] - noise[1]).std() > 0.1


def test_the_residual_that_sees_pictures_is_told_nothing_else(recordings):
    told = marker.contexts(recordings[0], MASSES)
    assert told["context_free"].context is None
    assert told["conditioned"].context_names == HUES
    assert told["true_mass"].context.squeeze(-1).unique().tolist() == pytest.approx(sorted(MASSES))


def test_what_is_seen_takes_away_nine_tenths_of_the_error_that_no_context_leaves(residuals, recordings):
    found = errors(residuals, recordings[1])
    assert found["conditioned"] < 0.1 * found["context_free"]
    assert found["conditioned"] < 3 * found["true_mass"]


def test_without_context_both_poles_are_predicted_wrong(residuals, recordings):
    """What is learned lies between the two: with either pole it misses what one that sees it doesn't."""
    unseen = marker.contexts(recordings[1], MASSES)
    for place in range(2):
        rows = recordings[1].pole == place
        free, conditioned = (
            prediction_error(residuals[name], unseen[name].select(rows))["acceleration"]
            for name in ("context_free", "conditioned")
        )
        assert conditioned < 0.1 * free


def test_with_the_markers_exchanged_what_is_seen_misleads(residuals, recordings):
    unseen = marker.contexts(recordings[1], MASSES)["conditioned"]
    first, second = (unseen.context[recordings[1].pole == place].mean(0) for place in range(2))
    wrong = torch.where(recordings[1].pole.bool().unsqueeze(-1), first, second)
    right = prediction_error(residuals["conditioned"], unseen)["acceleration"]
    assert prediction_error(residuals["conditioned"], replace(unseen, context=wrong))["acceleration"] > 30 * right


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_thousand_transitions_reach_a_tenth_in_every_group(policy, targets, seed):
    flown = marker.record(policy, targets, 1000, "train", 1_000_000 + seed, 0.2)
    unseen = marker.record(policy, targets, 1000, "validation", seed, 0.2)
    source, data = Dynamics(policy.task.system), marker.contexts(flown, MASSES)
    dynamics = {name: fit_residual(data[name], source, seed=seed)[0] for name in marker.RESIDUALS}
    figures = marker.one_step({"model": source, **dynamics}, marker.contexts(unseen, MASSES), unseen.pole)
    assert figures["ratio"] < 0.1


def test_it_leaves_what_it_promises_and_nothing_else(finished):
    assert {path.name for path in finished[0].iterdir()} == set(marker.OUTPUTS)


def test_the_metrics_hold_errors_ratios_and_flights_of_either_pole(finished):
    metrics = read(finished[0])
    assert metrics["samples"] == 81 and metrics["pole_mass"] == {"light": 0.2, "heavy": 3.0}
    assert set(metrics["prediction"]) == {"model", *marker.RESIDUALS}
    for pole in marker.TIPS:
        assert set(metrics["flights"][pole]) == {"zero_shot", "context_free", "conditioned"}
        assert set(metrics["prediction_by_pole"][pole]) == {"model", *marker.RESIDUALS}
        assert set(metrics["picture"][pole]["mean"]) == set(HUES)
    free, conditioned = (metrics["prediction"][name] for name in ("context_free", "conditioned"))
    assert metrics["ratios"] == pytest.approx({row: conditioned[row] / free[row] for row in free})
    assert metrics["ratio"] == max(metrics["ratios"].values())


def test_the_error_with_both_poles_is_made_of_those_with_each(finished):
    metrics = read(finished[0])
    for name, error in metrics["prediction"].items():
        each = [metrics["prediction_by_pole"][pole][name]["velocity"] ** 2 for pole in marker.TIPS]
        assert error["velocity"] ** 2 == pytest.approx(sum(each) / 2)
    light, heavy = (metrics["prediction_by_pole"][pole]["model"]["velocity"] for pole in marker.TIPS)
    assert heavy > 5 * light  # the model has 0.1 kg


def test_the_table_shows_every_pole_and_every_residual(finished):
    said = finished[1]
    for text in (*marker_report.NAMES.values(), "light pole, 0.2 kg", "heavy pole, 3 kg", "mean cart speed [m/s]"):
        assert text in said


def test_the_options_and_the_versions_are_written_down(finished):
    config = json.loads((finished[0] / "config.json").read_text())
    assert config["options"]["samples"] == 81 and config["seed"] == 0 and "torch" in config


def test_the_picture_can_be_read_and_shows_the_markers(finished):
    picture = cv2.imread(str(finished[0] / "marker.png")).astype(int)
    assert min(picture.shape[:2]) > 600
    blue, green, red = picture[..., 0], picture[..., 1], picture[..., 2]
    assert ((red > 190) & (green < 70) & (blue < 70)).any() and ((blue > 190) & (green < 90) & (red < 70)).any()


def test_each_bar_is_as_long_as_the_error_that_it_shows(finished):
    metrics = read(finished[0])
    with matplotlib.rc_context():
        figure = marker_report.draw(metrics, [torch.zeros(3, 48, 144, dtype=torch.uint8)] * 2)
    for axes, pole in zip(figure.axes[1::2], marker.TIPS, strict=True):
        shown = [bar.get_width() for bar in axes.patches]
        table = metrics["prediction_by_pole"][pole]
        assert shown == [table[name]["acceleration"] for name in ("model", "context_free", "conditioned")]


def test_flights_that_fail_are_told():
    summary = {"mean": 0.01, "std": 0.002, "success": 0.5, "n": 50}
    assert marker_report._score(summary) == "0.0100 ± 0.0020, 50% succeed"
    assert marker_report._score({**summary, "success": 0.0}) == "all fail"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--samples", 39), "--samples 39: expected at least 40"),
        (("--light", 3), "--light 3 --heavy 3"),
        (("--light", "nan"), "--light nan"),
        (("--light", -1), "--light -1"),
        (("--heavy", "inf"), "--heavy inf"),
        (("--exploration", 1.5), "--exploration 1.5"),
        (("--updates", 0), "--updates 0"),
        (("--seed", -1), "--seed -1"),
        (("--threads", 0), "--threads 0"),
        (("--policy", "missing.safetensors"), "no such file"),
    ],
)
def test_bad_options_end_in_one_line_and_leave_nothing(refused, contents, tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused("marker", *options)
    assert not contents(tmp_path)


def test_a_policy_of_another_robot_is_refused(refused, tmp_path):
    assert "quadrotor" in refused("marker", "--policy", pretrained("quadrotor"), "--out", tmp_path / "run")


def test_a_folder_in_use_is_left_alone(refused, contents, finished):
    before = contents(finished[0])
    assert "already holds results" in refused("marker", "--out", finished[0])
    assert contents(finished[0]) == before
