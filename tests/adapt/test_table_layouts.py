"""Cells say what the rows say, nothing is shown that isn't there, and every experiment has its place."""

import math
from pathlib import Path

import pandas as pd
import pytest

from adapt import evidence, table_cells, target_tables
from adapt.experiment_table import EXPERIMENTS
from adapt.table_layouts import LAYOUTS

PUBLISHED = Path(__file__).parents[2] / "results" / "published.csv"
NUMBERS = ("source", "zero_shot", "oracle", "median_ms", "samples", "n")


def known(*runs):
    """Evidence of (experiment, error of each seed, further columns): success is 1, or 0 where the error is nan."""
    rows = []
    for name, errors, *more in runs:
        for seed, error in enumerate(errors):
            row = {"experiment": name, "seed": seed, "error": error, "success": 0.0 if math.isnan(error) else 1.0}
            rows.append(row | dict.fromkeys(NUMBERS, math.nan) | (more[0] if more else {}))
    published = evidence.read_table(PUBLISHED, evidence.PUBLISHED, {}, ("table", "system", "method", "setting"))
    columns = ["experiment", "seed", "error", "success", *NUMBERS]
    return evidence.Evidence(pd.DataFrame(rows, columns=columns), pd.DataFrame(), published)


def cells(found, table, *row):
    """The cells of the row that begins with `row`, by column; a second column of one name gets a 2."""
    layout = LAYOUTS[table](found)
    (line,) = [line for line in layout.rows if line[: len(row)] == list(row)]
    named = {}
    for column, cell in zip(layout.columns, line, strict=True):
        while column in named:
            column += "2"
        named[column] = cell
    return named


@pytest.mark.parametrize(
    ("errors", "success", "said"),
    [
        ((0.01, 0.02, 0.06), 1.0, "0.0300 ± 0.0216"),
        ((0.1, 0.2, 0.6), 1.0, "0.300 ± 0.216"),
        ((10.0, 20.0), 1.0, "15.00 ± 5.00"),
        ((0.05,), 1.0, "0.0500"),
        ((0.05,), 0.5, "0.0500 (50 %)"),
        ((0.05, 0.05), 0.996, "0.0500 ± 0.0000 (99.6 %)"),
        ((0.05,), 0.99996, "0.0500 (99.9 %)"),
        ((0.05,), 0.0002, "0.0500 (0.1 %)"),
        ((math.nan,), 0.0, "fails"),
        ((math.nan, math.nan), 0.0, "fails (all 2 seeds)"),
    ],
)
def test_a_cell_is_the_mean_over_seeds_with_its_spread_and_the_share_that_succeeds(errors, success, said):
    assert table_cells.ours(known(("apg-cartpole", errors, {"success": success})), "apg-cartpole") == said


def test_a_seed_that_fails_is_told_beside_the_mean_of_the_others():
    found = known(("apg-cartpole", (0.04, math.nan, 0.02, 0.03)))
    assert table_cells.ours(found, "apg-cartpole") == "0.0300 ± 0.0082 (75 %, 1 of 4 seeds fail)"


def test_without_results_every_cell_of_ours_is_a_dash_and_the_published_values_stand():
    row = cells(known(), "table1", "quadrotor [m]", "PPO")
    assert row == {
        **{"system": "quadrotor [m]", "method": "PPO", "error": "–", "published": "0.36 ± 0.10"},
        **{"ms per action": "–", "published2": "0.31", "samples": "–", "seeds": "–"},
    }
    row = cells(known(), "table4-fixed_wing", "150 000")
    assert (row["PPO"], row["published"], row["APG"], row["MPC"]) == ("–", "0.09 ± 0.06", "–", "–")
    assert row["PETS"] == "cluster"  # what takes more than a small machine is marked
    assert cells(known(), "table2", "15")["published"] == "fails"
    assert cells(known(), "table2", "3")["published"] == "2.43 ± 0.00 (1 %)"
    assert cells(known(), "table3", "MPC")["published"] == "unstable"


def test_time_budget_and_seeds_stand_beside_the_error():
    found = known(("ppo-quadrotor", (0.1, 0.3, 0.2), {"median_ms": 0.123, "samples": 1_500_000.0}))
    row = cells(found, "table1", "quadrotor [m]", "PPO")
    assert (row["error"], row["ms per action"], row["samples"], row["seeds"]) == ("0.200 ± 0.082", "0.12", "1.5 M", "3")


def test_budgets_and_seeds_that_differ_within_a_row_are_all_told():
    found = known(
        ("horizon-concurrent-5", (0.1, 0.1), {"samples": 900.0}),
        ("horizon-recurrent-5", (0.1,), {"samples": 150_000.0}),
    )
    row = cells(found, "table2", "5")
    assert (row["samples"], row["seeds"]) == ("900–150 k", "2 / – / 1")


@pytest.mark.parametrize(
    ("number", "said"),
    [(30, "30"), (9999, "9999"), (149_504, "150 k"), (999_499, "999 k"), (999_500, "1 M"), (5_120_000, "5.12 M")],
)
def test_numbers_of_transitions_are_short(number, said):
    assert table_cells.count(number) == said


@pytest.mark.parametrize(
    ("name", "error", "success", "table", "row", "column", "bold"),
    [
        ("apg-quadrotor", 0.05, 1.0, "table1", ("quadrotor [m]", "APG"), "error", True),  # at the published value
        ("apg-quadrotor", 0.0501, 1.0, "table1", ("quadrotor [m]", "APG"), "error", False),
        ("ppo-quadrotor", 0.30, 1.0, "table1", ("quadrotor [m]", "PPO"), "error", False),  # not the best published
        ("ppo-cartpole", 0.04, 1.0, "table1", ("CartPole [m/s]", "PPO"), "error", True),
        ("apg-quadrotor", 0.01, 0.98, "table1", ("quadrotor [m]", "APG"), "error", False),  # some flights fail
        ("mpc-quadrotor", 0.001, 1.0, "table1", ("quadrotor [m]", "MPC"), "error", False),  # doesn't learn
        ("apg-quadrotor-fast", 0.001, 1.0, "table1", ("quadrotor at 3 m/s [m]", "APG"), "error", False),  # no rival
        ("horizon-recurrent-10", 0.05, 0.99, "table2", ("10",), "LSTM", True),  # as many succeed as published
        ("horizon-recurrent-10", 0.05, 0.98, "table2", ("10",), "LSTM", False),
        ("horizon-concurrent-1", 3.0, 1.0, "table2", ("1",), "concurrent", True),  # all published ones fail
        ("horizon-concurrent-1", 0.1, 0.9, "table2", ("1",), "concurrent", False),
        ("drag-apg-quadrotor-1000", 0.07, 1.0, "table4-quadrotor", ("1000",), "APG", True),
        ("drag-apg-quadrotor-300", 0.01, 1.0, "table4-quadrotor", ("300",), "APG", False),
    ],
)
def test_bold_is_what_is_at_or_below_the_best_published_learning_based_value(
    name, error, success, table, row, column, bold
):
    cell = cells(known((name, (error,), {"success": success})), table, *row)[column]
    assert (cell.startswith("**") and cell.endswith("**")) is bold


def test_a_mean_without_the_seeds_that_fail_is_never_bold():
    found = known(("apg-quadrotor", (0.001, math.nan), {"success": 1.0}))
    assert "**" not in cells(found, "table1", "quadrotor [m]", "APG")["error"]


def test_the_drag_table_has_a_row_for_every_budget_and_levels_around_them():
    found = known(
        ("apg-quadrotor", (0.006,)),
        ("drag-apg-quadrotor-zero", (0.9,)),
        ("drag-apg-quadrotor-1000", (0.3,), {"oracle": 0.2}),
        ("drag-mpc-quadrotor-target", (0.004,)),
        ("drag-ppo-quadrotor-residual", (0.5, 0.5)),
        ("drag-ppo-quadrotor-1000", (0.7, 0.7)),
    )
    first = [row[0] for row in LAYOUTS["table4-quadrotor"](found).rows]
    assert first[:3] == ["in the model", "0 (zero-shot)", "30"]
    assert first[-3:] == ["150 000", "150 000 in model + residual", "oracle"]
    column = {title: cells(found, "table4-quadrotor", title)["APG"] for title in first}
    assert column["in the model"] == "**0.0060**"
    assert (column["0 (zero-shot)"], column["1000"], column["oracle"]) == ("0.900", "0.300", "0.200")
    oracle = cells(found, "table4-quadrotor", "oracle")
    assert (oracle["PPO"], oracle["MPC"], oracle["seeds"]) == ("–", "0.0040", "– / – / 1 / 1")
    assert cells(found, "table4-quadrotor", "150 000 in model + residual")["PPO"] == "0.500 ± 0.000"


def test_what_pictures_cost_before_adapting_is_told_and_that_it_fails():
    found = known(
        ("pictures-apg-push", (0.03, 0.03), {"zero_shot": 0.1}), ("pictures-apg-background", (0.04, 0.04, 0.04))
    )
    assert cells(found, "table3", "APG, adapted to a steady push")["zero-shot"] == "0.100 ± 0.000"
    assert cells(found, "table3", "APG, adapted to another background")["zero-shot"] == "fails (all 3 seeds)"


def test_every_experiment_for_a_table_has_a_cell_in_it():
    for table, layout in LAYOUTS.items():
        names = [name for name, experiment in EXPERIMENTS.items() if experiment.table == table]
        assert names
        found = known(*((name, (1000.0 + number,)) for number, name in enumerate(names)))
        text = str(layout(found).rows)
        assert [name for number, name in enumerate(names) if f"{1000.0 + number:.2f}" not in text] == []


KINDS = ("parameters", "linear", "features", "network", "linear+network", "state")


def of_kinds(auto, **errors):
    """Evidence of all kinds in the quadrotor's drag: 0.05 with three seeds but where said otherwise, and of auto."""
    tried = ((f"kinds-drag-quadrotor-{kind}", errors.get(kind, (0.05, 0.05, 0.05))) for kind in KINDS)
    return known(*tried, ("target-drag-quadrotor-300", auto))


def test_regret_is_told_over_the_seeds_that_all_kinds_were_run_with():
    found = of_kinds((0.02, 0.03, 0.04, 9.0, 9.0), network=(0.01, 0.02, 0.03, 5.0))
    row = cells(found, "kinds", "quadrotor [m], drag 0.3")
    assert (row["auto"], row["network"], row["state"]) == ("0.0300", "0.0200", "0.0500")
    assert (row["regret"], row["seeds"]) == ("+50 %", "3")


def test_auto_may_be_better_than_every_kind():
    assert cells(of_kinds((0.04, 0.04, 0.04)), "kinds", "quadrotor [m], drag 0.3")["regret"] == "-20 %"


def test_a_kind_that_fails_is_no_rival_in_hindsight():
    found = of_kinds((0.06, 0.06, 0.06), linear=(math.nan, 0.001, 0.001))
    assert cells(found, "kinds", "quadrotor [m], drag 0.3")["regret"] == "+20 %"


def test_no_regret_is_told_before_all_kinds_and_auto_are_run():
    found = known(*((f"kinds-drag-quadrotor-{kind}", (0.05,)) for kind in KINDS))
    row = cells(found, "kinds", "quadrotor [m], drag 0.3")
    assert (row["state"], row["auto"], row["regret"], row["seeds"]) == ("0.0500", "–", "–", "1")


def test_the_gap_closed_is_the_mean_over_seeds_that_had_one_to_close():
    rows = pd.DataFrame({"zero_shot": [0.10, 0.10, 0.02], "oracle": [0.02, 0.02, 0.03], "error": [0.02, 0.06, 0.5]})
    assert target_tables.gap_closed(rows, "oracle") == "0.75 (0.50)"
