"""The page of `tau-dyn plan-motion`: forces against their limits over time, the tool's way in space, its speed."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.control.motion import Binding, MotionPlan
from tau_dyn.report.formatting import format_fixed_digits, format_limit, format_number, format_percent, format_unit
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.motion_plan_words import describe_headline, describe_judgement, describe_path, format_squares_unit
from tau_dyn.report.svg import THIRD, WHOLE, Chart, pad_limits
from tau_dyn.report.time_view import Curve, View, strip

_POINTS = 1200  # points of a chart at most
_PLANES = ((0, 1), (0, 2), (1, 2))


def build_motion_plan_page(plan: MotionPlan, *, command_line: str = "") -> str:
    """Return a planned motion as one HTML page.

    Args:
        plan: What `plan_motion` returned.
        command_line: The command that repeats it, for the provenance.
    """
    robot = plan.model.robot
    level, badge, said = describe_judgement(plan)
    opening = PageHeader(describe_headline(plan), level, badge, said, describe_path(plan))
    return render_page(
        "motion_plan.html.j2",
        f"{robot.name}: planned motion",
        opening,
        [_view(plan, k) for k in range(robot.na)],
        robot=robot,
        provenance={"solver": f"ipopt, {plan.status}, {plan.iterations} iterations in {plan.seconds:.2f} s"},
        command_line=command_line,
        facts=_facts(plan),
        rows=[_row(row) for row in plan.peaks()],
        binding=[_bound(b, plan) for b in plan.binding],
        forces=_forces(plan),
        ways=[_way(plan, *plane) for plane in _PLANES] if plan.tool is not None else [],
        speed=_speed(plan),
        notes=plan.warnings,
        assumed=robot.assumed,
    )


def _facts(plan: MotionPlan) -> list[tuple[str, str]]:
    return [
        ("duration", f"{plan.duration:.4f} s"),
        ("sum of squared forces over time", f"{plan.energy:.5g} {format_squares_unit(plan)} s"),
        ("work of the drives, nothing recovered", f"{plan.work:.4g} J"),
        ("weight of the squared forces", f"{plan.energy_weight:.4g} s per {format_squares_unit(plan)} s"),
        ("trapezoidal profile it started from", f"{plan.start_duration:.4f} s"),
    ]


def _row(row: dict[str, Any]) -> dict[str, Any]:
    def share(value: float, most: float) -> float | None:
        return 100 * min(value / most, 1.0) if np.isfinite(most) else None

    return {
        "joint": row["joint"],
        "travel": f"{format_fixed_digits(row['travel'])} {row['unit']}",
        "speed": f"{format_fixed_digits(row['speed'])} {row['unit']}/s",
        "speed_limit": format_limit(row["speed_limit"], 4),
        "acceleration": f"{format_fixed_digits(row['acceleration'])} {row['unit']}/s²",
        "force": f"{format_number(row['force'], 4)} {format_unit(row['force_unit'])}",
        "force_limit": format_limit(row["force_limit"], 4),
        "force_share": share(row["force"], row["force_limit"]),
        "at_limit": format_percent(100 * row["at_force_limit"]),
    }


def _bound(bound: Binding, plan: MotionPlan) -> str:
    return f"{bound.quantity} of {bound.joint}, {format_percent(100 * bound.share)} of {plan.duration:.3f} s"


def _forces(plan: MotionPlan) -> list[Markup]:
    """Return each joint's force between its limits over time, as Figure 3.10 of the thesis draws it."""
    step, charts = max(1, len(plan.t) // _POINTS), []
    for k, joint in enumerate(plan.joints):
        limit, tau = float(plan.limits.force[k]), plan.tau[:, k]
        edges = np.array([-limit, limit]) if np.isfinite(limit) else np.zeros(0)
        unit = format_unit(plan.model.robot.force_units[k])
        chart = Chart(
            THIRD, 220, (0.0, float(plan.t[-1])), pad_limits(tau, edges), joint, "time [s]", f"force [{unit}]"
        )
        ends = np.array([0.0, plan.t[-1]])
        frame = [chart.line(ends, np.full(2, edge), "limit") for edge in edges]
        charts.append(chart.render(*frame, chart.line(plan.t[::step], tau[::step], "predicted")))
    return charts


def _way(plan: MotionPlan, i: int, j: int) -> Markup:
    """Return the tool's way seen along an axis, the straight line dashed; both axes to one scale."""
    assert plan.tool is not None
    step, axes = max(1, len(plan.t) // _POINTS), "xyz"
    place = plan.tool[::step] if (len(plan.tool) - 1) % step == 0 else np.vstack([plan.tool[::step], plan.tool[-1:]])
    x, y = place[:, i], place[:, j]
    xlim, ylim = _square(x, y)
    chart = Chart(THIRD, 300, xlim, ylim, f"{axes[i]}{axes[j]}", f"{axes[i]} [m]", f"{axes[j]} [m]")
    ends = np.array([0, -1])
    return chart.render(
        chart.line(x[ends], y[ends], "expected"), chart.line(x, y, "predicted"), chart.dots(x[ends], y[ends], "mean")
    )


def _square(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return limits of a drawing of 288 by 246 points in which a metre is as long either way."""
    (x0, x1), (y0, y1) = pad_limits(x), pad_limits(y)
    scale = max((x1 - x0) / 288, (y1 - y0) / 246, 1e-6)
    (xm, ym), (w, h) = ((x0 + x1) / 2, (y0 + y1) / 2), (144 * scale, 123 * scale)
    return (xm - w, xm + w), (ym - h, ym + h)


def _speed(plan: MotionPlan) -> Markup:
    """Return the tool's speed over time, nothing without a tool."""
    speed = plan.tool_speed
    if speed is None:
        return Markup("")
    step = max(1, len(plan.t) // _POINTS)
    chart = Chart(
        WHOLE, 240, (0.0, float(plan.t[-1])), pad_limits(speed, np.zeros(1)), "tool", "time [s]", "speed [m/s]"
    )
    return chart.render(chart.line(plan.t[::step], speed[::step], "predicted"))


def _view(plan: MotionPlan, k: int) -> View:
    robot, limits = plan.model.robot, plan.limits
    unit, force = robot.position_units[k], format_unit(robot.force_units[k])
    strips = (
        strip(f"position [{unit}]", 180, Curve("position", "predicted", plan.q[:, k]), bounds=(limits.lower[k], limits.upper[k])),
        strip(f"speed [{unit}/s]", 180, Curve("speed", "predicted", plan.v[:, k]), bounds=(-limits.speed[k], limits.speed[k])),
        strip(f"force [{force}]", 180, Curve("force", "residual", plan.tau[:, k]), bounds=(-limits.force[k], limits.force[k])),
    )  # fmt: skip
    return View("planned motion", plan.joints[k], plan.t, strips)
