"""Tables and figures from the committed results: `python -m adapt.tables`, and `--check` to see that they still agree.

Markdown goes between `<!-- table: table1 -->` and `<!-- end of table -->` in the README, LaTeX (for `booktabs`) to
`tables/` and pictures to `figures/` in the folder of the results.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from adapt import command
from adapt.table_cells import HOW
from adapt.table_layouts import LAYOUTS
from envs.errors import InputError
from policies.files import replacing

BEGIN, END = re.compile(r"<!-- table: (\S+) -->"), "<!-- end of table -->"
MEND = "run python -m adapt.tables"


@dataclass(frozen=True)
class Options:
    """Write the tables of the README, LaTeX tables and figures from the CSVs of the results."""

    check: bool = False
    """Write nothing; exit status 2 and one line if a table or figure isn't what the results give."""
    results: str = "results"
    """Folder with experiments.csv, curves.csv and published.csv."""
    readme: str = "README.md"
    """Markdown file whose marked tables are filled."""


def main(options):
    """Read the evidence, then write or compare."""
    from adapt import evidence, figures

    text = _read(options.readme)
    marks = marked(text, options.readme, LAYOUTS)
    known = evidence.read(options.results)
    tables = {name: layout(known) for name, layout in LAYOUTS.items()}
    if known.unused():
        raise InputError(f"{options.results}/published.csv: {known.unused()}: no table has such a row; mend its words")
    latex_files = {Path(options.results) / "tables" / f"{name}.tex": latex(name, t) for name, t in tables.items()}
    pictures = Path(options.results) / "figures"
    if options.check:
        check_readme(options.readme, text, marks, tables)
        check_files(latex_files)
        figures.check(known, pictures)
        check_links(options.readme, text)
        print("tables and figures agree with the results")
        _tell_old(known)
        return
    for path, content in {**latex_files, Path(options.readme): filled(text, marks, tables)}.items():
        _write(path, content)
    figures.draw_all(known, pictures)
    there = f"{len(latex_files)} to {options.results}/tables, and {pictures}"
    print(f"wrote {len(marks)} tables of {options.readme}, {there}")
    _tell_old(known)


def _tell_old(known):
    """Rows that stand for earlier settings are shown all the same, but not without a word."""
    if old := known.old():
        advice = "python -m adapt.experiments run makes them again"
        print(f"note: made with other settings than the present ones: {', '.join(old)}; {advice}")


def check_links(path, text):
    """Refuse a picture that a text shows and that isn't there.

    Raises:
        InputError: names the first.
    """
    for link in re.findall(r'<img src="([^":]+)"', text):
        if not (Path(path).parent / link).is_file():
            raise InputError(f"{path}: shows {link}, which isn't there; {MEND}")


def _read(path):
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        told = getattr(error, "strerror", None) or "not UTF-8"
        raise InputError(f"{path}: can't be read ({told}); name a Markdown file with --readme") from None


def _write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        partial.write_text(content, encoding="utf-8")


# --- Markdown between markers -----------------------------------------------------------------------------------------


class Mark(NamedTuple):
    """A marked table: its name and the lines of its two markers, from 0."""

    name: str
    begin: int
    end: int


def marked(text, path, names):
    """The marked tables of a text, in order.

    Raises:
        InputError: a name that isn't one of `names`, or a marker without its other half; names file and line.
    """
    marks, opened = [], None
    for number, line in enumerate(text.split("\n")):
        where = f"{path}: line {number + 1}"
        if match := BEGIN.fullmatch(line.strip()):
            if opened:
                raise InputError(f"{where}: a table begins inside another; put {END!r} before it")
            if match[1] not in names:
                raise InputError(f"{where}: no table is called {match[1]!r}; expected one of {', '.join(names)}")
            opened = (match[1], number)
        elif line.strip() == END:
            if not opened:
                raise InputError(f"{where}: a table ends that never began; remove the line")
            marks.append(Mark(*opened, number))
            opened = None
    if opened:
        raise InputError(f"{path}: line {opened[1] + 1}: table {opened[0]!r} has no end; add {END!r} behind it")
    return marks


def filled(text, marks, tables):
    """The text with what stands between markers made anew."""
    lines = text.split("\n")
    for mark in reversed(marks):
        lines[mark.begin + 1 : mark.end] = _block(mark, marks, tables)
    return "\n".join(lines)


def check_readme(path, text, marks, tables):
    """Refuse a marked table that isn't what the results give.

    Raises:
        InputError: names the first.
    """
    lines = text.split("\n")
    for mark in marks:
        if lines[mark.begin + 1 : mark.end] != _block(mark, marks, tables):
            raise InputError(f"{path}: line {mark.begin + 1}: {mark.name} isn't what the results give; {MEND}")


def _block(mark, marks, tables):
    """The lines between the two markers of a table; the first of a text also says how all of them are read."""
    return markdown(tables[mark.name], explained=mark == marks[0]).split("\n")


def check_files(contents):
    """Refuse a file that isn't there or doesn't hold what it should.

    Raises:
        InputError: names the first.
    """
    for path, content in contents.items():
        if not path.is_file():
            raise InputError(f"{path}: isn't there; {MEND}")
        if path.read_text(encoding="utf-8") != content:
            raise InputError(f"{path}: isn't what the results give; {MEND}")


# --- how tables are written -------------------------------------------------------------------------------------------


def markdown(table, explained=True):
    """A table with its note, and an empty line before and behind."""
    note = f"{table.note} {HOW}" if explained else table.note
    return "\n" + _tabulated(table, "pipe") + f"\n\n*{table.title}.* {note}\n"


def latex(name, table):
    """A table as a float with caption and label, for `booktabs`."""
    body = _symbols(_tabulated(table, "latex_booktabs"))
    caption = _symbols(re.sub(r"([%&_#$])", r"\\\1", f"{table.title}. {table.note} {HOW}"))
    lines = [r"% needs \usepackage{booktabs}", r"\begin{table*}[t]", r"\centering", r"\small"]
    lines += [body, rf"\caption{{{caption}}}", rf"\label{{tab:{name}}}", r"\end{table*}", ""]
    return "\n".join(lines)


def _tabulated(table, form):
    from tabulate import tabulate

    sides = ("left", *["right"] * (len(table.columns) - 1))
    return tabulate(table.rows, table.columns, form, disable_numparse=True, colalign=sides)


def _symbols(text):
    """Bold and the few characters beyond ASCII that our tables use, in LaTeX."""
    text = re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", text)
    for symbol, command_ in {"±": r"$\pm$", "–": "--", "×": r"$\times$", "≥": r"$\geq$"}.items():
        text = text.replace(symbol, command_)
    return text


if __name__ == "__main__":
    command.run("adapt.tables", Options, main)
