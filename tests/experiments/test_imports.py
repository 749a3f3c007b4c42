"""Every name that an experiment imports exists: a renamed function leaves no script behind that nobody runs."""

from __future__ import annotations

import ast
import importlib
from importlib.util import find_spec
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"


def list_top_names(path: Path) -> set[str]:
    """Return the names that a module of the experiments defines or imports at its top level."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
    return names


def find_missing(path: Path) -> list[str]:
    """Return the imports of a script from `tau_dyn` or its neighbours that name nothing."""
    missing = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or node.level or not node.module:
            continue
        wanted = [alias.name for alias in node.names]
        near = [folder / f"{node.module.replace('.', '/')}.py" for folder in (path.parent, EXPERIMENTS)]
        if node.module.partition(".")[0] == "tau_dyn":
            module = importlib.import_module(node.module)
            unknown = [f"{node.module}.{name}" for name in wanted if not hasattr(module, name)]
            missing += [name for name in unknown if find_spec(name) is None]  # a submodule has a file
        elif found := next((one for one in near if one.is_file()), None):
            known = list_top_names(found)
            missing += [f"{node.module}.{name}" for name in wanted if name not in known]
    return missing


@pytest.mark.parametrize(
    "path", sorted(EXPERIMENTS.rglob("*.py")), ids=lambda path: path.relative_to(EXPERIMENTS).as_posix()
)
def test_an_experiment_imports_only_what_exists(path: Path) -> None:
    """An experiment whose import fails measures nothing."""
    assert find_missing(path) == []
