"""A comparison for people: one sentence, then tables, on the terminal and as a page."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from tau_dyn.compare import Change, CircumstanceDifference, Comparison, ErrorChange, FindingChange, InputChange
from tau_dyn.report.formatting import (
    count,
    format_expression,
    format_list,
    format_number,
    format_unit,
    format_with_uncertainty,
)
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.terminal import build_bare_table, escape_control_characters, put, say

_MAX_ROWS = 40  # of a table on a terminal


def describe_headline(found: Comparison) -> str:
    """Return the one sentence."""
    tested = len(found.compared)
    if not found.changes and found.findings:
        moved = [f for f in found.findings if f.what != "same"]
        return f"Of {count(len(found.findings), 'finding')} {len(moved) or 'none'} changed."
    if not tested:
        return "No value has a standard error in both results; changes cannot be tested."
    if not found.changed:
        text = f"No significant change (Holm, 5 %) in {count(tested, 'value')} with a standard error"
    else:
        names = format_list(map(_name, found.changed), 4)
        text = f"{len(found.changed)} of {count(tested, 'value')} with a standard error changed significantly: {names}"
    n = len(found.neither)
    return (
        f"{text}; {count(n, 'more value')} {'is' if n == 1 else 'are'} not determined in either result."
        if n
        else f"{text}."
    )


def print_comparison(console: Console, found: Comparison) -> None:
    """Print a comparison for a person: what changed first, then the rest."""
    say(console, f"{found.a.place} · {found.b.place}", "dim")
    say(console, describe_headline(found), "bold")
    for title, lines in list_circumstances(found):
        say(console, f"{title}: {'; '.join(lines)}.")
    rows = order_changes(found)
    if rows:
        table = build_bare_table()
        for title in ("", "first", "second", "difference ± standard error", "unit"):
            table.add_column(title, justify="left" if title in ("", "unit") else "right")
        for change in rows[:_MAX_ROWS]:
            style = "bold" if change.changed else "dim" if change.changed is None else ""
            table.add_row(*(escape_control_characters(text, style) for text in list_cells(change)))
        put(console, table)
    if len(rows) > _MAX_ROWS:
        say(console, f"and {len(rows) - _MAX_ROWS} more, all in --json and --report.", "dim")
    for line in list_undetermined(found):
        say(console, line, "dim")
    for error in found.errors:
        first, second = _error_cells(error)
        say(console, f"{error.name}: {first} → {second} {error.unit}")
    for line in list_findings(found):
        say(console, line)
    for names, where in ((found.only_a, "first"), (found.only_b, "second")):
        if names:
            say(console, f"Only in the {where}: {format_list(map(format_expression, names))}.", "dim")


def build_comparison_page(found: Comparison, *, command_line: str = "") -> str:
    """Return a comparison as one HTML page."""
    tested = len(found.compared)
    level = "care" if found.changed or not tested else "good"
    opening = PageHeader(
        describe_headline(found),
        level,
        "Changed" if found.changed else "Same" if tested else "Not testable",
        "A change is significant at a family-wise level of 5 % (Holm).",
        f"{found.a.place} ({found.a.kind}) beside {found.b.place} ({found.b.kind}).",
    )
    return render_page(
        "comparison.html.j2",
        "comparison",
        opening,
        [],
        command_line=command_line,
        logs=[("first", str(found.a.path), found.a.sha256), ("second", str(found.b.path), found.b.sha256)],
        rows=[_page_row(change) for change in order_changes(found)],
        circumstances=list_circumstances(found),
        neither=list_undetermined(found),
        errors=[(error.name, *_error_cells(error), error.unit) for error in found.errors],
        findings=list_findings(found),
        only=[
            (where, format_list(map(format_expression, names), 40))
            for names, where in ((found.only_a, "first"), (found.only_b, "second"))
            if names
        ],
        notes=found.warnings,
    )


def order_changes(found: Comparison) -> list[Change]:
    """Return what changed, clearest first, then what did not, then what only one determines.

    What neither determines is left out: nominal values that are alike are no sign that the robot is.
    """
    same = [c for c in found.changes if c.changed is False]
    one = [c for c in found.changes if c.determined_by in ("first", "second") and c.changed is None]
    return [*found.changed, *same, *one]


def list_undetermined(found: Comparison) -> list[str]:
    """Return what neither determines, so that it is not compared, and where the values kept there differ all the same."""
    names = [_name(c) for c in found.neither]
    other = [c for c in found.neither if abs(c.difference) > 1e-9 * max(abs(c.a), abs(c.b))]
    kept = [f"{_name(c)} {format_number(c.a)} → {format_number(c.b)} {format_unit(c.unit)}".rstrip() for c in other]
    lines = [f"Not determined in either result, not compared: {format_list(names)}."] if names else []
    return [*lines, f"Of these, the kept values differ: {format_list(kept, 4)}."] if kept else lines


def _name(change: Change) -> str:
    return format_expression(change.name) if change.combination else change.name


def list_cells(change: Change) -> tuple[str, str, str, str, str]:
    """Return name, both values, their difference with its standard error, and the unit."""
    difference = (
        format_with_uncertainty(change.difference, change.stderr) if change.stderr else format_number(change.difference)
    )
    return _name(change), format_number(change.a), format_number(change.b), difference, format_unit(change.unit)


def _page_row(change: Change) -> dict[str, Any]:
    name, a, b, difference, unit = list_cells(change)
    z = abs(change.difference) / change.stderr if change.stderr else None
    judged = "changed" if change.changed else "same" if change.changed is False else ""
    state = judged or f"determined by the {change.determined_by} only"
    return {"name": name, "a": a, "b": b, "difference": difference, "unit": unit, "state": state,
            "z": "" if z is None else format_number(z, 2), "width": 0 if z is None else min(100.0, 10 * z)}  # fmt: skip


def list_circumstances(found: Comparison) -> list[tuple[str, list[str]]]:
    """Return what was different besides the answer, by heading: inputs, options, versions, plain numbers."""
    inputs = [_input_line(i) for i in found.inputs if i.state != "same"]
    if found.inputs and not inputs:
        inputs = [f"the same {count(len(found.inputs), 'file')}"]
    groups = [
        ("Inputs", inputs),
        ("Options", _difference_lines(found.configuration)),
        ("Versions", _difference_lines(found.versions)),
        ("Also", _difference_lines(found.numbers)),
    ]
    return [(title, lines) for title, lines in groups if lines]


def _input_line(i: InputChange) -> str:
    if i.a is None or i.b is None or i.a == i.b:
        return f"{i.a or i.b} is {i.state}"
    return f"{i.a} → {i.b}, {'the same' if i.same else 'other'} content"


def _difference_lines(rows: tuple[CircumstanceDifference, ...]) -> list[str]:
    return [f"{row.name} {_value(row.a)} → {_value(row.b)}" for row in rows]


def _value(value: Any) -> str:
    if isinstance(value, float):
        return format_number(value)
    if isinstance(value, list):
        return format_list(map(_value, value)) or "none"
    return "none" if value is None or value == "" else str(value)


def _error_cells(error: ErrorChange) -> tuple[str, str]:
    """Return both values, each with its interval where it has one."""
    pairs = ((error.a, error.ci95_a), (error.b, error.ci95_b))
    first, second = (
        format_number(x) + (f" ({format_number(ci[0], 3)} … {format_number(ci[1], 3)})" if ci else "")
        for x, ci in pairs
    )
    return first, second


def list_findings(found: Comparison) -> list[str]:
    """Return findings that appeared, vanished or changed, then what those that stayed are worth."""
    ordered = sorted(found.findings, key=lambda f: f.what == "same")
    return [line for line in map(_finding_line, ordered) if line]


def _finding_line(f: FindingChange) -> str:
    name = f"{f.cause} {format_list(f.joints)}".strip()
    gains = [
        g and f"{format_number(g[0], 3)} % ({format_number(g[1], 3)} … {format_number(g[2], 3)})"
        for g in (f.gain_a, f.gain_b)
    ]
    if f.what == "same":
        return f"{name}: {f.a} in both, worth {gains[0]} → {gains[1]}" if all(gains) and f.gain_a != f.gain_b else ""
    worth = next((f", worth {g}" for g in gains if g), "")
    return f"{name} {f.what}: {f.a or 'not found'} → {f.b or 'not found'}{worth}"
