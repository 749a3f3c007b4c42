"""A planned motion in sentences, the same on the page and on the terminal."""

from __future__ import annotations

from tau_dyn.control.motion import MotionPlan
from tau_dyn.report.formatting import Level, format_list, format_number, format_percent


def describe_headline(plan: MotionPlan) -> str:
    """Return duration and what was minimised in a sentence."""
    aim = "the shortest time" if plan.energy_weight == 0 else f"least effort at weight {plan.energy_weight:.3g}"
    return f"{plan.duration:.4f} s, {aim} {_WAYS[plan.path]}."


_WAYS = {"free": "on a path of its own choice", "line": "on a straight line", "points": "through the points given"}


def describe_judgement(plan: MotionPlan) -> tuple[Level, str, str]:
    """Return level, badge and sentence on what holds the motion back."""
    if not plan.binding:
        return "good", "Within limits", "It reaches no limit: the effort holds it back."
    reached = [f"{b.quantity} of {b.joint} ({format_percent(100 * b.share)} of the time)" for b in plan.binding]
    more = f" and {len(reached) - 4} more" if len(reached) > 4 else ""
    return "good", "Within limits", f"What holds it back: {format_list(reached[:4])}{more}."


def describe_path(plan: MotionPlan) -> str:
    """Return from where to where, and for what robot."""
    ends = plan.q[[0, -1]] if plan.tool is None else plan.tool[[0, -1]]
    unit = " m" if plan.tool is not None else ""
    start, end = (f"({', '.join(format_number(round(float(x), 6) + 0.0) for x in row)}){unit}" for row in ends)
    effects = ", ".join(dict.fromkeys(e.name.replace("_", " ") for e in plan.model.effects)) or "no friction"
    return f"{plan.model.robot.name} from {start} to {end}, rest to rest; rigid bodies with {effects}."


def format_squares_unit(plan: MotionPlan) -> str:
    """Return the unit of squared forces: of carts, of rotary joints, or of both."""
    units = set(plan.model.robot.force_units)
    return {frozenset({"N"}): "N²", frozenset({"N m"}): "(N m)²"}.get(frozenset(units), "(N², (N m)²)")
