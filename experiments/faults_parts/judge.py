"""What a fault may leave: each output as it was or complete, nothing else that shows, and a rerun that gives the same."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path


def contents(folder: Path, names: tuple[str, ...]) -> dict[str, str | None]:
    """Return what stands under some names, None where nothing does; JSON without its times, a page by its end."""
    return {name: _text(folder / name) for name in names}


def _text(path: Path) -> str | None:
    if not path.exists():
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".html":  # pages say when they were made: one that ends as a page does is whole
        return "a whole page" if text.rstrip().endswith("</html>") else text
    if path.suffix == ".json":
        try:
            content = json.loads(text)
        except ValueError:
            return text
        for key in ("seconds", "duration_s", "started"):
            content.pop(key, None)
        return json.dumps(content, sort_keys=True)
    return text


def fault_of(now: dict[str, str | None], old: dict[str, str | None], new: dict[str, str | None]) -> str:
    """Return what is wrong with what stands now, or nothing."""
    for name, text in now.items():
        if text not in (old[name], new[name]):
            return f"{name} is neither what it was nor complete ({len(text or '')} characters)"
    return ""


def left_over(folder: Path, known: set[str]) -> list[str]:
    """Return names in a folder that nobody asked for."""
    return sorted(p.name for p in folder.iterdir() if p.name not in known)


def table(title: str, outcomes: Counter[str]) -> str:
    """Return outcomes and how often each was seen, most frequent first."""
    total = sum(outcomes.values())
    rows = [f"  {count:5d}  {what}" for what, count in outcomes.most_common()]
    return "\n".join([f"{title}: {total} tried", *rows])
