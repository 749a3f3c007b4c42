"""Data of the core rooms is frozen, and what holds arrays is compared by identity: results may be shared without a copy."""

import ast
import re
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "tau_dyn"
CORE = ("log", "robot", "effects", "dynamics", "model.py", "estimate", "identify")
MOVES = {"Data"}  # keeps what it has built


class Kept(NamedTuple):
    """A class of data: how it is declared, and the words of its fields' types."""

    name: str
    frozen: bool
    compared: bool
    holds: set[str]


@lru_cache
def kept(room: str) -> tuple[Kept, ...]:
    """Return the classes of data of a room."""
    path, found = SOURCE / room, []
    for file in [path] if path.suffix else sorted(path.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            for mark in node.decorator_list if isinstance(node, ast.ClassDef) else ():
                if ast.unparse(mark).startswith("dataclass"):
                    words = mark.keywords if isinstance(mark, ast.Call) else []
                    how = {word.arg: ast.literal_eval(word.value) for word in words}
                    types = " ".join(ast.unparse(x.annotation) for x in node.body if isinstance(x, ast.AnnAssign))
                    holds = set(re.findall(r"\w+", types))
                    found.append(Kept(node.name, how.get("frozen", False), how.get("eq", True), holds))
    return tuple(found)


@pytest.mark.parametrize("room", CORE)
def test_data_is_frozen(room):
    """A result that can be written to is not the fit's any more."""
    assert [x.name for x in kept(room) if not x.frozen and x.name not in MOVES] == []


@pytest.mark.parametrize("room", CORE)
def test_what_holds_arrays_is_compared_by_identity(room):
    """`a == b` would compare arrays and fail; so with what holds something that holds arrays."""
    apart = {"ndarray"} | {x.name for other in CORE for x in kept(other) if not x.compared}
    assert [x.name for x in kept(room) if x.compared and x.holds & apart] == []
