"""How the terminal is written to: plain text within 100 columns, a margin, bars of block characters.

Nothing is markup, so that no name can style a line or steer the terminal; no line ends in blanks. Colour carries meaning only
(weak values dim, the verdict's level), and disappears when the output is piped. Tables fit 80 columns.
"""

from __future__ import annotations

from collections.abc import Mapping

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

MARGIN = (0, 0, 0, 2)
_LEVEL_STYLE = {"good": "green", "care": "yellow", "poor": "bold red"}
_EIGHTHS = " ▏▎▍▌▋▊▉█"


def build_bare_table() -> Table:
    """Return a table with a dim head and no frame."""
    return Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), pad_edge=False, show_edge=False, header_style="dim")


def draw_meter(share: float, width: int) -> str:
    """Return a bar as long as a share, 0 to 1, of so many columns; an eighth of a column at least."""
    eighths = max(1, round(8 * width * min(max(share, 0.0), 1.0)))
    return "█" * (eighths // 8) + (_EIGHTHS[eighths % 8] if eighths % 8 else "")


def escape_control_characters(text: str, style: str = "") -> Text:
    """Return text without control characters, which a file name could use to steer the terminal."""
    return Text("".join(c if c.isprintable() or c == "\n" else "�" for c in text), style)


def measure_columns(console: Console) -> int:
    """Return how many columns may be used."""
    return min(console.width, 100)


def say(console: Console, text: str, style: str = "") -> None:
    """Print a paragraph after an empty line."""
    put(console, escape_control_characters(text, style))


def say_opening(console: Console, summary: str, headline: str, level: str, sentence: str) -> None:
    """Print how every answer begins: what went in, the headline (none if empty), and how far to trust it, in its colour."""
    say(console, summary, "dim")
    if headline:
        say(console, headline, "bold")
    say(console, sentence, _LEVEL_STYLE[level])


def say_written(console: Console, written: Mapping[str, str] | None) -> None:
    """Print, as the last lines, what was written and where; nothing where nothing was."""
    if written:
        say(console, "\n".join(f"{what} → {path}" for what, path in written.items()))


def put(console: Console, what: Text | Table) -> None:
    """Print a text or a table after an empty line, within the margin and the width there is."""
    console.print()
    options = console.options.update(width=measure_columns(console))
    for line in console.render_lines(Padding(what, MARGIN, expand=False), options, pad=False):
        console.print(Segments([*_trimmed(line), Segment.line()]), end="", no_wrap=True, crop=False)


def _trimmed(line: list[Segment]) -> list[Segment]:
    """Return a line without the blanks at its end."""
    line = list(line)
    while line and not line[-1].text.strip():
        line.pop()
    return [*line[:-1], Segment(line[-1].text.rstrip(), line[-1].style)] if line else []
