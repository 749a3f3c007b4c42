"""What the terminal shows of a calibration: the sentence, the ladder of models, causes, and what no pose can tell."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from tau_dyn.calibrate import Calibration
from tau_dyn.report.calibration_words import (
    describe_finding,
    describe_headline,
    describe_inputs,
    describe_model,
    describe_verdict,
    format_angle,
    format_length,
)
from tau_dyn.report.formatting import format_list
from tau_dyn.report.terminal import (
    build_bare_table,
    draw_meter,
    escape_control_characters,
    put,
    say,
    say_opening,
    say_written,
)

BAR = 10  # columns of a bar


def print_calibration(console: Console, found: Calibration, written: Mapping[str, str] | None = None) -> None:
    """Print a calibration for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "c.html"}`, for the last line.
    """
    judged = describe_verdict(found)
    say_opening(console, describe_inputs(found), describe_headline(found), judged.level, judged.sentence)
    put(console, _ladder(found))
    for finding in found.findings:
        say(console, f"{finding.status}: {describe_finding(finding)}")
    blind = found.fit.identifiability
    if len(blind.dropped):
        names = [blind.names[k] for k in blind.dropped]
        say(console, f"not identifiable, nominal value kept: {format_list(names, 8)}", "dim")
    say_written(console, written)


def _ladder(found: Calibration) -> Table:
    table = build_bare_table()
    turned = found.errors(found.chosen).orientation_size is not None
    for title in ("model", "free", "mean error", "largest", *(("turned by",) if turned else ()), ""):
        name = title == "model"
        table.add_column(title, no_wrap=not name, justify="left" if name or not title else "right", overflow="fold")
    worst = found.errors(found.models[0]).position_size.mean
    for k, model in enumerate(found.models):
        size, turn = found.errors(model).position_size, found.errors(model).orientation_size
        name, _ = describe_model(model, found.models[k - 1] if k else None)
        cells = [name, str(model.fit.n_estimated), format_length(size.mean), format_length(size.max)]
        cells += [format_angle(turn.mean) if turn is not None else ""] if turned else []
        table.add_row(*map(escape_control_characters, [*cells, draw_meter(size.mean / worst, BAR)]))
    return table
