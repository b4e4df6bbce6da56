"""The API reference names every module, command and public name; `make docs` checks what it says of them."""

import ast
import re
from pathlib import Path

import pytest

import adapt
import envs

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PACKAGES = ("envs", "policies", "adapt")


def public_modules():
    """Dotted names of all modules of the packages but those that begin with an underscore."""
    files = (file.relative_to(ROOT) for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    names = (".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in files)
    return sorted(name for name in names if not any(part.startswith("_") for part in name.split(".")))


def documented(page):
    """What a page takes from docstrings."""
    return re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)


def option_classes(module):
    """Classes that hold the options of a command; several if it has subcommands, none if the module is no command."""
    file = ROOT / f"{module.replace('.', '/')}.py"
    file = file if file.exists() else file.with_suffix("") / "__init__.py"
    tree = ast.parse(file.read_text(encoding="utf-8"))
    if not any(isinstance(node, ast.If) and "__main__" in ast.unparse(node.test) for node in tree.body):
        return set()
    classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    assignments = [node for node in tree.body if isinstance(node, ast.Assign)]
    unions = [node.value for node in assignments if "Options" in map(ast.unparse, node.targets)]
    named = {node.id for union in unions for node in ast.walk(union) if isinstance(node, ast.Name)}
    return named & classes or {"Options"}


def test_every_module_is_on_one_page():
    pages = [page for page in sorted(DOCS.rglob("*.md")) if page != DOCS / "commands.md"]
    on_pages = [name for page in pages for name in documented(page)]
    assert set(public_modules()) - set(on_pages) == set(), "add these to the page in docs/ that they belong to"
    assert set(on_pages) - set(public_modules()) == set(), "these are on a page in docs/ but no longer exist"
    assert len(on_pages) == len(set(on_pages))


def test_the_options_of_every_command_are_on_the_page_of_the_commands():
    commands = [name for name in public_modules() if name.startswith("adapt.")]
    expected = {f"{module}.{options}" for module in commands for options in option_classes(module)}
    assert {"adapt.fewshot.Options", "adapt.pretrain.Options"} <= expected
    assert set(documented(DOCS / "commands.md")) == expected


@pytest.mark.parametrize("package", [adapt, envs])
def test_the_first_page_leads_to_every_name_that_a_package_offers(package):
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    missing = [name for name in package.__all__ if f"[`{package.__name__}.{name}`][" not in text]
    assert missing == []


def test_units_in_the_comments_of_fields_reach_the_reference():
    griffe = pytest.importorskip("griffe", reason="comes with the extra `docs`")
    extensions = griffe.load_extensions(str(DOCS / "field_comments.py"))
    package = griffe.load("envs", search_paths=[ROOT], allow_inspection=False, extensions=extensions)
    quadrotor = package["quadrotor.Quadrotor"]
    assert quadrotor["inertia_y"].docstring.value == "[kg m^2]"
    assert quadrotor["State"].docstring is None, "a field without a comment has no text"


def test_the_citation_names_the_version_of_the_package():
    versions = [
        re.search(pattern, (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE).group(1)
        for name, pattern in (("CITATION.cff", r"^version: (\S+)$"), ("pyproject.toml", r'^version = "(.+)"$'))
    ]
    assert versions[0] == versions[1]
