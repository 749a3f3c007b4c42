"""The package is as docs/explanation/architecture.md says: imports run one way, through public faces, folders stay readable."""

import ast
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "experiments"))
import house

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "tau_dyn"
TABLE = re.findall(
    r"^\| `(\w+)(?:/|\.py)` \|", (ROOT / "docs" / "explanation" / "architecture.md").read_text(), re.MULTILINE
)
ROOMS = sorted(
    p.name.removesuffix(".py") for p in SOURCE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()
)
ASIDE = {"__init__", "__main__", "version"}  # they gather names or call the command line; the version is read by all


@pytest.fixture(scope="module")
def modules() -> dict[str, ast.Module]:
    """Return the parsed modules of the package by dotted name."""
    return house.read_modules()


def imported(tree: ast.Module) -> set[str]:
    """Return the rooms that a module imports, anywhere in it."""
    found = set()
    for node in ast.walk(tree):
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
def test_a_room_imports_only_rooms_above_it(room, modules):
    """Imports run one way, so there is no circle."""
    above = set(TABLE[: TABLE.index(room) + 1])
    own = {name: tree for name, tree in modules.items() if house.get_room(name) == room}
    assert own
    odd = {name: sorted(imported(tree) - above) for name, tree in own.items()}
    assert not {name: names for name, names in odd.items() if names}


def test_no_module_imports_itself_by_way_of_others(modules):
    """Circles inside a package count too, also those that only functions or type checkers close."""
    assert house.list_circles(modules) == []


def test_packages_are_entered_through_their_face(modules):
    """A package's modules are its own affair; what others may use stands in its stub."""
    assert house.list_deep_imports(modules) == []


def test_no_folder_holds_more_files_than_a_person_overlooks():
    """More than 25 files mean that a room is missing, or that files are fragments."""
    assert house.list_large_folders() == {}


def test_nobody_asks_what_kind_a_mechanism_is(modules):
    """Robots differ behind the protocol of mechanisms; a branch on their kind elsewhere is a design fault."""
    assert house.list_mechanism_branches(modules) == []
