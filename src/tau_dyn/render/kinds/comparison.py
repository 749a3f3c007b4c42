"""A comparison of two results: changes, and other differences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tau_dyn import results as r
from tau_dyn.compare import Change, CircumstanceDifference, Comparison, ErrorChange, FindingChange, InputChange
from tau_dyn.render.presentation import flatten_rows, present_kind

_MAX_ROWS = 40  # rows of a table on a terminal
_MAX_NAME = 40  # characters of a combination in the headline


@present_kind.register
def present_comparison(found: Comparison) -> r.Presentation:
    """Return the presentation of a comparison."""
    tested = len(found.compared)
    badge = (
        "Changed" if found.changed else "Not testable" if not tested else "Tested in part" if found.lacking else "Same"
    )
    level = "good" if badge == "Same" else "care"
    said = "A change is significant at a family-wise level of 5 % (Holm)."
    if found.lacking:
        said += " Combinations of parameters are not tested; compare the --json results of identify."
    more = [*list_findings(found), *(line for line in _list_only(found)), *found.warnings]
    different = bool(list_circumstances(found))
    sections = [
        r.Chapter("circumstances", "Differences", lambda: _build_circumstances(found), r.On.ALL, when=different),
        r.Chapter("quantities", "Quantities", lambda: _build_quantities(found), r.On.ALL, when=bool(found.changes)),
        r.Chapter("errors", "Errors", lambda: _build_errors(found), r.On.PRINTED, when=bool(found.errors)),
        r.Chapter("more", "Findings and the rest", lambda: _build_rest(found), r.On.ALL, when=bool(more)),
    ]
    logs = [("first", str(found.a.path), found.a.sha256), ("second", str(found.b.path), found.b.sha256)]
    return r.Presentation(
        "Comparison", f"{found.a.place} and {found.b.place}", "comparison", describe_headline(found),
        r.Verdict(level, said, badge), f"{found.a.kind} compared with {found.b.kind}.", sections, found.warnings,
        provenance=r.Provenance(logs=logs), data=lambda: flatten_rows([c.to_dict() for c in found.changes]), result=found,
    )  # fmt: skip


def _build_circumstances(found: Comparison) -> Iterator[r.Element]:
    groups = list_circumstances(found)
    yield r.tabulate_plainly((title, "; ".join(lines)) for title, lines in groups)
    yield r.Listing([f"{title}: {'; '.join(lines)}." for title, lines in groups], on=r.On.SCREENS)


def _build_quantities(found: Comparison) -> Iterator[r.Element]:
    rows = [_build_change(change) for change in order_changes(found)]
    columns = [
        r.Column(""), r.Column("first", "number"), r.Column("second", "number"),
        r.Column("difference ±\nstandard error", "number"),
        r.Column("unit", "unit"), r.Column("in standard errors", "number", "spare", on=r.On.PAGE),
        r.Column("", "bar", "share spare", on=r.On.PAGE),
        r.Column("", on=r.On.PAGE),
    ]  # fmt: skip
    if rows:
        yield r.ResultTable(columns, rows, style="names-above", most=_MAX_ROWS, on=r.On.ALL)
        yield r.explain(
            "± is one standard error (1 σ) of the difference; the two results are taken as independent. A sum is a "
            "combination of parameters that the data of both determine, whatever its members are."
        )
    for line in list_undetermined(found):
        yield r.explain(line, on=r.On.ALL)


def _build_change(change: Change) -> r.Row:
    z = abs(change.difference) / change.stderr if change.stderr else None
    judged = "changed" if change.changed else "same" if change.changed is False else ""
    state = judged or f"determined by the {change.determined_by} only"
    cells = [
        *list_cells(change),
        "" if z is None else r.format_number(z, 2),
        r.Bar(0.0 if z is None else min(1.0, z / 10)),
        state,
    ]
    return r.Row(cells, "changed" if change.changed else "quiet")


def _build_errors(found: Comparison) -> Iterator[r.Element]:
    rows = [r.Row([error.name, *_error_cells(error), error.unit]) for error in found.errors]
    columns = [r.Column(), r.Column("first", "number"), r.Column("second", "number"), r.Column("unit", "unit")]
    yield r.ResultTable(columns, rows, on=r.On.PRINTED)


def _build_rest(found: Comparison) -> Iterator[r.Element]:
    findings, only = list_findings(found), _list_only(found)
    yield r.Listing([*findings, *only, *found.warnings])
    if findings or only:
        yield r.Listing([*findings, *only], on=r.On.SCREENS)


def _list_only(found: Comparison) -> list[str]:
    return [
        f"Only in the {where}: {r.format_list(map(r.format_expression, names), 40)}."
        for names, where in ((found.only_a, "first"), (found.only_b, "second"))
        if names
    ]


def describe_headline(found: Comparison) -> str:
    """Return the headline."""
    tested = len(found.compared)
    if not found.changes and found.findings:
        moved = [f for f in found.findings if f.what != "same"]
        return f"Of {r.count(len(found.findings), 'finding')} {len(moved) or 'none'} changed."
    if not tested:
        return "No value has a standard error in both results; changes cannot be tested."
    if not found.changed:
        text = f"No significant change (Holm, 5 %) in {r.count(tested, 'value')} with a standard error"
        if found.lacking:
            return f"{text}; {r.count(len(found.neither), 'more value')} and all combinations are not tested."
    else:
        names = r.format_list(map(_name_briefly, found.changed), 4)
        text = (
            f"{len(found.changed)} of {r.count(tested, 'value')} with a standard error changed significantly: {names}"
        )
    n = len(found.neither)
    return (
        f"{text}; {r.count(n, 'more value')} {'is' if n == 1 else 'are'} not determined in either result."
        if n
        else f"{text}."
    )


def order_changes(found: Comparison) -> list[Change]:
    """Return the significant changes, most significant first, then the others, then values that only one result determines.

    Values that neither result determines are left out: equal nominal values do not show that the robot is unchanged.
    """
    same = [c for c in found.changes if c.changed is False]
    one = [c for c in found.changes if c.determined_by in ("first", "second") and c.changed is None]
    return [*found.changed, *same, *one]


def list_undetermined(found: Comparison) -> list[str]:
    """Return a sentence on values that neither result determines, and one on those whose kept values differ."""
    names = [_name(c) for c in found.neither]
    other = [c for c in found.neither if abs(c.difference) > 1e-9 * max(abs(c.a), abs(c.b))]
    kept = [
        f"{_name(c)} {r.format_number(c.a)} → {r.format_number(c.b)} {r.format_unit(c.unit)}".rstrip() for c in other
    ]
    lines = [f"Not determined in either result, not compared: {r.format_list(names)}."] if names else []
    return [*lines, f"The kept values differ for: {r.format_list(kept, 4)}."] if kept else lines


def _name(change: Change) -> str:
    return r.format_expression(change.name) if change.combination else change.name


def _name_briefly(change: Change) -> str:
    """Return a name; for a long combination, only its first parameter."""
    name = _name(change)
    return name if len(name) <= _MAX_NAME else f"{name.split(' ')[0]} + …"


def list_cells(change: Change) -> tuple[str, str, str, str, str]:
    """Return name, both values, their difference with its standard error, and the unit."""
    difference = (
        r.format_with_uncertainty(change.difference, change.stderr)
        if change.stderr
        else r.format_number(change.difference)
    )
    return _name(change), r.format_number(change.a), r.format_number(change.b), difference, r.format_unit(change.unit)


def list_circumstances(found: Comparison) -> list[tuple[str, list[str]]]:
    """Return differences other than in the result, by heading: inputs, options, versions, plain numbers."""
    inputs = [_input_line(i) for i in found.inputs if i.state != "same"]
    if found.inputs and not inputs:
        inputs = [f"the same {r.count(len(found.inputs), 'file')}"]
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
        return r.format_number(value)
    if isinstance(value, list):
        return r.format_list(map(_value, value)) or "none"
    return "none" if value is None or value == "" else str(value)


def _error_cells(error: ErrorChange) -> tuple[str, str]:
    """Return both values, each with its interval if it has one."""
    pairs = ((error.a, error.ci95_a), (error.b, error.ci95_b))
    first, second = (
        r.format_number(x) + (f" ({r.format_number(ci[0], 3)} … {r.format_number(ci[1], 3)})" if ci else "")
        for x, ci in pairs
    )
    return first, second


def list_findings(found: Comparison) -> list[str]:
    """Return findings that appeared, vanished or changed, then the gains of the unchanged ones."""
    ordered = sorted(found.findings, key=lambda f: f.what == "same")
    return [line for line in map(_finding_line, ordered) if line]


def _finding_line(f: FindingChange) -> str:
    name = f"{f.cause} {r.format_list(f.joints)}".strip()
    gains = [
        g and f"{r.format_number(g[0], 3)} % ({r.format_number(g[1], 3)} … {r.format_number(g[2], 3)})"
        for g in (f.gain_a, f.gain_b)
    ]
    if f.what == "same":
        return f"{name}: {f.a} in both, worth {gains[0]} → {gains[1]}" if all(gains) and f.gain_a != f.gain_b else ""
    worth = next((f", worth {g}" for g in gains if g), "")
    return f"{name} {f.what}: {f.a or 'not found'} → {f.b or 'not found'}{worth}"
