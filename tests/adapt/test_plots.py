"""What the pictures and the film of an adaptation show, and that they are there whole or not at all."""

import math
from dataclasses import replace
from functools import cache

import cv2
import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from adapt import plot_style, plots, residual_plot, video
from adapt.adaptation import Adaptation
from adapt.finetuning import finetune
from adapt.flying import collect
from adapt.prediction import prediction_error
from adapt.residual import FitSettings, fit_residual
from adapt.residual_kinds import make_residual
from envs import SYSTEMS, make_dynamics, make_system, make_task
from envs.dynamics import Dynamics
from envs.errors import InputError
from policies.apg import APGConfig
from policies.checkpoints import Policy
from policies.evaluate import evaluate
from policies.networks import as_actor, network_for

DRAG = 0.3  # [1/s] what the target adds
SMALL = APGConfig(updates=3, batch=4, episodes=4, curriculum=0.0)


@cache
def untrained_adaptation(name):
    """All that `adapt` returns, of a tiny untrained network and few short episodes."""
    torch.manual_seed(0)
    task, dynamics = make_task(name, steps=12), make_dynamics(name, f"drag={DRAG}")
    source = Dynamics(task.system)
    policy = Policy(network_for(task, features=4, widths=(4,)), task, {})
    transitions = collect(as_actor(policy.network), (dynamics, task, task.episodes(4, "train", 0)), 40, 0.3)
    residual, fit = fit_residual(transitions, source, settings=FitSettings(network=False))
    tuned, history = finetune(policy, residual, SMALL)
    tests = task.episodes(5, "test", 0)
    pairs = {"source": (policy, source), "zero_shot": (policy, dynamics), "few_shot": (tuned, dynamics)}
    evaluations = {n: evaluate(as_actor(p.network), d, task, tests) for n, (p, d) in pairs.items()}
    prediction = {"model": prediction_error(source, transitions)}
    prediction["model + residual"] = prediction_error(residual, transitions)
    return Adaptation(tuned, residual, transitions, fit, evaluations, prediction, history)


@pytest.fixture(scope="module", params=SYSTEMS)
def adaptation(request):
    return untrained_adaptation(request.param)


@pytest.fixture(scope="module")
def quadrotor():
    return untrained_adaptation("quadrotor")


def test_flights_of_a_plant_that_is_dead_are_drawn_as_none(adaptation, tmp_path):
    dead = {}
    for name, one in adaptation.evaluations.items():
        states = one.states if name == "source" else torch.full_like(one.states, torch.nan)
        dead[name] = replace(one, states=states, table=one.table.assign(success=name == "source"))
    paths = plots.draw_all(replace(adaptation, evaluations=dead), tmp_path)
    assert {path.name for path in paths} >= {"flight.png", "error.png"}


def flown(name, steps):
    """Task and evaluation of an untrained network in short episodes."""
    task = make_task(name, steps=steps)
    network = network_for(task, features=4, widths=(4,))
    return task, evaluate(as_actor(network), Dynamics(task.system), task, task.episodes(3, "test", 0))


def with_table(adaptation, name, **columns):
    """The same adaptation with other columns in the table of one evaluation."""
    evaluation = adaptation.evaluations[name]
    changed = replace(evaluation, table=evaluation.table.assign(**columns))
    return replace(adaptation, evaluations={**adaptation.evaluations, name: changed})


# --- files ------------------------------------------------------------------------------------------------------------


def test_every_picture_of_every_system_can_be_read_and_shows_something(adaptation, tmp_path):
    before = dict(matplotlib.rcParams)
    paths = plots.draw_all(adaptation, tmp_path)
    assert dict(matplotlib.rcParams) == before  # the style of the caller
    assert [path.name for path in paths] == ["flight.png", "error.png", "residual.png", "training.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture is not None
        assert min(picture.shape[:2]) > 300
        assert picture.std() > 10


def test_an_oracle_and_flights_that_all_fail_can_be_drawn(quadrotor):
    failed = with_table(quadrotor, "zero_shot", success=False)
    both = replace(failed, evaluations={**failed.evaluations, "oracle": quadrotor.evaluations["few_shot"]})
    assert plots.draw_training(both).axes[0].get_title("left") == "zero-shot:\nall 5 flights fail"
    axes = plots.draw_error(both).axes[0]
    said = [text.get_text() for text in axes.get_legend().get_texts()]
    assert "zero-shot: all 5 flights fail" in said
    assert any(text.startswith("oracle: ") for text in said)


@pytest.mark.parametrize(("failed", "said"), [(16, "16 of 30 fail"), (30, "all 30 flights fail")])
def test_titles_of_flights_that_fail_do_not_run_into_each_other(quadrotor, failed, said):
    table = pd.DataFrame({"error": 0.76, "success": [True] * (30 - failed) + [False] * failed})
    evaluations = {name: replace(one, table=table) for name, one in quadrotor.evaluations.items()}
    some = replace(quadrotor, evaluations=evaluations)
    with matplotlib.rc_context(plot_style.STYLE):
        figure = plots.draw_training(some)
        figure.draw_without_rendering()
    left, right = (getattr(figure.axes[0], name).get_window_extent() for name in ("_left_title", "_right_title"))
    assert said in figure.axes[0].get_title("left")
    assert left.x1 < right.x0


@pytest.mark.parametrize("decades", [0.3, 1, 2, 5, 9])
def test_numbers_along_a_logarithmic_axis_have_room(quadrotor, decades):
    steps = [row | {"gradient_norm": 10 ** (decades * i)} for i, row in enumerate(quadrotor.history[:2])]
    axes = plots.draw_training(replace(quadrotor, history=steps)).axes[1]
    low, high = axes.get_ylim()
    assert 1 <= sum(low <= tick <= high for tick in axes.get_yticks()) <= 5


def test_a_picture_that_could_not_be_saved_leaves_nothing_behind(quadrotor, tmp_path, monkeypatch):
    def broken(figure, path, **options):
        path.write_bytes(b"half of a picture")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Figure, "savefig", broken)
    with pytest.raises(OSError, match="No space left"):
        plots.draw_all(quadrotor, tmp_path)
    assert list(tmp_path.iterdir()) == []


# --- what is shown ----------------------------------------------------------------------------------------------------


def test_the_flight_shown_is_the_one_with_the_median_error_before_adaptation(quadrotor):
    errors = [0.3, math.nan, 0.1, 0.2, 9.0]  # in order: 0.1, 0.2, 0.3, 9.0 and the one without a number
    assert plots.representative(with_table(quadrotor, "zero_shot", error=errors)) == 0


@pytest.mark.parametrize("name", ["quadrotor", "cartpole"])
def test_the_mean_of_the_drawn_error_is_the_metric_of_the_table(name):
    task, evaluation = flown(name, steps=2)
    assert evaluation.table.success.all()
    np.testing.assert_allclose(plots.traces(task, evaluation)[:, 1:].mean(-1), evaluation.table.error, rtol=1e-5)


def test_the_error_is_not_drawn_behind_the_end_of_an_episode():
    task, evaluation = flown("fixed_wing", steps=12)
    episodes = torch.tensor([[50.0, 1.0, 0.0], [50.0, 0.0, 2.0]])
    states = torch.zeros(2, 13, 13)
    states[..., 0] = torch.arange(13) * torch.tensor([[12.5], [1.0]])  # the first reaches its target's plane at step 4
    evaluation = replace(evaluation, states=states, episodes=episodes)
    assert plots.last_steps(task, evaluation).tolist() == [4, 12]
    ends = np.isfinite(plots.traces(task, evaluation)).sum(-1)
    assert ends.tolist() == [5, 13]


def test_a_drag_that_was_learned_lies_on_the_diagonal_and_is_all_that_is_shown(quadrotor):
    lack, added = residual_plot.lacks(quadrotor)
    flying = (quadrotor.transitions.state + quadrotor.transitions.next_state)[:, 7:10] / 2
    np.testing.assert_allclose(lack[:, :3], -DRAG * flying, atol=2e-3)
    np.testing.assert_allclose(added, lack, atol=2e-3)
    assert residual_plot.matters(quadrotor.policy.task.system, quadrotor.transitions, lack, added) == ["vx", "vy", "vz"]


def test_a_residual_that_learned_nothing_adds_nothing(quadrotor):
    unfitted = make_residual(Dynamics(quadrotor.policy.task.system))
    lack, added = residual_plot.lacks(replace(quadrotor, residual=unfitted))
    assert np.abs(added).max() == 0
    np.testing.assert_array_equal(lack, residual_plot.lacks(quadrotor)[0])


def test_one_acceleration_is_shown_even_where_the_model_lacks_nothing(quadrotor):
    nothing = np.zeros((len(quadrotor.transitions), 6))
    assert residual_plot.matters(quadrotor.policy.task.system, quadrotor.transitions, nothing, nothing) == ["vx"]


def test_numbers_have_two_digits_and_no_exponent():
    values = [0.0, 0.0004, 0.0234, 0.56, 1.28, 10.76, 128.3, math.nan]
    shown = ["0.0", "< 0.001", "0.023", "0.56", "1.3", "11", "128", "–"]
    assert [plot_style.number(value) for value in values] == shown


def test_lengths_below_a_metre_are_told_in_centimetres():
    assert plot_style.small([0.1, math.nan], "m") == (100.0, "cm")
    assert plot_style.small([0.1, 0.2], "m/s") == (100.0, "cm/s")
    assert plot_style.small([0.1, 1.2], "m") == (1.0, "m")
    assert plot_style.small([0.1], "rad") == (1.0, "rad")


def test_smoothing_passes_over_a_spike_and_over_what_is_not_finite():
    values = np.ones(60)
    values[[10, 30]] = 1e6, math.nan
    assert (plot_style.smoothed(values) == 1).all()
    assert np.isnan(plot_style.smoothed(np.array([math.nan]))).all()


# --- how robots and jobs describe themselves --------------------------------------------------------------------------


def test_every_view_names_states_that_have_a_label_and_a_unit():
    for system, task in SYSTEMS.values():
        for name in {name for view in task.views for name in view} - {"t"}:
            assert name in system.State._fields
            assert system.axes[name].unit
        assert set(system.axes) <= set(system.State._fields)
        assert set(system.accelerations) <= set(system.axes)


def test_a_task_without_views_is_drawn_over_time(quadrotor, monkeypatch):
    monkeypatch.setattr(type(quadrotor.policy.task), "views", ())
    figure = plots.draw_flight(quadrotor)
    assert [axes.get_xlabel() for axes in figure.axes[:4]] == ["time [s]"] * 4
    assert [figure.axes[0].get_ylabel(), figure.axes[2].get_ylabel()] == ["x [m]", "y [m]"]


def test_the_drawn_reference_is_what_the_task_asks_for():
    task = make_task("quadrotor", steps=12)
    episodes = task.episodes(2, "test", 0)
    torch.testing.assert_close(task.path(episodes), episodes[:, :13, :6])
    task = make_task("fixed_wing")
    episodes = task.episodes(2, "test", 0)
    path = task.path(episodes)
    torch.testing.assert_close(path[:, -1], episodes)
    torch.testing.assert_close(path[:, 20], task.start(episodes, torch.tensor([20, 20]))[:, :3])


def test_altitude_is_up_although_the_aircraft_counts_down():
    system = make_system("fixed_wing")
    climbing = system.State(*(0.0, 0.0, -3.0), *(math.cos(0.1), 0.0, math.sin(0.1), 0.0), *(11.5, 0.0, 0.0), *[0.0] * 3)
    assert system.place(climbing)[2] == 3.0
    assert system.axes["pz"].factor * climbing.pz == 3.0
    (nose, tail), *_ = system.outline(climbing, 1.0)
    assert nose[2] > 3.0 > tail[2]


def test_a_quadrotor_is_drawn_around_its_place_in_its_attitude():
    system = make_system("quadrotor")
    rolled = system.State(*(1.0, 2.0, 3.0), *(math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0), *[0.0] * 6)
    arms = np.array(system.outline(rolled, 2.0)[:2])
    np.testing.assert_allclose(arms.mean((0, 1)), (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose(arms[..., 1], 2, atol=1e-12)  # a roll of 90 degrees stands the arms upright
    np.testing.assert_allclose(np.linalg.norm(arms[:, 0] - arms[:, 1], axis=-1), 2 * 0.7 * 2.0)


def test_a_pole_with_a_positive_angle_leans_to_positive_x():
    system = make_system("cartpole")
    tip = system.place(system.State(0.5, 0.0, 0.3, 0.0))
    assert tip == pytest.approx((0.5 + math.sin(0.3), 0.0, math.cos(0.3)))
    assert system.outline(system.State(0.5, 0.0, 0.3, 0.0), 9.0)[1][1] == tip


# --- film -------------------------------------------------------------------------------------------------------------


def test_the_film_of_every_system_lasts_as_long_as_the_flight(adaptation, tmp_path):
    path = tmp_path / "flight.mp4"
    video.write_video(adaptation, path, fps=20)
    assert [entry.name for entry in tmp_path.iterdir()] == ["flight.mp4"]
    task, row = adaptation.policy.task, plots.representative(adaptation)
    last = max(plots.last_steps(task, adaptation.evaluations[name])[row] for name in ("zero_shot", "few_shot"))
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FPS) == 20
    count = 0
    while film.read()[0]:
        count += 1
    assert count == round(last * task.system.dt * 20) + 1


def test_the_same_film_can_be_a_gif_that_goes_on_for_ever(quadrotor, tmp_path):
    video.write_video(quadrotor, tmp_path / "flight.gif", fps=5)
    assert [entry.name for entry in tmp_path.iterdir()] == ["flight.gif"]
    frames = list(video.frames(quadrotor, 5))
    with Image.open(tmp_path / "flight.gif") as film:
        assert film.n_frames == len(frames)
        assert film.info["duration"] == 200 and film.info["loop"] == 0
        assert film.size[0] == video.GIF_WIDTH and film.size[1] < frames[0].shape[0]
        film.seek(film.n_frames - 1)
        shown = np.asarray(film.convert("RGB"))[..., ::-1].astype(float)
    small = cv2.resize(frames[-1], shown.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(shown - small).mean() < 6  # of 255: few colours, but the right ones


def test_the_robot_moves_from_frame_to_frame(quadrotor):
    frames = list(video.frames(quadrotor, 10))
    black = [np.argwhere((frame < 20).all(-1)) for frame in frames]  # nothing else is as dark as the robot
    assert all(len(pixels) > 50 for pixels in black)
    places = np.array([pixels.mean(0) for pixels in black])
    assert np.abs(places[0] - places[-1]).max() > 20


def test_the_camera_shows_up_as_up_and_right_as_right():
    flights, reference = [], np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
    camera, panel, stacked = video._camera(make_system("cartpole"), flights, reference, 0.1)
    (x0, y0), (x1, y1) = camera(reference)
    assert not stacked
    assert x1 - x0 == pytest.approx(y0 - y1)
    assert 0 < x0 < x1 < panel[0] and 0 < y1 < y0 < panel[1]


@pytest.mark.parametrize("name, fps", [("flight.avi", 30), ("nowhere/flight.mp4", 30), ("flight.mp4", 0)])
def test_a_film_that_cannot_be_is_refused_in_one_line(quadrotor, tmp_path, name, fps):
    with pytest.raises(InputError, match=r"^--video .*expected|^--video .*no folder") as error:
        video.write_video(quadrotor, tmp_path / name, fps)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_opencv_cannot_open_is_refused(quadrotor, tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "VideoWriter_fourcc", lambda *letters: -2)  # no such code
    monkeypatch.setattr(cv2, "VideoWriter", lambda *given: Closed())
    with pytest.raises(InputError, match="OpenCV can't write"):
        video.write_video(quadrotor, tmp_path / "flight.mp4")
    assert list(tmp_path.iterdir()) == []


class Closed:
    """A writer that didn't open."""

    def isOpened(self):
        return False

    def release(self):
        pass


def test_a_film_that_is_interrupted_leaves_nothing_behind(quadrotor, tmp_path, monkeypatch):
    def interrupted(adaptation, fps):
        yield np.zeros((64, 64, 3), np.uint8)
        raise KeyboardInterrupt

    monkeypatch.setattr(video, "frames", interrupted)
    with pytest.raises(KeyboardInterrupt):
        video.write_video(quadrotor, tmp_path / "flight.mp4")
    assert list(tmp_path.iterdir()) == []
