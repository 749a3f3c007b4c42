"""What the terminal shows of a planned motion: duration, what holds it back, each drive's force against its limit."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console

from tau_dyn.control.motion import MotionPlan
from tau_dyn.report.formatting import format_limit, format_number, format_percent
from tau_dyn.report.motion_plan_words import describe_headline, describe_judgement, describe_path, format_squares_unit
from tau_dyn.report.terminal import (
    build_bare_table,
    draw_meter,
    escape_control_characters,
    put,
    say,
    say_opening,
    say_written,
)

_WIDTH = 16  # columns of a bar


def print_motion_plan(console: Console, plan: MotionPlan, written: Mapping[str, str] | None = None) -> None:
    """Print a planned motion for a person.

    Args:
        console: Where to.
        plan: The motion.
        written: What was written, such as `{"motion": "m.csv"}`, for the last line.
    """
    level, badge, said = describe_judgement(plan)
    say_opening(console, describe_path(plan), describe_headline(plan), level, f"{badge}. {said}")
    table = build_bare_table()
    for name, justify in (("joint", "left"), ("force", "right"), ("limit", "right"), ("", "left"), ("at it", "right")):
        table.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    for row in plan.peaks():
        share = row["force"] / row["force_limit"]
        table.add_row(
            escape_control_characters(row["joint"]),
            f"{format_number(row['force'], 4)} {row['force_unit']}",
            format_limit(row["force_limit"], 4),
            draw_meter(share, _WIDTH),
            format_percent(100 * row["at_force_limit"]),
        )
    put(console, table)
    start = f"from a trapezoidal profile of {plan.start_duration:.3g} s"
    solver = f"ipopt: {plan.iterations} iterations, {plan.seconds:.2g} s, {start}"
    say(
        console,
        f"squared forces over time {plan.energy:.4g} {format_squares_unit(plan)} s, work {plan.work:.4g} J; {solver}",
        "dim",
    )
    say_written(console, written)
