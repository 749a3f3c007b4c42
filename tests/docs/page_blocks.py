"""A page of documentation as blocks: what its fences hold, what they show, and where.

A page that is executed is read from its top to its end, in one folder:

    ```yaml title="truth.yaml"    a fence with a title is a file
    ```bash                       lines for a shell
    ```python                     Python, in one session a page
    ```text                       right behind either of them: what appeared, compared
    ```sh                         lines for a shell on guides; on tutorials for reading only, as all other fences
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(
    r"^(?P<indent> *)(?P<ticks>```+)(?P<info>[^`\n]*)\n(?P<body>.*?)^(?P=indent)(?P=ticks) *$", re.M | re.S
)
_TITLE = re.compile(r'title="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: First word behind the ticks.
        title: File name, or nothing.
        text: What it holds, without the fence's indentation.
        line: Line of the page on which it begins, from 1.
        start: Where its text begins in the page.
        end: Where it ends.
        behind: Whether only blank lines part it from the block before.
    """

    language: str
    title: str
    text: str
    line: int
    start: int
    end: int
    behind: bool


@dataclass(frozen=True)
class Step:
    """Something that a reader does, and what the page says appears."""

    block: Block
    shown: Block | None


def blocks(page: str) -> list[Block]:
    """Return every fenced block of a page."""
    found, last = [], -1
    for m in _FENCE.finditer(page):
        info, indent = m["info"].strip(), m["indent"]
        title = _TITLE.search(info)
        text = "".join(line.removeprefix(indent) for line in m["body"].splitlines(keepends=True))
        behind = last >= 0 and not page[last : m.start()].strip()
        language = info.split()[0] if info else ""
        line = page.count("\n", 0, m.start()) + 1
        found.append(Block(language, title[1] if title else "", text, line, m.start("body"), m.end("body"), behind))
        last = m.end()
    return found


def steps(page: str, languages: tuple[str, ...] = ("bash", "python")) -> list[Step]:
    """Return what a reader does, in order: titled files, and blocks in these languages."""
    found, all_of_them = [], blocks(page)
    for k, block in enumerate(all_of_them):
        if block.title or block.language in languages:
            following = all_of_them[k + 1] if k + 1 < len(all_of_them) else None
            shows = following is not None and following.language == "text" and following.behind and not block.title
            found.append(Step(block, following if shows else None))
    return found


def commands(text: str) -> list[str]:
    """Return the commands of a shell block, one string each: continued lines joined, comments and prompts left out."""
    joined = re.sub(r"\s*\\\n\s*", " ", text)
    lines = (re.sub(r"(^|\s+)#\s.*$", "", line).strip() for line in joined.splitlines())
    return [line for line in lines if line]


def all_pages() -> list[Path]:
    """Return every page: README, docs, experiments."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "experiments").rglob("*.md"))]
