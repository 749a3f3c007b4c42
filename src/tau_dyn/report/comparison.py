"""A comparison for people: one sentence, then tables, on the terminal and as a page."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from tau_dyn.compare import Change, Comparison
from tau_dyn.report.shell import Opening, render
from tau_dyn.report.terminal import bare_table, plain, put, say
from tau_dyn.report.words import count, listed, number, pretty_unit, with_uncertainty

_MOST = 40


def comparison_headline(found: Comparison) -> str:
    """Return the one sentence."""
    tested = sum(c.changed is not None for c in found.changes)
    if not tested:
        return "Nothing here has a standard error in both, so no change can be judged."
    if not found.changed:
        return f"Of {count(tested, 'value')} with uncertainty none changed by more than chance."
    names = listed([c.name for c in found.changed], 4)
    return f"{len(found.changed)} of {count(tested, 'value')} with uncertainty changed: {names}."


def print_comparison(console: Console, found: Comparison) -> None:
    """Print a comparison for a person: what changed first, then the rest."""
    say(console, f"{found.a.path} · {found.b.path}", "dim")
    say(console, comparison_headline(found), "bold")
    rows = _in_order(found)
    if rows:
        table = bare_table()
        for title in ("", "first", "second", "difference", "unit"):
            table.add_column(title, justify="left" if title in ("", "unit") else "right")
        for change in rows[:_MOST]:
            style = "bold" if change.changed else "dim" if change.changed is None else ""
            table.add_row(*(plain(text, style) for text in _cells(change)))
        put(console, table)
    if len(rows) > _MOST:
        say(console, f"and {len(rows) - _MOST} more, all in --json and --report.", "dim")
    for name, unit, a, b in found.errors:
        say(console, f"{name}: {number(a)} → {number(b)} {unit}")
    for line in _finding_lines(found):
        say(console, line)
    for names, where in ((found.only_a, "first"), (found.only_b, "second")):
        if names:
            say(console, f"Only in the {where}: {listed(names)}.", "dim")


def comparison_page(found: Comparison, *, command_line: str = "") -> str:
    """Return a comparison as one HTML page."""
    level = "care" if found.changed or not any(c.changed is not None for c in found.changes) else "good"
    tested = sum(c.changed is not None for c in found.changes)
    opening = Opening(
        comparison_headline(found),
        level,
        "Changed" if found.changed else "Same" if tested else "Cannot be judged",
        "Named are differences beyond the uncertainty of both, at 5 % for all quantities together (Holm).",
        f"{found.a.path} ({found.a.kind}) beside {found.b.path} ({found.b.kind}).",
    )
    return render(
        "comparison.html.j2",
        "comparison",
        opening,
        [],
        command_line=command_line,
        logs=[("first", str(found.a.path), found.a.sha256), ("second", str(found.b.path), found.b.sha256)],
        rows=[_page_row(change) for change in _in_order(found)],
        errors=[(name, number(a), number(b), unit) for name, unit, a, b in found.errors],
        findings=_finding_lines(found),
        only=[
            (where, listed(names, 40)) for names, where in ((found.only_a, "first"), (found.only_b, "second")) if names
        ],
        notes=found.warnings,
    )


def _in_order(found: Comparison) -> list[Change]:
    """Return what changed, clearest first, then what did not, then what cannot be judged."""
    changed = list(found.changed)
    same = [c for c in found.changes if c.changed is False]
    return [*changed, *same, *(c for c in found.changes if c.changed is None)]


def _cells(change: Change) -> tuple[str, str, str, str, str]:
    difference = with_uncertainty(change.difference, change.stderr) if change.stderr else number(change.difference)
    return change.name, number(change.a), number(change.b), difference, pretty_unit(change.unit)


def _page_row(change: Change) -> dict[str, Any]:
    name, a, b, difference, unit = _cells(change)
    z = abs(change.difference) / change.stderr if change.stderr else None
    state = "changed" if change.changed else "same" if change.changed is False else "no uncertainty"
    return {"name": name, "a": a, "b": b, "difference": difference, "unit": unit, "state": state,
            "z": "" if z is None else number(z, 2), "width": 0 if z is None else min(100.0, 10 * z)}  # fmt: skip


def _finding_lines(found: Comparison) -> list[str]:
    lines = []
    for f in found.findings:
        if f.a != f.b:
            lines.append(
                f"{f.cause} {listed(f.joints)}: {f.a or 'not found'} → {f.b or 'not found'}".replace("  ", " ")
            )
    return lines
