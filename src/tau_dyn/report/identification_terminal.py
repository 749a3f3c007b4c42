"""What the terminal shows of an identification: one sentence, error by joint, the parameters, what is uncertain."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from tau_dyn.identify import Identification
from tau_dyn.report.fit_quality_text import describe_inputs, list_combinations
from tau_dyn.report.formatting import format_list, format_number, format_percent, format_unit
from tau_dyn.report.identification_words import describe_headline, describe_verdict
from tau_dyn.report.parameter_rows import ParameterRow, build_parameter_rows
from tau_dyn.report.terminal import (
    build_bare_table,
    draw_meter,
    escape_control_characters,
    measure_columns,
    put,
    say,
    say_opening,
    say_written,
)

BAR, SHORT_BAR = 24, 4
"""Longest and shortest bar of an error."""
FIGURES = 57
"""Columns that an error's figures take, with the gaps between them."""
_MAX_COMBINATIONS = 4
"""Combinations of parameters that the screen lists."""


def print_identification(
    console: Console,
    found: Identification,
    written: Mapping[str, str] | None = None,
    *,
    truth: Mapping[str, float] | None = None,
) -> None:
    """Print an identification for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"model": "m.yaml"}`, for the last line.
        truth: True values by name, where the data were made; they replace the nominal ones in the table.
    """
    judged = describe_verdict(found, truth)
    about = f"{found.model.robot.name} · {describe_inputs(found)}"
    say_opening(console, about, describe_headline(found, truth), judged.level, judged.sentence)
    put(console, _error_table(found, measure_columns(console)))
    together = list_combinations(found)
    if together:
        listed = together[:_MAX_COMBINATIONS] + _rest(len(together) - _MAX_COMBINATIONS)
        say(console, f"Identifiable only in combination (value ± standard error): {'; '.join(listed)}.")
    put(console, build_parameter_table(build_parameter_rows(found), truth or {}))
    for title, sentences in _uncertain(found):
        say(console, f"{title}: {'; '.join(sentences)}.")
    say_written(console, written)


def _error_table(found: Identification, columns: int) -> Table:
    judged, units = found.holdout or found.train, found.model.robot.force_units
    table = build_bare_table()
    table.add_column("error by joint", no_wrap=True)
    table.add_column("")
    every = judged.all_samples
    titles = ["held out" if found.holdout else "of the fit", "rms", *(["training"] if found.holdout else [])]
    titles += ["all", "used"] if every is not None else []
    for title in titles:
        table.add_column(title, justify="right", no_wrap=True)
    worst = max(judged.per_joint_percent, default=1.0) or 1.0
    width = min(BAR, max(SHORT_BAR, columns - FIGURES - max(map(len, judged.joints), default=0)))
    for k, joint in enumerate(judged.joints):
        share = float(judged.per_joint_percent[k])
        cells = [
            joint,
            draw_meter(share / worst, width),
            format_percent(share),
            f"{format_number(float(judged.rms[k]), 3)} {format_unit(units[k])}",
        ]
        cells += [format_percent(float(found.train.per_joint_percent[k]))] if found.holdout else []
        if every is not None:
            share_used = judged.used_shares[k] if judged.used_shares else judged.used_share
            cells += [format_percent(float(every.per_joint_percent[k])), format_percent(100 * share_used)]
        table.add_row(*map(escape_control_characters, cells))
    return table


def build_parameter_table(rows: list[ParameterRow], truth: Mapping[str, float]) -> Table:
    """Return the parameters that the data tell alone; of the others no value is an estimate, so none is shown."""
    table = build_bare_table()
    table.add_column("identifiable alone", no_wrap=True)
    table.add_column("estimate ±\nstandard error", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    if truth or any(r.nominal for r in rows):
        table.add_column("true" if truth else "nominal", justify="right", no_wrap=True)
    for r in rows:
        if r.interval:
            last = (format_number(truth[r.name], 5) if r.name in truth else "") if truth else r.nominal
            style = "" if r.state == "known" else "dim"
            cells = (escape_control_characters(c, style) for c in (r.name, r.estimate, r.unit, last))
            table.add_row(*list(cells)[: len(table.columns)])
    return table


def _uncertain(found: Identification) -> list[tuple[str, list[str]]]:
    """Return headings and what stands under them, empty ones left out."""
    rows = found.rows()
    weak = [r["name"] for r in rows if r["stderr"] is not None and not r["determined"]]
    unseen = [r["name"] for r in rows if r["stderr"] is None and not r.get("depends_on")]
    groups = [
        ("Poorly determined (standard error above 30 %)", [format_list(weak)] if weak else []),
        ("Not excited, nominal value kept", [format_list(unseen)] if unseen else []),
        ("Equivalent models", list(found.equivalent[:1]) + _more(found.equivalent)),
    ]
    return [(title, sentences) for title, sentences in groups if sentences]


def _rest(n: int) -> list[str]:
    return [f"{n} more in --json and --report"] if n > 0 else []


def _more(sentences: tuple[str, ...]) -> list[str]:
    return [f"likewise for {len(sentences) - 1} more"] if len(sentences) > 1 else []
