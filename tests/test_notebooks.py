"""Notebooks: what is committed can be read as it is, and runs alone in an empty folder."""

import os
import re
import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LONGEST = 30  # [lines] of a code cell
SECONDS = 600  # [s] for one cell, on a machine with better things to do
PLACES = re.compile(r"(?<![\w.])/(tmp|home|work|root|usr|opt|var|Users)\b|[A-Z]:\\Users")

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(path):
    return [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]


def outputs(path):
    return [output for cell in code_cells(path) for output in cell.outputs]


def said(output):
    """All text of an output."""
    kinds = [text for kind, text in output.get("data", {}).items() if kind.startswith("text/")]
    return "\n".join([output.get("text", ""), *output.get("traceback", []), *kinds])


def test_there_are_notebooks():
    assert NOTEBOOKS


@each
def test_a_notebook_is_valid_and_holds_nothing_of_the_run_that_wrote_it(path):
    notebook = nbformat.read(path, 4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert [cell.metadata for cell in notebook.cells if "execution" in cell.metadata] == []


@each
def test_the_first_cell_says_how_to_start_from_a_fresh_install(path):
    first = nbformat.read(path, 4).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert "pip install" in first.source
    assert "[notebooks]" in first.source
    assert "jupyter" in first.source


@each
def test_a_constant_makes_it_quick(path):
    lines = [line for cell in code_cells(path) for line in cell.source.splitlines()]
    assert [line for line in lines if re.match(r"QUICK = True\b", line)], "no cell says QUICK = True"
    assert any("QUICK" in line and not line.startswith("QUICK =") for line in lines), "nothing reads QUICK"


@each
def test_code_is_cut_into_cells_that_fit_on_a_screen(path):
    long = [cell.source.splitlines()[0] for cell in code_cells(path) if len(cell.source.splitlines()) > LONGEST]
    assert long == []


@each
def test_the_cells_were_run_once_in_order(path):
    counts = [cell.execution_count for cell in code_cells(path)]
    assert counts == list(range(1, len(counts) + 1))


@each
def test_a_notebook_holds_its_outputs_and_a_picture(path):
    kinds = {kind for output in outputs(path) for kind in output.get("data", {})}
    assert "image/png" in kinds
    assert [output for output in outputs(path) if said(output).strip()]


@each
def test_no_output_is_an_error_or_a_warning(path):
    found = [said(output)[-300:] for output in outputs(path) if output.output_type == "error"]
    found += [said(output)[-300:] for output in outputs(path) if output.get("name") == "stderr"]
    assert found == []


@each
def test_no_output_names_a_place_on_the_machine_that_wrote_it(path):
    found = [said(output) for output in outputs(path) if PLACES.search(said(output))]
    assert found == []


@pytest.mark.slow
@each
def test_a_notebook_runs_alone_in_an_empty_folder(path, tmp_path, monkeypatch):
    shutil.copy(path, tmp_path)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws into the notebook
    # The kernel is a process of its own: in a checkout that isn't installed it finds the packages by this alone.
    inherited = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *([inherited] if inherited else [])]))
    notebook = nbformat.read(tmp_path / path.name, 4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=resources).execute()
    kinds = {kind for cell in notebook.cells for output in cell.get("outputs", ()) for kind in output.get("data", {})}
    assert "image/png" in kinds
