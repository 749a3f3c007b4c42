"""A file as people have it and its expected result; how rows become bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Case:
    """A file and its expected result.

    Attributes:
        kind: Clock and oddity, for the table.
        described: All that was drawn.
        path: The file.
        names: Names of its files, one of which a refusal has to give.
        t: Times that have to come back (N,) [s]; compared from their first.
        channels: Values that have to come back, each (N,), or a function of time.
        map: Column map, or None.
        codes: Codes of refusals that are true of the file; None if it has to be read.
        words: One of these words has to be in the refusal.
        must_refuse: Whether reading it is wrong.
        clock_error: Largest error of times [s].
        errors: Largest error of a channel, by its name.
        frozen: Column that never changes although the joint moves; empty if there is none.
        turns: Whether a joint makes many turns.
        bad_clock: Whether `check` has to find fault with the clock.
        robot: Joints, for a proposal of columns.
    """

    kind: str
    described: str
    path: Path
    names: tuple[str, ...]
    t: np.ndarray
    channels: Mapping[str, Any]
    map: Path | None = None
    codes: tuple[str, ...] | None = None
    words: tuple[str, ...] = ()
    must_refuse: bool = False
    clock_error: float = 2e-6
    errors: Mapping[str, float] = field(default_factory=dict)
    frozen: str = ""
    turns: bool = False
    bad_clock: bool = False
    robot: Any = None


@dataclass(frozen=True)
class Layout:
    """How rows become bytes."""

    separator: str = ","
    decimal: str = "."
    quoted: bool = False
    encoding: str = "utf-8"
    line_end: str = "\n"
    above: str = ""
    below: str = ""
    end: str = ""
    last: str = ""

    def write(self, path: Path, head: list[str], rows: list[list[str]]) -> None:
        """Write a header and rows of texts; numbers have their decimal sign already."""

        def join(cells: list[str]) -> str:
            cells = [f'"{c}"' for c in cells] if self.quoted else cells
            return self.separator.join(cells) + self.end

        units = [self.separator.join([self.below] * len(head)) + self.end] if self.below else []
        lines = [join(head), *units, *(join(row) for row in rows)]
        text = self.above + "\n".join(lines) + "\n" + self.last
        path.write_bytes(text.replace("\n", self.line_end).encode(self.encoding))
