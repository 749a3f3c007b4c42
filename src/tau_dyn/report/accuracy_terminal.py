"""What the terminal shows of accuracy: the sentence, every method in one table, what measured points say."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.table import Table

from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.report.accuracy_words import (
    describe_headline,
    describe_inputs,
    describe_place,
    describe_verdict,
    format_sentence,
    format_share,
    format_size,
)
from tau_dyn.report.terminal import build_bare_table, measure_columns, put, say, say_opening, say_written


def print_accuracy(console: Console, found: AccuracyResult, written: Mapping[str, str] | None = None) -> None:
    """Print accuracy for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "a.html"}`, for the last line.
    """
    judged, _ = describe_verdict(found)
    said = "" if found.accuracy is None else f"{describe_headline(found)}."
    say_opening(console, describe_inputs(found), said, judged.level, judged.sentence)
    if found.accuracy is not None:
        put(console, _methods(found, measure_columns(console)))
        for method, why in found.accuracy.left_out.items():
            say(console, f"{method} is left out: {why}.", "dim")
    for sentence in found.measured.sentences:
        say(console, format_sentence(sentence))
    say_written(console, written)


def _methods(found: AccuracyResult, columns: int) -> Table:
    a = found.accuracy
    assert a is not None
    table = build_bare_table()
    table.add_column("method", no_wrap=True)
    for title in ("least", "median", "largest", "off from exact"):
        table.add_column(title, no_wrap=True, justify="right")
    table.add_column("largest at" if columns >= 96 else "", no_wrap=True)
    for method in a.largest:
        s = found.summary(method)
        off = a.off(method) if "exact" in a.largest and method != "exact" else np.full(1, np.nan)
        spread = (
            f"{format_share(float(np.nanmin(off)))} … {format_share(float(np.nanmax(off)))}"
            if np.isfinite(off).any()
            else ""
        )
        where = describe_place(a.position[s.worst_pose]) if np.isfinite(s.most) and columns >= 96 else ""
        table.add_row(method, format_size(s.least), format_size(s.median), format_size(s.most), spread, where)
    return table
