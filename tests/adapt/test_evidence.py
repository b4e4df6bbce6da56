"""Results are read as they are, and whatever a mean could silently be wrong by is refused by file, line and column."""

import math
from pathlib import Path

import pandas as pd
import pytest

from adapt import evidence, experiment_results, experiment_run
from envs.errors import InputError

RESULTS = Path(__file__).parents[2] / "results"
ROW = {"experiment": "apg-quadrotor", "seed": 0, "system": "quadrotor", "set": "paper", "target": "", "method": "apg"}
ROW |= {"horizon": 10, "mode": "concurrent", "samples": 1000, "metric": "position error", "unit": "m", "error": 0.1}
ROW |= {"std": 0.02, "success": 1.0, "n": 50, "config": "abc"}
POINT = {"experiment": "apg-quadrotor", "seed": 0, "update": 50, "samples": 9, "seconds": 1.5, "error": 2, "success": 1}


@pytest.fixture
def folder(tmp_path):
    """A folder of results: the published values, and the rows that a test adds."""
    (tmp_path / "published.csv").write_bytes((RESULTS / "published.csv").read_bytes())

    def write(*changes, name="experiments.csv", row=ROW):
        pd.DataFrame([row | change for change in changes]).to_csv(tmp_path / name, index=False)
        return tmp_path

    return write


def test_mean_and_spread_are_those_over_the_seeds(folder):
    found = evidence.read(folder(*({"seed": seed, "error": e} for seed, e in enumerate((0.1, 0.2, 0.6)))))
    spread = found.spread("apg-quadrotor")
    assert spread.mean == pytest.approx(0.3)
    assert spread.std == pytest.approx(math.sqrt((0.2**2 + 0.1**2 + 0.3**2) / 3))
    assert (spread.low, spread.high, spread.seeds, spread.failed) == (0.1, 0.6, 3, 0)
    assert found.spread("ppo-quadrotor") is None


@pytest.mark.parametrize("nothing", ["", "nan"])
def test_a_seed_in_which_none_succeeded_is_counted_and_left_out_of_the_mean(folder, nothing):
    failed = {"seed": 1, "error": nothing, "std": nothing, "success": 0.0}
    spread = evidence.read(folder({"error": 0.4}, failed)).spread("apg-quadrotor")
    assert (spread.mean, spread.seeds, spread.failed) == (0.4, 2, 1)


def test_the_order_of_lines_and_of_columns_does_not_matter(folder):
    rows = [{"seed": seed, "error": 0.1 + seed} for seed in range(4)]
    first = evidence.read(folder(*rows)).experiments
    second = evidence.read(folder(*rows[::-1], row=dict(reversed(ROW.items())))).experiments
    assert first.to_csv(index=False) == second.to_csv(index=False)


def test_columns_that_may_be_missing_are_empty(folder):
    found = evidence.read(folder({}))
    assert found.experiments.oracle.isna().all()
    assert found.curves.empty


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([{"colour": "red"}], "experiments.csv: line 1: unknown column 'colour'"),
        ([{}, {}], "experiments.csv: line 3: repeats line 2 (experiment apg-quadrotor, seed 0)"),
        ([{"error": ""}], "experiments.csv: line 2: error is empty, but success isn't 0"),
        ([{}, {"seed": 1, "success": 0}], "experiments.csv: line 3: has an error, but success is 0"),
        ([{"success": ""}], "line 2: success is '', expected a number from 0 to 1"),
        ([{"success": 1.2}], "line 2: success is '1.2', expected a number from 0 to 1"),
        ([{"success": "nan"}], "line 2: success is 'nan', expected a number from 0 to 1"),
        ([{"error": "inf"}], "line 2: error is 'inf', expected a number of at least 0"),
        ([{"error": "much"}], "line 2: error is 'much', expected a number of at least 0"),
        ([{"seed": 0.5}], "line 2: seed is '0.5', expected an integer of at least 0"),
        ([{"n": 0}], "line 2: n is '0', expected an integer of at least 1"),
        ([{"method": ""}], "line 2: method is '', expected some text"),
        (
            [{"experiment": "apg-bicycle"}],
            "line 2: 'apg-bicycle' is no experiment; see python -m adapt.experiments list",
        ),
        ([{}, {"seed": 1, "config": "abd"}], "seeds of apg-quadrotor differ in config ('abc' and 'abd')"),
        ([{}, {"seed": 1, "unit": "cm"}], "seeds of apg-quadrotor differ in unit ('m' and 'cm')"),
    ],
)
def test_a_wrong_row_is_refused_by_line_and_column(folder, changes, said):
    with pytest.raises(InputError) as refused:
        evidence.read(folder(*changes))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: "", "is empty, expected a header"),
        (lambda text: text.replace("success,", ""), "line 1: has no column 'success'"),
        (lambda text: text.replace("success", "std"), "line 1: column 'std' stands there twice"),
        (lambda text: text + "apg-quadrotor,1\n", "line 3: has 2 cells, expected 16 as in the header"),
        (lambda text: text.replace("abc", "abc,"), "line 2: has 17 cells, expected 16"),
        (lambda text: text.replace("abc", '"abc'), "is no CSV"),
        (lambda text: b"\xff\xfe\x00", "is no CSV"),
    ],
)
def test_a_damaged_file_is_refused(folder, change, said):
    path = folder({}) / "experiments.csv"
    changed = change(path.read_text())
    path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
    with pytest.raises(InputError) as refused:
        evidence.read(path.parent)
    assert f"{path}: {said}" in str(refused.value)


def test_a_file_that_is_not_there_is_named_with_what_to_do(tmp_path):
    with pytest.raises(InputError, match=r"experiments\.csv: can't be read \(No such file.*adapt\.experiments"):
        evidence.read(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([{}, {}], "curves.csv: line 3: repeats line 2 (experiment apg-quadrotor, seed 0, update 50)"),
        ([{"seconds": -1}], "curves.csv: line 2: seconds is '-1', expected a number of at least 0"),
        ([{"experiment": "none"}], "curves.csv: line 2: 'none' is no experiment"),
    ],
)
def test_a_wrong_point_of_a_curve_is_refused(folder, changes, said):
    folder({})
    with pytest.raises(InputError) as refused:
        evidence.read(folder(*changes, name="curves.csv", row=POINT))
    assert said in str(refused.value)


def test_a_curve_may_have_points_without_a_number(folder):
    folder({})
    curves = evidence.read(folder({}, {"update": 100, "error": "nan"}, name="curves.csv", row=POINT)).curves
    assert curves.error.tolist() == pytest.approx([2, math.nan], nan_ok=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda table: pd.concat([table, table.tail(1)]), "repeats line"),
        (lambda table: table.assign(note=""), "note is empty, expected why no error is"),
        (lambda table: table.assign(std=""), "std is empty"),
        (lambda table: table.assign(source=""), "source is '', expected some text"),
    ],
)
def test_a_published_value_is_one_number_with_its_source_or_a_reason(folder, change, said):
    path = folder({}) / "published.csv"
    change(pd.read_csv(path, dtype=str, keep_default_na=False)).to_csv(path, index=False)
    with pytest.raises(InputError, match=f"published.csv: line .*{said}"):
        evidence.read(path.parent)


def test_what_a_sweep_writes_is_known():
    assert set(evidence.ROW) | set(evidence.FURTHER) == set(experiment_results.COLUMNS)
    assert set(evidence.CURVE) == {*experiment_results.KEY, *experiment_run.CURVE}


def test_the_published_values_are_those_in_print(folder):
    found = evidence.read(folder({}))
    assert found.published.groupby("table").size().to_dict() == {"table1": 12, "table2": 21, "table3": 3, "table4": 23}
    for key, error, std in (
        (("table1", "cartpole", "ppo", "source"), 0.04, 0.04),
        (("table1", "fixed_wing", "apg", "source"), 0.01, 0.01),
        (("table2", "quadrotor", "recurrent", "15"), 0.61, 0.18),
        (("table3", "cartpole", "apg", "pictures"), 0.15, 0.11),
        (("table4", "fixed_wing", "pets", "zero-shot"), 8.39, 10.15),
        (("table4", "quadrotor", "apg", "1000"), 0.07, 0.01),
    ):
        row = found.paper(*key)
        assert (row.error, row.std) == (error, std)
    assert found.paper("table1", "quadrotor", "pets", "source").note == "unstable"
    assert found.paper("table4", "fixed_wing", "apg", "150000") is None
    # Tables I and IV print the same numbers for the source domain.
    for row in found.published[
        (found.published.table == "table4") & (found.published.setting == "source")
    ].itertuples():
        same = found.paper("table1", row.system, row.method, "source")
        assert (row.error, row.std, row.note) == pytest.approx((same.error, same.std, same.note), nan_ok=True)
