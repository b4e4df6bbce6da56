"""`python -m adapt.tables` fills what is marked and nothing else, and `--check` sees whatever has changed since."""

import re
from pathlib import Path

import pandas as pd
import pytest

from adapt.experiment_run import config_hash
from adapt.table_layouts import LAYOUTS
from adapt.tables import BEGIN, latex, marked

ROOT = Path(__file__).parents[2]
ROW = {"seed": 0, "system": "quadrotor", "set": "paper", "target": "", "method": "apg", "horizon": 10, "mode": ""}
ROW |= {"samples": 1000, "metric": "position error", "unit": "m", "error": 0.1, "std": 0.02, "success": 1.0, "n": 50}
TEXT = "# Robots\n\nbefore\n<!-- table: table1 -->\nold\n<!-- end of table -->\nbehind\n"


def mark(name):
    return f"<!-- table: {name} -->\n<!-- end of table -->\n"


@pytest.fixture
def project(tmp_path):
    """Options for results of three seeds and a README with one marked table."""
    results = tmp_path / "results"
    results.mkdir()
    (results / "published.csv").write_bytes((ROOT / "results" / "published.csv").read_bytes())
    rows = [
        ROW | {"experiment": "apg-quadrotor", "seed": seed, "error": e} for seed, e in enumerate((0.01, 0.02, 0.06))
    ]
    rows += [ROW | {"experiment": "horizon-concurrent-10", "error": 0.5}]
    pd.DataFrame(rows).to_csv(results / "experiments.csv", index=False)
    (tmp_path / "README.md").write_text(TEXT)
    return "--results", results, "--readme", tmp_path / "README.md"


def test_marked_tables_are_filled_and_the_rest_of_the_text_stays(call, project):
    readme = project[3]
    assert call("tables", *project).status == 0
    text = readme.read_text()
    assert text.startswith("# Robots\n\nbefore\n<!-- table: table1 -->\n\n| system ")
    assert text.endswith("\n<!-- end of table -->\nbehind\n")
    assert "\nold\n" not in text
    (line,) = [line for line in text.splitlines() if re.match(r"\| quadrotor \[m\] *\| *APG \|", line)]
    assert [cell.strip() for cell in line.split("|")[3:5]] == ["**0.0300 ± 0.0216**", "0.05 ± 0.01"]
    assert call("tables", *project).status == 0
    assert readme.read_text() == text  # a second time changes nothing


def test_the_first_table_of_a_text_explains_the_cells_of_all(call, project):
    readme = project[3]
    readme.write_text("".join(map(mark, LAYOUTS)))
    call("tables", *project)
    notes = [line for line in readme.read_text().splitlines() if line.startswith("*Table")]
    assert ["standard deviation over seeds" in note for note in notes] == [True] + [False] * (len(LAYOUTS) - 1)


def test_latex_tables_and_figures_are_written_for_all(call, project, contents):
    call("tables", *project)
    assert {name for name in contents(project[1]) if "/" in name} == {
        *(f"tables/{name}.tex" for name in LAYOUTS),
        "figures/horizon.png",  # the only one there are results for
    }


def test_a_latex_table_has_as_many_cells_in_each_row_and_nothing_that_latex_stumbles_over(call, project):
    call("tables", *project)
    for path in (project[1] / "tables").iterdir():
        text = path.read_text()
        assert all(
            text.count(rule) == 1 for rule in (r"\toprule", r"\midrule", r"\bottomrule", r"\caption{", r"\label{tab:")
        )
        rows = [line for line in text.splitlines() if line.endswith(r"\\")]
        assert len({row.count("&") for row in rows}) == 1
        assert rows[0].count("&") + 1 == len(re.search(r"\\begin\{tabular\}\{([lr]+)\}", text)[1])
        body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
        assert not re.search(r"(?<!\\)[%_#]", re.sub(r"\\label\{.*\}", "", body))
        assert not re.search(r"[^\x00-\x7f]|\*\*", body)
        assert body.count("{") == body.count("}")
    assert r"\textbf{0.0300 $\pm$ 0.0216}" in (project[1] / "tables" / "table1.tex").read_text()


def test_what_agrees_passes_the_check_and_nothing_is_written(call, project, contents):
    call("tables", *project)
    folder = project[1].parent
    before = contents(folder)
    answer = call("tables", "--check", *project)
    assert (answer.status, answer.errors) == (0, [])
    assert contents(folder) == before


def test_the_check_fails_before_tables_are_made_and_writes_nothing(refused, project, contents):
    before = contents(project[1].parent)
    assert "README.md: line 4: table1 isn't what the results give; run python -m adapt.tables" in refused(
        "tables", "--check", *project
    )
    assert contents(project[1].parent) == before


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("README.md", "0.0300", "0.0290", "README.md: line 4: table1 isn't"),
        ("README.md", "0.05 ± 0.01", "0.06 ± 0.01", "README.md: line 4: table1 isn't"),
        ("results/experiments.csv", "0.06", "0.07", "README.md: line 4: table1 isn't"),
        ("results/published.csv", "0.05,0.01", "0.05,0.02", "README.md: line 4: table1 isn't"),
        ("results/experiments.csv", "0.5,", "0.4,", "table2.tex: isn't"),
        ("results/tables/table3.tex", "0.28", "0.29", "table3.tex: isn't"),
    ],
)
def test_the_check_names_the_first_that_disagrees_when_a_number_has_changed(
    call, refused, project, name, old, new, said
):
    call("tables", *project)
    path = project[1].parent / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    assert said in refused("tables", "--check", *project)


def test_the_check_misses_no_file(call, refused, project):
    call("tables", *project)
    (project[1] / "figures" / "horizon.png").unlink()
    assert "horizon.png: isn't there" in refused("tables", "--check", *project)
    (project[1] / "tables" / "table2.tex").unlink()
    assert "table2.tex: isn't there" in refused("tables", "--check", *project)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a\n" + mark("table9"), "line 2: no table is called 'table9'; expected one of table1, "),
        ("<!-- table: table1 -->\n" + mark("table2"), "line 2: a table begins inside another"),
        ("a\n<!-- end of table -->\n", "line 2: a table ends that never began"),
        (mark("table1") + "<!-- table: table2 -->\n", "line 3: table 'table2' has no end"),
    ],
)
def test_markers_that_make_no_sense_are_refused_by_line_and_nothing_is_written(refused, project, contents, text, said):
    project[3].write_text(text)
    before = contents(project[1].parent)
    for options in (project, ("--check", *project)):
        line = refused("tables", *options)
        assert f"{project[3]}: {said}" in line
    assert contents(project[1].parent) == before


def test_a_text_without_markers_stays_as_it_is(call, project):
    project[3].write_text("no tables here: `<!-- table: NAME -->`\n")
    assert call("tables", *project).status == 0
    assert project[3].read_text() == "no tables here: `<!-- table: NAME -->`\n"


def test_what_cannot_be_read_is_refused_by_name(refused, project):
    results, readme = project[1], project[3]
    assert "none.md: can't be read (No such file or directory)" in refused(
        "tables", "--results", results, "--readme", readme.with_name("none.md")
    )
    assert "experiments.csv: can't be read" in refused("tables", "--results", readme.parent, "--readme", readme)
    readme.write_bytes(b"\xff")
    assert "README.md: can't be read (not UTF-8)" in refused("tables", *project)


def test_a_published_value_that_no_table_asks_for_is_refused(refused, project):
    path = project[1] / "published.csv"
    path.write_text(path.read_text().replace("table1,quadrotor,apg,", "table1,quadrotor,APG,"))
    assert "published.csv: table1 quadrotor APG source: no table has such a row" in refused("tables", *project)


def test_a_picture_that_is_not_there_fails_the_check(call, refused, project):
    readme = project[3]
    readme.write_text(TEXT + '<img src="results/figures/horizon.png"><img src="https://example.org/a.png">\n')
    call("tables", *project)
    assert call("tables", *project, "--check").status == 0
    readme.write_text(readme.read_text().replace("horizon.png", "gone.png"))
    assert "shows results/figures/gone.png, which isn't there" in refused("tables", *project, "--check")


def test_rows_of_other_settings_are_told(call, project):
    path = project[1] / "experiments.csv"
    table = pd.read_csv(path)
    table["config"] = [config_hash("apg-quadrotor")] * 3 + ["0123456789ab"]
    table.to_csv(path, index=False)
    answer = call("tables", *project)
    assert "note: made with other settings than the present ones: horizon-concurrent-10; " in answer.out


def test_special_characters_are_escaped_in_captions_and_cells():
    table = LAYOUTS["table1"].__globals__["Table"]("50 % of a_b & c", ("x", "y"), [["a_b", "**1 %**"]], "50 %")
    text = latex("t", table)
    assert r"\caption{50 \% of a\_b \& c. 50 \%" in text
    assert r"a\_b & \textbf{1 \%} \\" in " ".join(text.split())


def test_tables_and_figures_of_the_project_agree_with_its_results(call):
    text = (ROOT / "README.md").read_text()
    marks = marked(text, "README.md", LAYOUTS)
    assert bool(marks) == bool(BEGIN.search(text))
    if marks or (ROOT / "results" / "experiments.csv").exists():
        answer = call("tables", "--check", "--results", ROOT / "results", "--readme", ROOT / "README.md")
        assert (answer.status, answer.errors) == (0, [])
