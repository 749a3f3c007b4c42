"""A presentation in a notebook: headline, verdict, tables and a few small drawings, and its data as a table.

The page (`write_report`) holds the complete result. Drawings and their style are those of the page. The style is scoped to the
view, so that it does not change the rest of the notebook, and follows the notebook's light or dark theme. There is no script.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from tau_dyn.render.chart import format_tag
from tau_dyn.render.markup import build_table, draw
from tau_dyn.render.presentation import present
from tau_dyn.results import Figures, Listing, On, Presentation, ResultTable, Text, replace_plus_minus

if TYPE_CHECKING:
    import pandas as pd

DARK = ('body[data-jp-theme-light="false"]', "body.vscode-dark", 'html[theme="dark"]', '[data-theme="dark"]')
"""CSS selectors of the dark theme in JupyterLab, VS Code, Colab and documentation."""
MAX_ROWS = 16
"""Number of rows above which the rest is collapsed."""
WIDE = 480
"""Width above which a drawing counts as wide [px at 100 %]."""
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # a file name may hold control characters for a terminal
_DRAWN = re.compile(
    r"\.(?:chart|bar|bar-[a-z]+|grid|zero|meter|robot|rail|rod|plate|cart|joint-name|triad|triad-name|shape|swinging|scale|vectors)"
    r"(?![\w-])"
)
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")


def render_notebook(result: Any) -> str:
    """Return the HTML of a result in a notebook.

    Raises:
        InputError: The result has no presentation.
    """
    shown = present(result)
    pieces = [Markup("<style>") + Markup(_get_style()) + Markup("</style>")]  # noqa: S704 our own files
    pieces.append(format_tag("p", format_tag("b", shown.kind), f" {shown.about}", class_="kicker"))
    if shown.headline:
        level, badge = ("", "") if shown.verdict is None else (shown.verdict.level, shown.verdict.badge)
        said = format_tag("span", badge) if badge else ""
        pieces.append(format_tag("p", said, " ", shown.headline, class_=f"headline {level}"))
    pictures: list[Markup] = []
    for block in shown.list_blocks(On.NOTEBOOK):
        if isinstance(block, ResultTable):
            pieces += _build_tables(block)
        elif isinstance(block, Figures):
            pictures += map(_size, filter(None, map(draw, block.drawings)))
        elif isinstance(block, Text):
            pieces.append(format_tag("p", block.text))
        elif isinstance(block, Listing):
            pieces += [format_tag("p", item) for item in block.items]
    pieces += [format_tag("div", *pictures, class_="pictures")] if pictures else []
    sentence = [shown.verdict.sentence] if shown.verdict is not None and shown.verdict.sentence else []
    pieces += [
        format_tag("p", replace_plus_minus(note), class_="note") for note in (*sentence, *shown.notes, *shown.warnings)
    ]
    return _CONTROL.sub("\ufffd", format_tag("div", *pieces, class_="tau-dyn"))


def tabulate(result: Any) -> pd.DataFrame:
    """Return a result's main table as a pandas frame.

    Raises:
        InputError: It is no result.
    """
    return build_frame(present(result))


def build_frame(shown: Presentation) -> pd.DataFrame:
    """Return a presentation's data as a pandas frame."""
    import pandas as pd

    rows = shown.data()
    return rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(rows)


def _build_tables(table: ResultTable) -> list[Markup]:
    """Return a table; rows after the first ones are collapsed."""
    rows = [row for row in table.all_rows if row.on & On.NOTEBOOK]
    if len(rows) <= MAX_ROWS + 2:
        return [build_table(replace(table, rows=rows, groups=(), style=""), On.NOTEBOOK)]
    first, rest = (replace(table, rows=part, groups=(), style="") for part in (rows[:MAX_ROWS], rows[MAX_ROWS:]))
    folded = format_tag("summary", f"and {len(rows) - MAX_ROWS} more"), build_table(rest, On.NOTEBOOK)
    return [build_table(first, On.NOTEBOOK), format_tag("details", *folded)]


def _size(picture: Markup) -> Markup:
    """Return a drawing; a wide one gets the space of several."""
    size = re.search(r'viewBox="0 0 (\d+)', picture)
    if size is None or int(size[1]) < WIDE:
        return picture
    return Markup(str(picture).replace('class="', 'class="wide ', 1))  # noqa: S704 our own drawing


@cache
def _get_style() -> str:
    """Return the style of a view: its own rules, and those of the page that begin with a class of a drawing."""
    page, own = (
        files("tau_dyn.render").joinpath("templates", f"{n}.css").read_text("utf-8") for n in ("page", "notebook")
    )
    light, dark = (
        re.sub(r"color-scheme:[^;]*;", "", text).strip() for text in re.findall(r":root \{(.*?)\}", page, re.DOTALL)
    )
    rules = [f".tau-dyn {{ {light} }}", f"{', '.join(f'{s} .tau-dyn' for s in DARK)} {{ {dark} }}", own]
    for selectors, body in _RULE.findall(_COMMENT.sub("", page.split("@media print")[0])):
        parts = [s.strip() for s in selectors.split(",")]
        if all(_DRAWN.match(part) for part in parts):
            rules.append(f"{', '.join(f'.tau-dyn {part}' for part in parts)} {{{body}}}")
    return "\n".join(rules)
