"""Every place of a room's code where cosmic-ray can break it, and a sample of them.

Annotations are left alone (nobody evaluates them), so are docstrings and the `__init__` files, which only name things.
"""

from __future__ import annotations

import ast
import random
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast_from_path

SKIPPED = ("no-op", "variable", "Bit", "LShift", "RShift", "USub_Not", "UAdd", "Invert")
"""Operators that change nothing, that need names given to them, or that numbers do not have: any test would kill those."""


@dataclass(frozen=True)
class Mutant:
    """One way to break one place.

    Attributes:
        module: File, relative to `src/tau_dyn`.
        operator: cosmic-ray's name of the change.
        occurrence: Which of the places that this operator finds in the file.
        line: Where.
    """

    module: str
    operator: str
    occurrence: int
    line: int

    @property
    def name(self) -> str:
        """A name that no other mutant has."""
        return f"{self.module}:{self.line}:{self.operator}:{self.occurrence}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return asdict(self)


def sampled(package: Path, room: str, count: int, seed: int) -> list[Mutant]:
    """Return a random sample of a room's mutants; `room` is a folder or a file of the package.

    Places are drawn first, then what is done to them, so that a sum, which can become six things, does not count six times.
    """
    path = package / room
    files = [path] if path.suffix == ".py" else sorted(f for f in path.rglob("*.py") if f.name != "__init__.py")
    places: dict[tuple[str, int, str], list[Mutant]] = {}
    for mutant in (m for file in files for m in mutants_of(package, file)):
        places.setdefault((mutant.module, mutant.line, mutant.operator.split("_")[0]), []).append(mutant)
    draw = random.Random(f"{seed} {room}")
    chosen = draw.sample(sorted(places), min(count, len(places)))
    return [draw.choice(places[place]) for place in chosen]


def mutants_of(package: Path, file: Path) -> Iterator[Mutant]:
    """Yield all mutants of a file."""
    nodes, quiet = list(ast_nodes(get_ast_from_path(file))), _quiet_lines(file)
    for name in cosmic_ray.plugins.operator_names():
        operator = cosmic_ray.plugins.get_operator(name)
        if any(word in name for word in SKIPPED) or operator.arguments():
            continue
        places = [place for node in nodes for place in operator().mutation_positions(node)]
        for occurrence, (start, _) in enumerate(places):
            if not any(a <= start < b for a, b in quiet):
                yield Mutant(file.relative_to(package).as_posix(), name, occurrence, start[0])


def _quiet_lines(file: Path) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return where annotations begin and end, as (line, column)."""
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        notes = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        found += [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in notes if n is not None]
    return found
