"""The report of the audit counts what got worse and draws all cases."""

import math

import numpy as np
import pandas as pd
import pytest

from adapt.audit import COLUMNS
from adapt.audit_report import draw, figures, gap, numbers, save, table


def rows(ratios, ungated=None, system="quadrotor", **changes):
    """Cases with these ratios, as numbers."""
    made = pd.DataFrame(dict.fromkeys(COLUMNS, [""] * len(ratios)))
    made["system"], made["index"] = system, [str(i) for i in range(len(ratios))]
    made["ratio"], made["ratio_ungated"] = ([str(r) for r in part] for part in (ratios, ungated or ratios))
    made["accepted"], made["episodes"] = "True", "20"
    for policy in ("source", "zero_shot", "gated", "ungated", "oracle"):
        made[f"{policy}_success"] = "1.0"
    for name, values in changes.items():
        made[name] = [str(value) for value in values]
    return numbers(made)


def test_worse_are_those_above_five_percent_and_those_that_fail_more():
    found = figures(rows([1.04, 1.06, math.inf, 0.5], [1.04, 1.04, 1.04, 2.0]))
    assert found["worse, with the gate"] == "50.0% (2)"
    assert found["worse, without"] == "25.0% (1)"
    assert found["better, with the gate"] == "25.0%"


def test_better_are_those_that_save_flights_too():
    found = figures(rows([1.0, 1.0, 0.9], zero_shot_success=[0.5, 1, 1], gated_success=[1, 1, 1]))
    assert found["better, with the gate"] == "66.7%"
    assert found["better, without"] == "66.7%"


def test_quantiles_count_infinite_ratios_among_the_cases():
    found = figures(rows([0.5, 0.6, 0.7, *[1.0] * 6, math.inf]))
    assert found["ratio, with the gate: median"] == "1.000"
    assert found["ratio, with the gate: 95 % quantile"] == "inf"


def test_crashes_are_counted_and_left_out_of_everything_else():
    found = figures(rows([1.0, ""], crash=["", "ValueError"]))
    assert found["cases"] == "2" and found["crashes or NaN"] == "1"
    assert found["worse, with the gate"] == "0.0% (0)"


def test_the_gap_is_what_was_won_back_of_what_the_target_costs():
    errors = {"source_error": [1, 1, 1], "zero_shot_error": [5, 1.1, 5], "gated_error": [2, 1, "nan"]}
    closed = gap(rows([1.0] * 3, **errors), "gated")
    assert closed[0] == pytest.approx(0.75)
    assert math.isnan(closed[1]), "a target that costs a tenth leaves nothing to measure"
    assert math.isnan(closed[2]), "no flight to compare"


def test_there_is_no_gap_between_errors_of_other_flights():
    errors = {"source_error": [1], "zero_shot_error": [5], "gated_error": [6], "zero_shot_success": [0.25]}
    assert math.isnan(gap(rows([1.0], **errors), "gated")[0])


def test_an_oracle_takes_the_place_of_the_error_in_the_model():
    errors = {"source_error": [1.0], "oracle_error": [3.0], "zero_shot_error": [5.0], "gated_error": [4.0]}
    made = rows([0.8], **errors)
    assert gap(made, "gated")[0] == pytest.approx(0.5)
    assert "zero-shot - oracle" in table(made)


def test_what_noise_costs_is_no_gap_unless_an_oracle_says_what_can_be_won_back():
    errors = {"source_error": [1.0], "zero_shot_error": [5.0], "gated_error": [4.0], "noise": [0.5]}
    assert math.isnan(gap(rows([0.8], **errors), "gated")[0])
    assert gap(rows([0.8], oracle_error=[3.0], **errors), "gated")[0] == pytest.approx(0.5)


def test_the_table_has_a_column_for_each_system_and_tells_crashes():
    made = pd.concat([rows([1.0]), rows([2.0, 1.0], system="cartpole", crash=["", "TypeError: no"])], ignore_index=True)
    text = table(made)
    assert "quadrotor" in text and "cartpole" in text
    assert "cartpole 1" in text and "TypeError: no" in text


def test_the_picture_has_a_panel_for_each_system_and_reaches_every_case(tmp_path):
    made = pd.concat([rows([0.0, 0.5, math.inf], [1.0, 1.0, 3.0]), rows([1.0], system="cartpole")], ignore_index=True)
    figure = draw(made)
    assert [axes.get_title() for axes in figure.axes] == ["quadrotor, N = 3", "cartpole, N = 1"]
    gated = next(line for line in figure.axes[0].get_lines() if line.get_label() == "with the gate")
    assert "33.3%" in [text.get_text() for text in figure.axes[0].texts]
    assert np.isfinite(gated.get_xdata()).all(), "ratios of zero and infinity are drawn at the ends"
    save(made, tmp_path / "audit.png")
    assert (tmp_path / "audit.png").read_bytes().startswith(b"\x89PNG")
