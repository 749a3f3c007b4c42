"""What the terminal shows of accuracy: the sentence, every method in one table, what measured points say."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.table import Table

from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.report.accuracy_words import at, headline, pretty, share, size, summary, verdict
from tau_dyn.report.terminal import bare_table, put, room, say, say_opening, say_written


def print_accuracy(console: Console, found: AccuracyResult, written: Mapping[str, str] | None = None) -> None:
    """Print accuracy for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "a.html"}`, for the last line.
    """
    judged, _ = verdict(found)
    said = "" if found.accuracy is None else f"{headline(found)}."
    say_opening(console, summary(found), said, judged.level, judged.sentence)
    if found.accuracy is not None:
        put(console, _methods(found, room(console)))
        for method, why in found.accuracy.left_out.items():
            say(console, f"{method} is left out: {why}.", "dim")
    for sentence in found.measured.sentences:
        say(console, pretty(sentence))
    say_written(console, written)


def _methods(found: AccuracyResult, columns: int) -> Table:
    a = found.accuracy
    assert a is not None
    table = bare_table()
    table.add_column("method", no_wrap=True)
    for title in ("least", "median", "largest", "off from exact"):
        table.add_column(title, no_wrap=True, justify="right")
    table.add_column("largest at" if columns >= 96 else "", no_wrap=True)
    for method in a.largest:
        s = found.summary(method)
        off = a.off(method) if "exact" in a.largest and method != "exact" else np.full(1, np.nan)
        spread = f"{share(float(np.nanmin(off)))} … {share(float(np.nanmax(off)))}" if np.isfinite(off).any() else ""
        where = at(a.position[s.worst_pose]) if np.isfinite(s.most) and columns >= 96 else ""
        table.add_row(method, size(s.least), size(s.median), size(s.most), spread, where)
    return table
