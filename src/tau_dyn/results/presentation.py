"""The result protocol: headline, verdict, sections of tables, figures and sentences, warnings, provenance, data.

A result is presented once, as a `Presentation`; terminal, page, notebook and JSON render that. A block lists the media on which
it appears (`On`). Sections are made when a renderer requests them, so that a terminal does not compute a page's figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Flag, auto
from typing import Any, Literal, NamedTuple

from tau_dyn.results.figures import Drawing, View

Level = Literal["good", "care", "poor"]


class On(Flag):
    """Media on which a block or a column appears."""

    PAGE = auto()
    TERMINAL = auto()
    NOTEBOOK = auto()
    SCREENS = TERMINAL | NOTEBOOK
    DRAWN = PAGE | NOTEBOOK
    PRINTED = PAGE | TERMINAL
    ALL = PAGE | TERMINAL | NOTEBOOK


class Verdict(NamedTuple):
    """Usability of a result: as a colour, one sentence, and a badge of one to three words."""

    level: Level
    sentence: str
    badge: str = ""


def judge(level: Level, sentence: str, badges: Mapping[str, str]) -> Verdict:
    """Return a verdict with the badge of its level."""
    return Verdict(level, sentence, badges[level])


class Key(NamedTuple):
    """Meaning of a colour or a mark of a figure."""

    ink: str
    words: str


def build_key(**meanings: str) -> list[Key]:
    """Return the meanings of inks, by their names."""
    return [Key(ink, words) for ink, words in meanings.items()]


@dataclass(frozen=True)
class Bar:
    """A bar from 0 to 1, or a stretch of one.

    Attributes:
        share: Its end.
        start: Its start.
        tick: A mark on it, such as the training error under the held-out one.
        ink: Its colour's name; empty for the usual one.
    """

    share: float
    start: float = 0.0
    tick: float | None = None
    ink: str = ""


@dataclass(frozen=True)
class StepBar:
    """A step of a waterfall, all lengths as shares of the axis.

    Attributes:
        share: The remaining error.
        low: Lower end of the 95 % interval.
        high: Upper end.
        previous: The remaining error of the previous step; NaN for the first one.
        floor: The noise floor; NaN if unknown.
        kind: `start`, `cause` or `floor`.
    """

    share: float
    low: float
    high: float
    previous: float
    floor: float
    kind: str


@dataclass(frozen=True)
class IntervalBar:
    """An estimate and its 95 % interval around a reference, as shares of the scale from -1 to 1.

    Attributes:
        low: Lower end of the interval, cut at -1.
        high: Upper end, cut at 1.
        at: The estimate; None if it is off the scale.
        trust: Half-width of the reference's own interval; 0 if it has no interval.
        state: `weak` for a pale one.
        anchored: Whether the reference is marked.
    """

    low: float
    high: float
    at: float | None
    trust: float = 0.0
    state: str = ""
    anchored: bool = False


Cell = str | Bar | StepBar | IntervalBar | Verdict | tuple[str, ...] | None
"""Text, a bar, a badge, pieces of text of which the last are left out if there is no room, or None."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: Its heading.
        kind: `text`, `number` (to the right, never broken), `bar`, `interval`, `step`, or `unit`.
        style: Its style on the page: `strong`, `quiet`, `remark`, `big`, `wide`, `share`.
        on: Media on which it appears.
        spare: Whether a terminal that is too narrow leaves it out, instead of breaking it.
        kept: Whether it is repeated if a terminal splits a table that is too wide; a table without such a column is not split.
        scale: Value at the ends of an interval's bar, such as `20 %`.
        cell: Function that returns the cell of a thing; see `tabulate_things`.
    """

    title: str = ""
    kind: Literal["text", "number", "bar", "interval", "step", "unit"] = "text"
    style: str = ""
    on: On = On.ALL
    spare: bool = False
    kept: bool = False
    scale: str = ""
    cell: Callable[[Any], Cell] = str


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        cells: One cell per column.
        style: Its style: `known`, `weak`, `unseen`, `quiet`, `good`, `care`, `poor`, `cause`, `floor`, ...
        link: Section that the first cell links to; empty without a link.
        on: Media on which it appears.
    """

    cells: Sequence[Cell]
    style: str = ""
    link: str = ""
    on: On = On.ALL


@dataclass(frozen=True, kw_only=True)
class Element:
    """A part of a section."""

    on: On = On.PAGE


@dataclass(frozen=True)
class ResultTable(Element):
    """Rows under headings.

    Attributes:
        columns: Its columns.
        rows: Its rows, without headings between them.
        groups: Rows under their own headings.
        style: `plain`, `parameters`, `waterfall`, `findings`, `matrix`, `fitted`, ...
        caption: Caption above it.
        most: Largest number of rows on a terminal; 0 for all.
        rest: Text of a terminal for the other rows, after `and N`.
    """

    columns: Sequence[Column]
    rows: Sequence[Row] = ()
    groups: Sequence[tuple[str, Sequence[Row]]] = ()
    style: str = ""
    caption: str = ""
    most: int = 0
    rest: str = "more, all in --json and --report."

    @property
    def all_rows(self) -> list[Row]:
        """Every row, without headings."""
        return [*self.rows, *(row for _, rows in self.groups for row in rows)]


def tabulate_things(
    things: Iterable[Any],
    *columns: Column,
    state: Callable[[Any], str] = lambda thing: "",
    link: Callable[[Any], str] = lambda thing: "",
    **about: Any,
) -> ResultTable:
    """Return a table with one row per thing.

    Args:
        things: The objects, one per row.
        columns: Its columns; each one's `cell` returns the cell of a thing.
        state: Function that returns the style of a thing's row.
        link: Function that returns the section that a thing's first cell links to.
        about: Further arguments of `ResultTable`.
    """
    rows = [Row([column.cell(thing) for column in columns], state(thing), link(thing)) for thing in things]
    return ResultTable(columns, rows, **about)


def tabulate_plainly(rows: Iterable[Sequence[Cell]], *, style: str = "plain", on: On = On.PAGE) -> ResultTable:
    """Return rows of equal length without column headings."""
    rows = list(rows)
    return ResultTable([Column() for _ in rows[0]] if rows else [], [Row(cells) for cells in rows], style=style, on=on)


def list_numbers(*titles: str, on: On = On.ALL) -> list[Column]:
    """Return columns of numbers with these headings."""
    return [Column(title, "number", on=on) for title in titles]


@dataclass(frozen=True)
class Text(Element):
    """A paragraph: plain, a `note`, the `lead` of a card, a `law` (formula), or `dim` on a terminal; a heading if `heading`."""

    text: str
    style: str = ""


def explain(text: str, *, on: On = On.PAGE) -> Text:
    """Return the note that explains how to read the block above it."""
    return Text(text, "note", on=on)


@dataclass(frozen=True)
class Listing(Element):
    """Sentences under a title; a terminal writes a single one after it. `code` if they are formulas."""

    items: Sequence[str]
    title: str = ""
    style: str = ""


@dataclass(frozen=True)
class Facts(Element):
    """Figures in large type: words, number, unit."""

    rows: Sequence[tuple[str, str, str]]
    style: str = ""


@dataclass(frozen=True)
class Definitions(Element):
    """Terms and their descriptions."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Figures(Element):
    """Drawings next to each other.

    Attributes:
        drawings: The drawings, each with an optional caption.
        layout: `charts`, `wide`, `pair`, `row`, `maps`, `columns-1` to `columns-3`, `shapes`.
        key: Meanings of inks.
        captions: A title and a line below each drawing; may be empty.
    """

    drawings: Sequence[Drawing]
    layout: str = "charts"
    key: Sequence[Key] = ()
    captions: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class Division(Element):
    """A bar that is divided into named parts: ink, words, share from 0 to 1."""

    parts: Sequence[tuple[str, str, float]]


@dataclass(frozen=True)
class TimeView(Element):
    """The zoomable time view.

    Attributes:
        about: Description of the contents, for screen readers.
        views: Its stretches.
        key: Meanings of inks.
    """

    about: str
    views: Sequence[View]
    key: Sequence[Key]


@dataclass(frozen=True)
class Beside(Element):
    """Two groups of blocks side by side: `columns`, `glance`, `evidence`, `two` or `beside`."""

    left: Sequence[Element]
    right: Sequence[Element]
    style: str = "columns"


@dataclass(frozen=True)
class Group(Element):
    """Blocks in a separate box, such as `multiples`."""

    blocks: Sequence[Element]
    style: str


@dataclass(frozen=True)
class Folded(Element):
    """Blocks that are folded under a summary."""

    summary: str
    blocks: Sequence[Element]
    open: bool = False


@dataclass(frozen=True)
class Chapter:
    """A part of a presentation.

    Attributes:
        name: Its anchor.
        title: Its heading; may be empty.
        make: Function that returns its blocks, called by renderers.
        on: Media on which it appears, if any of its blocks does.
        style: `warnings`, `card`, `card unexplained`, `beside`.
        badge: A word with its level after the heading.
        number: A number before it, such as a finding's.
        folded: Whether it can be folded.
        open: Whether it is unfolded at first.
        when: Whether it has content; otherwise it is left out.
    """

    name: str
    title: str
    make: Callable[[], Iterable[Element]]
    on: On = On.PAGE
    style: str = ""
    badge: Verdict | None = None
    number: int = 0
    folded: bool = False
    open: bool = False
    when: bool = True

    def list_blocks(self, on: On) -> list[Element]:
        """Return the blocks that appear on a medium."""
        if not (self.when and self.on & on):
            return []
        blocks = (
            self.make() if on is On.PAGE else spread_blocks(self.make())
        )  # only a page shows them in columns or folded
        return [block for block in blocks if block.on & on]


def spread_blocks(blocks: Iterable[Element]) -> Iterable[Element]:
    """Yield blocks in order, including those in boxes of others."""
    for block in blocks:
        if not isinstance(block, Beside | Folded | Group):
            yield block
        else:
            yield from spread_blocks([*block.left, *block.right] if isinstance(block, Beside) else block.blocks)


@dataclass(frozen=True)
class Provenance:
    """Provenance of a result.

    Attributes:
        facts: Names and texts, such as `seed` and `0`.
        logs: Use, name and hash of every input file.
        robot: Its robot, or None.
    """

    facts: Sequence[tuple[str, str]] = ()
    logs: Sequence[tuple[str, str, str]] = ()
    robot: Any = None


@dataclass(frozen=True)
class Presentation:
    """All displayed contents of a result.

    Attributes:
        kind: Kind of result, in a word or two.
        about: Subject of the result.
        title: Title of a window that shows it.
        headline: One sentence above all other contents; may be empty.
        verdict: Usability of the result; None if it is not judged.
        summary: Summary of the inputs.
        sections: Its parts.
        warnings: Its warnings.
        picture: The robot, or None.
        provenance: Its provenance.
        data: Function that returns the main table, one row per thing, in SI units: rows by name, or a pandas frame.
        result: The result itself.
        notes: Sentences below a notebook's view, before the warnings.
    """

    kind: str
    about: str
    title: str
    headline: str = ""
    verdict: Verdict | None = None
    summary: str = ""
    sections: Sequence[Chapter] = ()
    warnings: Sequence[str] = ()
    picture: Drawing | None = None
    provenance: Provenance = field(default_factory=Provenance)
    data: Callable[[], Any] = list
    result: Any = None
    notes: Sequence[str] = ()

    def list_blocks(self, on: On) -> list[Element]:
        """Return all blocks that appear on a medium, in order."""
        return [block for section in self.sections for block in section.list_blocks(on)]
