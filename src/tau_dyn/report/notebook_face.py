"""What a result looks like in a notebook, before it is markup."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup


@dataclass(frozen=True)
class Row:
    """A line of a table: its cells, text or drawings, and `good`, `care` or `poor` where it is marked."""

    cells: Sequence[str | Markup]
    level: str = ""


@dataclass(frozen=True)
class Face:
    """What a notebook shows.

    Attributes:
        kind: What it is, in a word or two.
        about: What it is of.
        headline: The one sentence; empty for none.
        level: `good`, `care` or `poor`.
        badge: The judgement in a word or three; empty for none.
        columns: The table's head.
        rows: The table.
        pictures: Drawings.
        notes: Sentences below.
        styles: Pages whose drawings are shown, by the name of their template.
    """

    kind: str
    about: str = ""
    headline: str = ""
    level: str = ""
    badge: str = ""
    columns: Sequence[str] = ()
    rows: Sequence[Row] = ()
    pictures: Sequence[Markup] = ()
    notes: Sequence[str] = ()
    styles: tuple[str, ...] = ()
