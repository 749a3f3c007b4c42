"""What the terminal shows of resonances: the sentence, the modes, how far to trust them, and where things are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.table import Table

from tau_dyn.modes import Modes, OperationalModes
from tau_dyn.report.modes_text import (
    describe_headline,
    describe_inputs,
    describe_mechanical,
    describe_verdict,
    format_damping,
    format_frequency,
    format_interval,
    is_resonance,
)
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

BAR = 12  # columns of a bar


def print_modes(console: Console, found: Modes, written: Mapping[str, str] | None = None) -> None:
    """Print resonances for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "m.html"}`, for the last line.
    """
    judged = describe_verdict(found)
    say_opening(console, describe_inputs(found), describe_headline(found), judged.level, judged.sentence)
    if found.modes:
        put(console, _modes(found, measure_columns(console)))
    put(console, _fits(found))
    say(console, describe_mechanical(found))
    reasons = ". ".join(text[:1].upper() + text[1:] for text in found.why.values())
    say(console, f"{reasons}.", "dim")
    say_written(console, written)


def print_operational_modes(
    console: Console, found: OperationalModes, written: Mapping[str, str] | None = None
) -> None:
    """Print resonances from responses alone."""
    judged = describe_verdict(found)
    say_opening(console, describe_inputs(found), describe_headline(found), judged.level, judged.sentence)
    put(console, _modes(found, measure_columns(console)))
    say_written(console, written)


def _modes(found: Modes | OperationalModes, columns: int) -> Table:
    table = build_bare_table()
    several, spread = len(found.outputs) > 1, columns >= 96 or len(found.outputs) == 1
    titles = ["frequency [Hz]", "95 %", "damping [%]", "95 %"] if spread else ["frequency [Hz]", "damping [%]"]
    for title in titles:
        table.add_column(title, no_wrap=True, justify="right")
    if several:
        table.add_column("moves most", no_wrap=True)
    for m in found.modes:
        f, z = (
            (format_frequency(m), format_interval(m.frequency_hz, m.frequency_stderr)),
            (
                format_damping(m),
                format_interval(100 * m.damping_ratio, 100 * m.damping_stderr),
            ),
        )
        cells = [*f, *z] if spread else [f[0], z[0]]
        cells += [found.outputs[int(np.argmax(np.abs(m.shape)))]] if several else []
        table.add_row(*(escape_control_characters(c, "" if is_resonance(m) else "dim") for c in cells))
    return table


def _fits(found: Modes) -> Table:
    table = build_bare_table()
    held = found.holdout is not None
    table.add_column("fit by output", no_wrap=True)
    table.add_column("")
    for title in ("simulated, held out" if held else "simulated", *(("in training",) if held else ()), "10 ahead"):
        table.add_column(title, justify="right", no_wrap=True)
    for k, name in enumerate(found.outputs):
        fit = float(found.judged.percent[k])
        cells = [name, draw_meter(fit / 100, BAR), f"{fit:.1f} %"]
        cells += [f"{found.train.percent[k]:.1f} %"] if held else []
        table.add_row(*map(escape_control_characters, [*cells, f"{found.judged.ahead[10][k]:.1f} %"]))
    return table
