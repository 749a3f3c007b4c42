"""A diagnosis in the terminal: the answer, the waterfall, what is uncertain, and where things are.

Plain text when piped; bars and numbers stay whole in narrow terminals, only words wrap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.padding import Padding
from rich.table import Table

from tau_dyn.diagnose import Diagnosis, Finding
from tau_dyn.report import diagnosis_text as said
from tau_dyn.report.formatting import format_list, format_percent
from tau_dyn.report.terminal import (
    MARGIN,
    build_bare_table,
    draw_meter,
    escape_control_characters,
    measure_columns,
    put,
    say,
    say_opening,
    say_written,
)
from tau_dyn.report.waterfall import WaterfallStep, build_total_series, format_finding

BARS = {90: 24, 64: 16, 0: 10}
"""Length of the longest bar by the columns that there are at least."""
MARGINS = 2 + 3 * 3
"""Columns that the left margin and the gaps of the waterfall take."""


def print_diagnosis(console: Console, diagnosis: Diagnosis, written: Mapping[str, str] | None = None) -> None:
    """Print a diagnosis for a person.

    Args:
        console: Where to.
        diagnosis: The result.
        written: What was written, such as `{"extended model": "m.yaml"}`, for the last line.
    """
    level, _ = said.describe_badge(diagnosis)
    about = f"{diagnosis.model.robot.name} · {said.describe_inputs(diagnosis)}"
    say_opening(console, about, diagnosis.sentence, level, said.recommend_model(diagnosis).sentence)
    put(console, _waterfall(diagnosis, measure_columns(console)))
    if text := said.describe_all_samples(diagnosis):
        say(console, text)
    for title, items in _uncertain(diagnosis):
        if len(items) == 1:
            say(console, f"{title}: {items[0]}")
        else:
            put(console, _list(title, items))
    say_written(console, written)


def _waterfall(diagnosis: Diagnosis, columns: int) -> Table:
    """Return one line a step: name, bar, percentage, and as many figures as there is room for."""
    whole = build_total_series(diagnosis)
    table = build_bare_table()
    table.show_header = False
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(no_wrap=True)
    width = next(bar for least, bar in BARS.items() if columns >= least)
    shares = [format_percent(r.left) for r in whole.rungs]
    left = (
        columns
        - MARGINS
        - width
        - max((len(r.label) for r in whole.rungs), default=0)
        - max(map(len, shares), default=0)
    )
    for r, share in zip(whole.rungs, shares, strict=True):
        bar = escape_control_characters(_bar(r.left / whole.end, width), _style(r))
        table.add_row(
            escape_control_characters(r.label),
            bar,
            escape_control_characters(share, "bold"),
            escape_control_characters(_fitting(r.about, left), "dim"),
        )
    return table


def _bar(share: float, width: int) -> str:
    """Return a step's bar; one that is longer than the axis shows that it was cut."""
    return draw_meter(share, width) if share <= 1 else f"{draw_meter(1.0, width - 4)}╱╱{draw_meter(1.0, 2)}"


def _fitting(pieces: Sequence[str], columns: int) -> str:
    """Return as many pieces as fit, each whole."""
    text = ""
    for piece in pieces:
        longer = f"{text}, {piece}" if text else piece
        if len(longer) > columns:
            break
        text = longer
    return text


def _style(rung: WaterfallStep) -> str:
    return "cyan" if rung.kind == "cause" else "dim"


def _list(title: str, items: list[str]) -> Table:
    table = Table(box=None, show_header=False, padding=0, pad_edge=False)
    table.add_column(overflow="fold")
    table.add_row(escape_control_characters(f"{title}:"))
    for item in items:
        table.add_row(Padding(escape_control_characters(item), MARGIN))
    return table


def _uncertain(diagnosis: Diagnosis) -> list[tuple[str, list[str]]]:
    """Return headings and what stands under them, empty ones left out."""
    suspected = [f for f in diagnosis.findings if f.status == "suspected"]
    moved = [f for f in diagnosis.findings if f.status == "parameter"]
    twins = [
        f"{said.format_title(f)} from {format_list(map(said.format_cause_name, f.indistinguishable_from))}"
        + (f"; to separate them: {f.experiment.rstrip('.')}" if f.experiment else "")
        for f in diagnosis.findings
        if f.indistinguishable_from
    ]
    groups = [
        ("Suspected, not confirmed", [_suspicion(f) for f in suspected]),
        ("Differs from the robot file", [_suspicion(f) for f in moved]),
        ("Unexplained", [said.describe_unexplained(u) for u in diagnosis.unexplained]),
        ("These data cannot separate", twins),
        ("Not detected; detection limit (95 % power)", _joined(said.list_limits(diagnosis.limits))),
        (
            "Not testable",
            [f"{format_list(causes, 9)}: {why}" for why, causes in said.group_by_reason(diagnosis.untestable)],
        ),
    ]
    return [(title, items) for title, items in groups if items]


def _joined(texts: list[str]) -> list[str]:
    return [f"{', '.join(texts)}."] if texts else []


def _suspicion(finding: Finding) -> str:
    """Return a cause that is not confirmed, its figures, and why it is not."""
    text = f"{said.format_title(finding)}: {', '.join(format_finding(finding))}"
    return f"{text}. Not confirmed: {finding.why_not_confirmed}" if finding.why_not_confirmed else text
