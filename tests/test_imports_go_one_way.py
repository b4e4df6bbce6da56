"""envs <- policies <- adapt: read from the source text, so that an import inside a function counts too."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = ("envs", "policies", "adapt")
NOT_FOR_PRODUCT_CODE = ("tests", "conftest", "notebooks", "pytest")


def find_modules(root: Path) -> dict[str, Path]:
    """Dotted name → file of every module of the layers under `root`."""
    files = (file for layer in LAYERS for file in sorted((root / layer).rglob("*.py")))
    return {".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): file for file in files}


def is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).rpartition(".")[2] == "TYPE_CHECKING"


def walk(node: ast.AST, runs_on_import: bool = True) -> Iterator[tuple[ast.AST, bool]]:
    """Every node below `node`, and whether it runs while the module is imported."""
    for child in ast.iter_child_nodes(node):
        deferred = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or is_for_type_checkers(child)
        yield child, runs_on_import
        yield from walk(child, runs_on_import and not deferred)


def imported_names(node: ast.AST, package: str) -> list[str]:
    """Absolute dotted names that a node imports; `from a import b` is `a.b`, whether b is a module or not."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
        prefix = ".".join([*above, *([node.module] if node.module else [])])
        return [f"{prefix}.{alias.name}" for alias in node.names]
    if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ("import_module", "__import__"):
        return [arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
    return []


def find_violations(root: Path) -> list[str]:
    """One line for each upward import, import of test code, and for a cycle among the imports that run on import."""
    modules = find_modules(root)
    found, graph = [], {}
    for name, file in modules.items():
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        layer = LAYERS.index(name.partition(".")[0])
        for node, runs_on_import in walk(ast.parse(file.read_text(encoding="utf-8"))):
            for imported in imported_names(node, package):
                top = imported.partition(".")[0]
                if top in LAYERS[layer + 1 :] or top in NOT_FOR_PRODUCT_CODE:
                    found.append(f"{file.relative_to(root)}:{node.lineno} imports {imported}")
                target = imported if imported in modules else imported.rpartition(".")[0]
                if runs_on_import and target in modules:
                    graph.setdefault(name, set()).add(target)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        found.append("cycle: " + " <- ".join(error.args[1]))
    return found


def test_every_layer_of_the_project_is_looked_at():
    assert {name.partition(".")[0] for name in find_modules(ROOT)} == set(LAYERS)


def test_the_imports_of_the_project_go_one_way():
    assert find_violations(ROOT) == []


def plant(root: Path, sources: dict[str, str]) -> Path:
    """Write a small project: a legal one, with `sources` on top of it."""
    legal = {
        "envs/__init__.py": "from envs.cartpole import CartPole",
        "envs/cartpole.py": "import math\nfrom .system import System",
        "envs/system.py": "",
        "policies/__init__.py": "from envs import CartPole",
        "policies/apg.py": "def train():\n    import policies.evaluate",
        "policies/evaluate.py": "import envs.system\nimport policies.apg",
        "adapt/__init__.py": "from policies import apg",
        "adapt/fewshot.py": "import policies.evaluate, adapt",
    }
    for path, text in (legal | sources).items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text, encoding="utf-8")
    return root


def test_a_legal_project_has_no_violation(tmp_path):
    assert find_violations(plant(tmp_path, {})) == []


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("envs/dynamics.py", "import policies"),
        ("envs/dynamics.py", "import adapt.residual"),
        ("envs/dynamics.py", "from policies.apg import train"),
        ("envs/dynamics.py", "from adapt import fewshot as f"),
        ("envs/dynamics.py", "def f():\n    from policies import apg"),
        ("envs/dynamics.py", "class A:\n    def f(self):\n        import adapt"),
        ("envs/dynamics.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import policies"),
        ("envs/dynamics.py", "import importlib\nimportlib.import_module('policies.apg')"),
        ("envs/deep/er.py", "from policies import apg"),
        ("policies/ppo.py", "try:\n    pass\nfinally:\n    import adapt.residual"),
        ("policies/ppo.py", "import tests.helpers"),
        ("adapt/tables.py", "from tests import helpers"),
    ],
)
def test_an_upward_import_is_found_wherever_it_stands(tmp_path, path, text):
    violations = find_violations(plant(tmp_path, {path: text}))
    assert len(violations) == 1
    assert violations[0].startswith(f"{path}:{len(text.splitlines())} imports ")


@pytest.mark.parametrize(
    "sources",
    [
        {"envs/system.py": "from envs.cartpole import CartPole"},
        {"envs/system.py": "from . import cartpole"},
        {"envs/system.py": "from envs import CartPole"},
        {"envs/system.py": "class A:\n    import envs.cartpole"},
        {
            "envs/system.py": "import envs.a",
            "envs/a.py": "import envs.b",
            "envs/b.py": "if True:\n    import envs.system",
        },
        {"policies/apg.py": "from policies import evaluate"},
    ],
)
def test_a_cycle_is_found(tmp_path, sources):
    violations = find_violations(plant(tmp_path, sources))
    assert len(violations) == 1
    assert violations[0].startswith("cycle: ")


def test_an_import_inside_a_function_closes_no_cycle(tmp_path):
    assert find_violations(plant(tmp_path, {"envs/system.py": "def f():\n    import envs.cartpole"})) == []
