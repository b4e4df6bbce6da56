"""Figures show the means of the rows, leave out what fails, and know which rows they were drawn from."""

import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from adapt import evidence, figure_parts, figures
from envs.errors import InputError

PUBLISHED = Path(__file__).parents[2] / "results" / "published.csv"
FURTHER = ("zero_shot", "oracle", "model_acceleration", "learned_acceleration", "gradient_norm", "gradient_variance")


def known(rows=(), points=()):
    """Evidence of (experiment, error of each seed, further columns) and of points of curves."""
    table = [
        {"experiment": name, "seed": seed, "error": error}
        | dict.fromkeys(FURTHER, math.nan)
        | (more[0] if more else {})
        for name, errors, *more in rows
        for seed, error in enumerate(errors)
    ]
    published = evidence.read_table(PUBLISHED, evidence.PUBLISHED, {}, ("table", "system", "method", "setting"))
    columns = ["experiment", "seed", "update", "samples", "seconds", "error", "success"]
    experiments = pd.DataFrame(table, columns=["experiment", "seed", "error", *FURTHER])
    return evidence.Evidence(experiments, pd.DataFrame(points, columns=columns), published)


def points(name, *seeds):
    """Points of a curve: the errors of each seed after 10, 20, … updates."""
    return [
        (name, seed, 10 * k, 1000.0 * k, k + 0.5 * seed, error, 0.0 if math.isnan(error) else 1.0)
        for seed, errors in enumerate(seeds)
        for k, error in enumerate(errors, 1)
    ]


FULL = known(
    [
        ("horizon-concurrent-10", (0.01, 0.03), {"gradient_norm": 2.0, "gradient_variance": 5.0}),
        ("horizon-recurrent-1", (math.nan, math.nan)),
        ("apg-quadrotor", (0.006,)),
        ("drag-apg-quadrotor-zero", (0.08, 0.12)),
        ("drag-apg-quadrotor-30", (0.02, 0.04), {"model_acceleration": 0.5, "learned_acceleration": 0.01}),
        ("drag-apg-quadrotor-1000", (0.01, 0.01), {"zero_shot": 0.1, "oracle": 0.008}),
        ("drag-mpc-fixed_wing-target", (0.001,)),
    ],
    points("curriculum-both", (4.0, 1.0), (2.0, 3.0))
    + points("curriculum-none", (math.nan, math.nan))
    + points("drag-apg-quadrotor-1000", (0.05, 0.02))
    + points("apg-quadrotor", (1.0, 0.1))
    + points("ppo-quadrotor", (3.0, 0.3))
    + points("speed-compiled-quadrotor", (2.0, 0.2))
    + points("speed-eager-fixed_wing", (4.0, 0.4)),
)


def lines(axes):
    """x → y of every line with points, without gaps."""
    found = []
    for line in axes.lines:
        x, y = (np.asarray(values, dtype=float) for values in line.get_data())
        shown = np.isfinite(y)
        found.append(dict(zip(x[shown].tolist(), y[shown].round(9).tolist(), strict=True)))
    return found


def drawn(name, found=FULL):
    picture = figures.PICTURES[name]
    return picture.draw(picture.part(found)).axes


@pytest.fixture(scope="module")
def gallery(tmp_path_factory):
    """A folder with every figure, drawn from FULL."""
    folder = tmp_path_factory.mktemp("figures")
    figures.draw_all(FULL, folder)
    return folder


@pytest.fixture
def folder(gallery, tmp_path):
    """A copy of the gallery to change."""
    return Path(shutil.copytree(gallery, tmp_path / "figures"))


def test_every_figure_is_drawn_readable_and_remembers_its_rows(gallery):
    assert {path.stem for path in gallery.iterdir()} == set(figures.PICTURES)
    for path in gallery.iterdir():
        with Image.open(path) as image:
            assert min(image.size) > 600
    figures.check(FULL, gallery)


def test_axes_say_what_they_show_and_in_which_unit():
    for name in figures.PICTURES:
        axes = drawn(name)
        assert all(one.get_xlabel() or one.get_shared_x_axes().get_siblings(one)[1:] for one in axes)
        assert any("[" in one.get_ylabel() for one in axes)


def test_a_figure_is_drawn_from_a_single_row(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DPI", 30)
    for row in FULL.experiments.itertuples():
        part = FULL.experiments[FULL.experiments.index == row.Index]
        figures.draw_all(evidence.Evidence(part, FULL.curves.head(0), FULL.published), tmp_path)
    figures.draw_all(known(points=points("apg-quadrotor", (1.0, 0.5))), tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {"horizon", "adaptation", "samples", "learning"}


def test_without_results_nothing_is_drawn_and_nothing_is_missing(tmp_path):
    figures.draw_all(known(), tmp_path)
    assert list(tmp_path.iterdir()) == []
    figures.check(known(), tmp_path)


@pytest.mark.parametrize("change", ["error", "zero_shot", "learned_acceleration"])
def test_a_figure_that_was_drawn_from_other_rows_is_found(folder, change):
    other = FULL.experiments.copy()
    other.loc[other.experiment == "drag-apg-quadrotor-1000", change] = 0.5
    with pytest.raises(InputError, match=r"adaptation.png: was drawn from other results; run python -m adapt.tables"):
        figures.check(evidence.Evidence(other, FULL.curves, FULL.published), folder)


def test_a_figure_does_not_depend_on_rows_that_it_does_not_show(folder):
    (folder / "horizon.png").unlink()
    with pytest.raises(InputError, match=r"horizon.png: isn't there"):
        figures.check(FULL, folder)
    rest = FULL.experiments[~FULL.experiments.experiment.str.startswith("horizon")]
    figures.check(evidence.Evidence(rest, FULL.curves, FULL.published), folder)
    (folder / "learning.png").write_text("no picture")
    with pytest.raises(InputError, match=r"learning.png: was drawn from other results"):
        figures.check(evidence.Evidence(rest, FULL.curves, FULL.published), folder)


def test_the_horizon_figure_shows_means_the_gradient_and_the_published_values():
    left, right = drawn("horizon")
    assert {10: 0.02} in lines(left)
    assert {5: 0.10, 3: 2.43, 8: 0.07, 10: 0.05, 12: 0.11} in lines(left)  # published, without those that fail
    assert {10: 2.0} in lines(right)
    assert {10: 5.0} in lines(right)


def test_error_over_transitions_begins_with_zero_shot_and_ends_at_the_level_of_the_oracle():
    left, right = drawn("samples")
    assert {figures.ZERO: 0.1, 30: 0.03, 1000: 0.01} in lines(left)
    assert {figures.ZERO: 0.56, 1000: 0.07} in lines(left)
    assert {0: 0.008, 1: 0.008} in lines(left)
    assert {0: 0.001, 1: 0.001} in lines(right)
    assert {figures.ZERO: 0.43, 2000: 0.34, 5000: 0.17, 150_000: 0.09} in lines(right)
    assert left.get_xticklabels()[0].get_text() == "0"


def test_the_fine_tuning_is_shown_between_zero_shot_and_the_error_in_the_model():
    left, right = drawn("adaptation")
    assert {30: 0.01} in lines(left)
    assert {0: 0.5, 1: 0.5} in lines(left)
    assert {10: 0.05, 20: 0.02} in lines(right)
    assert {0: 0.1, 1: 0.1} in lines(right)
    assert {0: 0.006, 1: 0.006} in lines(right)


def test_a_residual_that_is_exact_stays_in_the_picture():
    learned = {"model_acceleration": 0.5, "learned_acceleration": 0.0}
    left, _ = drawn("adaptation", known([("drag-apg-quadrotor-30", (0.02, 0.04), learned)]))
    assert lines(left)[0] == {30.0: figures.EXACT}
    low, high = left.get_ylim()
    assert low < figures.EXACT < 0.5 < high < 10
    assert len([tick for tick in left.get_yticks() if low <= tick <= high]) <= 8


def test_training_is_shown_over_steps_and_over_time():
    steps, seconds = drawn("learning")[:2]
    assert [line for line in lines(steps) if line] == [{1000: 1.0, 2000: 0.1}, {1000: 3.0, 2000: 0.3}]
    assert [line for line in lines(seconds) if line] == [{1: 1.0, 2: 0.1}, {1: 3.0, 2: 0.3}]


def test_each_build_of_the_dynamics_is_shown_over_the_time_that_it_took():
    quadrotor, fixed_wing = drawn("speed")
    assert [line for line in lines(quadrotor) if line] == [{1: 2.0, 2: 0.2}]
    assert [line for line in lines(fixed_wing) if line] == [{1: 4.0, 2: 0.4}]


def test_errors_of_few_successful_flights_are_marked_in_training():
    curves = FULL.curves.copy()
    curves.loc[(curves.experiment == "ppo-quadrotor") & (curves.samples == 2000.0), "success"] = 0.89
    steps = drawn("learning", evidence.Evidence(FULL.experiments, curves, FULL.published))[0]
    assert [line for line in lines(steps) if len(line) == 1] == [{2000: 0.3}]


def test_a_curve_is_the_mean_over_seeds_at_the_updates_that_all_of_them_reached():
    curves = known(points=points("apg-quadrotor", (4.0, 2.0, 9.0), (2.0, 1.0))).curves
    found = figure_parts.over(curves, "apg-quadrotor", "seconds")
    assert found[["x", "mean", "low", "high"]].to_numpy().tolist() == [[1.25, 3.0, 2.0, 4.0], [2.25, 1.5, 1.0, 2.0]]


def test_where_most_seeds_fail_a_curve_and_a_band_have_a_gap():
    nan = math.nan
    curves = known(points=points("apg-quadrotor", (nan, nan, 4.0), (nan, 2.0, 4.0), (1.0, 2.0, 4.0))).curves
    found = figure_parts.over(curves, "apg-quadrotor", "update")
    assert found["mean"].tolist() == pytest.approx([nan, 2.0, 4.0], nan_ok=True)
    left = drawn(
        "horizon", known([("horizon-concurrent-5", (0.1, nan, nan)), ("horizon-concurrent-8", (0.1, 0.1, nan))])
    )[0]
    assert {8: 0.1} in lines(left)


def test_the_curriculum_is_shown_by_each_seed_and_in_the_mean():
    both = lines(drawn("curriculum")[0])
    assert both[:3] == [{10: 4.0, 20: 1.0}, {10: 2.0, 20: 3.0}, {10: 3.0, 20: 2.0}]
