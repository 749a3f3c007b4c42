"""The result protocol: headline, verdict, sections of tables, figures and sentences, warnings, where it came from, data.

A result is presented once, as a `Presentation`; terminal, page, notebook and JSON render that. A block says on which of them it
stands (`On`). Sections are made when a renderer asks for them, so that a terminal does not pay for a page's figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Flag, auto
from typing import Any, Literal, NamedTuple

from tau_dyn.results.figures import Drawing, View

Level = Literal["good", "care", "poor"]


class On(Flag):
    """Where a block or a column stands."""

    PAGE = auto()
    TERMINAL = auto()
    NOTEBOOK = auto()
    SCREENS = TERMINAL | NOTEBOOK
    DRAWN = PAGE | NOTEBOOK
    PRINTED = PAGE | TERMINAL
    ALL = PAGE | TERMINAL | NOTEBOOK


class Verdict(NamedTuple):
    """How far a result may be used: in a colour, in one sentence, and in a word or three."""

    level: Level
    sentence: str
    badge: str = ""


def judge(level: Level, sentence: str, badges: Mapping[str, str]) -> Verdict:
    """Return a verdict with the badge of its level."""
    return Verdict(level, sentence, badges[level])


class Key(NamedTuple):
    """What a colour or a mark of a figure means."""

    ink: str
    words: str


def build_key(**meanings: str) -> list[Key]:
    """Return what inks mean, by their names."""
    return [Key(ink, words) for ink, words in meanings.items()]


@dataclass(frozen=True)
class Bar:
    """A bar from 0 to 1, or a stretch of one.

    Attributes:
        share: Where it ends.
        start: Where it begins.
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
        share: What it leaves.
        low: Lower end of the 95 % interval.
        high: Upper end.
        previous: What the step before leaves; NaN for none.
        floor: Where the noise floor lies; NaN for none.
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
        at: The estimate; None where it lies off the scale.
        trust: Half-width of what the reference is trusted to; 0 for none.
        state: `weak` for one that is drawn pale.
        anchored: Whether the reference is marked.
    """

    low: float
    high: float
    at: float | None
    trust: float = 0.0
    state: str = ""
    anchored: bool = False


Cell = str | Bar | StepBar | IntervalBar | Verdict | tuple[str, ...] | None
"""Text, a bar, a badge, pieces of text of which the last are left out where there is no room, or nothing."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: Its head.
        kind: `text`, `number` (to the right, never broken), `bar`, `interval`, `step`, or `unit`.
        style: How the page sets it off: `strong`, `quiet`, `remark`, `big`, `wide`, `share`.
        on: Where it stands.
        spare: Whether a terminal that is too narrow leaves it out, rather than breaking it.
        kept: Whether it is repeated where a terminal splits a table that is too wide; without any, none is split.
        scale: What the ends of an interval's bar stand for, such as `20 %`.
        cell: Gives its cell of a thing; see `tabulate_things`.
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
        cells: One a column.
        style: How it is set off: `known`, `weak`, `unseen`, `quiet`, `good`, `care`, `poor`, `cause`, `floor`, ...
        link: Section that the first cell leads to; empty for none.
        on: Where it stands.
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
        groups: Rows under headings of their own.
        style: `plain`, `parameters`, `waterfall`, `findings`, `matrix`, `fitted`, ...
        caption: What stands above it.
        most: Rows that a terminal shows at most; 0 for all.
        rest: What a terminal says of the others, after `and N`.
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
        """Every row, headings left out."""
        return [*self.rows, *(row for _, rows in self.groups for row in rows)]


def tabulate_things(
    things: Iterable[Any],
    *columns: Column,
    state: Callable[[Any], str] = lambda thing: "",
    link: Callable[[Any], str] = lambda thing: "",
    **about: Any,
) -> ResultTable:
    """Return a table of one row a thing.

    Args:
        things: What it is of.
        columns: Its columns; each one's `cell` gives its cell of a thing.
        state: Gives the style of a thing's row.
        link: Gives the section that a thing's first cell leads to.
        about: What else a `ResultTable` takes.
    """
    rows = [Row([column.cell(thing) for column in columns], state(thing), link(thing)) for thing in things]
    return ResultTable(columns, rows, **about)


def tabulate_plainly(rows: Iterable[Sequence[Cell]], *, style: str = "plain", on: On = On.PAGE) -> ResultTable:
    """Return rows of equal length without heads."""
    rows = list(rows)
    return ResultTable([Column() for _ in rows[0]] if rows else [], [Row(cells) for cells in rows], style=style, on=on)


def list_numbers(*titles: str, on: On = On.ALL) -> list[Column]:
    """Return columns of numbers with these heads."""
    return [Column(title, "number", on=on) for title in titles]


@dataclass(frozen=True)
class Text(Element):
    """A paragraph: plain, a `note`, the `lead` of a card, a `law` (formula), or `dim` on a terminal; a heading if `heading`."""

    text: str
    style: str = ""


def explain(text: str, *, on: On = On.PAGE) -> Text:
    """Return the note that says how to read what stands above it."""
    return Text(text, "note", on=on)


@dataclass(frozen=True)
class Listing(Element):
    """Sentences under a title; a terminal writes a single one behind it. `code` if they are formulas."""

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
    """Terms and what there is to say of them."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Figures(Element):
    """Drawings beside each other.

    Attributes:
        drawings: What is drawn, with a caption each where there is one.
        layout: `charts`, `wide`, `pair`, `row`, `maps`, `columns-1` to `columns-3`, `shapes`.
        key: What inks mean.
        captions: A title and a line below each drawing; empty for none.
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
        about: What it shows, for screen readers.
        views: Its stretches.
        key: What inks mean.
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
    """Blocks in a box of their own, such as `multiples`."""

    blocks: Sequence[Element]
    style: str


@dataclass(frozen=True)
class Folded(Element):
    """Blocks that are folded away under a summary."""

    summary: str
    blocks: Sequence[Element]
    open: bool = False


@dataclass(frozen=True)
class Chapter:
    """A part of a presentation.

    Attributes:
        name: Its anchor.
        title: Its heading; empty for none.
        make: Gives its blocks, when somebody asks.
        on: Where it stands, if any of its blocks does.
        style: `warnings`, `card`, `card unexplained`, `beside`.
        badge: A word with its level behind the heading.
        number: A number before it, such as a finding's.
        folded: Whether it is folded away.
        open: Whether it is shown all the same, to be folded by hand.
        when: Whether there is anything to show; without, it is left out.
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
        """Return the blocks that stand there."""
        if not (self.when and self.on & on):
            return []
        blocks = (
            self.make() if on is On.PAGE else spread_blocks(self.make())
        )  # only a page has them side by side or folded
        return [block for block in blocks if block.on & on]


def spread_blocks(blocks: Iterable[Element]) -> Iterable[Element]:
    """Give blocks one after the other, those in boxes of others, too."""
    for block in blocks:
        if not isinstance(block, Beside | Folded | Group):
            yield block
        else:
            yield from spread_blocks([*block.left, *block.right] if isinstance(block, Beside) else block.blocks)


@dataclass(frozen=True)
class Provenance:
    """Where a result came from.

    Attributes:
        facts: Names and texts, such as `seed` and `0`.
        logs: Use, name and hash of every file that went in.
        robot: The robot that it is of; None for none.
    """

    facts: Sequence[tuple[str, str]] = ()
    logs: Sequence[tuple[str, str, str]] = ()
    robot: Any = None


@dataclass(frozen=True)
class Presentation:
    """All that is shown of a result.

    Attributes:
        kind: What it is, in a word or two.
        about: What it is of.
        title: Of a window that shows it.
        headline: The one sentence above everything; empty for none.
        verdict: How far it may be used; None where nothing is judged.
        summary: What went in.
        sections: Its parts.
        warnings: Its warnings.
        picture: The robot, or None.
        provenance: Where it came from.
        data: Gives the main table, one row a thing, in SI units: rows by name, or a pandas frame.
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
        """Return all blocks that stand there, in order."""
        return [block for section in self.sections for block in section.list_blocks(on)]
