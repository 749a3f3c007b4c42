"""A tutorial as a Jupyter notebook: the same steps in the same order, with what the page shows as output.

Fences become cells as `tests/docs/page_blocks.py` reads them: a title writes a file, `bash` runs in a shell, `python` runs in
the kernel, and `text` right behind one of them is its output. All else stays text.
"""

from __future__ import annotations

import json
import re
from typing import Any

_FENCE = re.compile(r"^(?P<ticks>```+)(?P<info>[^`\n]*)\n(?P<body>.*?)^(?P=ticks) *$", re.M | re.S)
_TITLE = re.compile(r'title="([^"]+)"')
_RELATIVE_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)[^)]*\)")


def build_notebook(page: str) -> str:
    """Return a page as a notebook of format 4.5."""
    cells: list[dict[str, Any]] = []
    at = 0
    for m in _FENCE.finditer(page):
        text, info = page[at : m.start()], m["info"].strip()
        source, behind = _source(info, m["body"]), bool(cells) and not text.strip()
        if source is None and not (info == "text" and behind and cells[-1]["cell_type"] == "code"):
            continue  # for reading only: it stays part of the text
        _add_text(cells, text)
        if source is None:
            cells[-1]["outputs"] = [{"output_type": "stream", "name": "stdout", "text": m["body"]}]
        else:
            empty: dict[str, Any] = {"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": []}
            cells.append(empty | {"source": source})
        at = m.end() + 1
    _add_text(cells, page[at:])
    for k, cell in enumerate(cells):
        cell["id"] = f"cell-{k}"
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return json.dumps(
        {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}, indent=1
    )


def _source(info: str, body: str) -> str | None:
    """Return the code of a cell, or nothing where a fence is for reading."""
    title = _TITLE.search(info)
    if title:
        return f"%%writefile {title[1]}\n{body}".rstrip("\n")
    language = info.split()[0] if info else ""
    return {"bash": f"%%bash\n{body}", "python": body}.get(language, "").rstrip("\n") or None


def _add_text(cells: list[dict[str, Any]], text: str) -> None:
    """Append a cell of text; links within the site are plain words there."""
    plain = _RELATIVE_LINK.sub(r"\1", text).strip()
    if plain:
        cells.append({"cell_type": "markdown", "metadata": {}, "source": plain})
