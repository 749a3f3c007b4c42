"""What `plan-motion` prints."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console

from tau_dyn.control.motion import MotionPlan
from tau_dyn.report.motion_plan_words import headline, judgement, path_words, squares_unit
from tau_dyn.report.terminal import LEVEL_STYLE, bare_table, meter, plain, put, say
from tau_dyn.report.words import number, percent

_WIDTH = 16


def print_plan(console: Console, plan: MotionPlan, written: Mapping[str, str]) -> None:
    """Print a planned motion for a person.

    Args:
        console: Where to.
        plan: The motion.
        written: What was written, such as `{"motion": "m.csv"}`; empty names are left out.
    """
    level, badge, said = judgement(plan)
    say(console, path_words(plan), "dim")
    say(console, headline(plan), "bold")
    say(console, f"{badge}. {said}", LEVEL_STYLE[level])
    table = bare_table()
    for name, justify in (("joint", "left"), ("force", "right"), ("limit", "right"), ("", "left"), ("at it", "right")):
        table.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    for row in plan.peaks():
        share = row["force"] / row["force_limit"]
        table.add_row(
            plain(row["joint"]), f"{number(row['force'], 4)} {row['force_unit']}", number(row["force_limit"], 4),
            meter(share, _WIDTH), percent(100 * row["at_force_limit"]),
        )  # fmt: skip
    put(console, table)
    start = f"from a trapezoidal profile of {plan.start_duration:.3g} s"
    solver = f"ipopt: {plan.iterations} iterations, {plan.seconds:.2g} s, {start}"
    say(
        console,
        f"squared forces over time {plan.energy:.4g} {squares_unit(plan)} s, work {plan.work:.4g} J; {solver}",
        "dim",
    )
    say(console, "   ".join(f"{what} → {path}" for what, path in written.items() if path))
