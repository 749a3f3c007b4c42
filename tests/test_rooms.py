"""The package is as docs/explanation/architecture.md says: every package is in its table and imports only packages above it."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "tau_dyn"
TABLE = re.findall(
    r"^\| `(\w+)(?:/|\.py)` \|", (ROOT / "docs" / "explanation" / "architecture.md").read_text(), re.MULTILINE
)
ROOMS = sorted(
    p.name.removesuffix(".py") for p in SOURCE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()
)
ASIDE = {"__init__", "__main__", "version"}  # they gather names or call the command line; the version is read by all


def imported(path: Path) -> set[str]:
    """Return the rooms that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "tau_dyn":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tau_dyn."):
            found.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("tau_dyn.")}
    return found - ASIDE


def test_every_room_stands_in_the_table():
    """No room without a line, no line without a room."""
    assert sorted(TABLE) == sorted(set(ROOMS) - ASIDE)


@pytest.mark.parametrize("room", [room for room in ROOMS if room not in ASIDE])
def test_a_room_imports_only_rooms_above_it(room):
    """Imports run one way, so there is no circle."""
    above = set(TABLE[: TABLE.index(room) + 1])
    files = [SOURCE / f"{room}.py"] if (SOURCE / f"{room}.py").exists() else (SOURCE / room).rglob("*.py")
    odd = {str(path.relative_to(SOURCE)): sorted(imported(path) - above) for path in files}
    assert not {path: names for path, names in odd.items() if names}
