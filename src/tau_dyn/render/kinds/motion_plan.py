"""A planned motion: forces and their limits over time, the tool's path in space, its speed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.control.motion import MotionPlan
from tau_dyn.render.presentation import ZOOM, list_assumptions, present_kind

_POINTS = 1200  # points of a chart at most
_PLANES = ((0, 1), (0, 2), (1, 2))


@present_kind.register
def present_motion_plan(plan: MotionPlan) -> r.Presentation:
    """Return the presentation of a planned motion."""
    robot = plan.model.robot
    sections = [
        r.Chapter("forces", "Forces and their limits", lambda: _build_forces(plan), r.On.DRAWN),
        r.Chapter("joints", "Joint by joint", lambda: _build_joints(plan), r.On.ALL),
        r.Chapter("way", "The tool's way", lambda: _build_way(plan), when=plan.tool is not None),
        r.Chapter("motion", "The motion", lambda: _build_motion(plan)),
        *list_assumptions(robot.assumed),
    ]
    facts = [("solver", f"ipopt, {plan.status}, {plan.iterations} iterations in {plan.seconds:.2f} s")]
    return r.Presentation(
        "Planned motion", robot.name, f"{robot.name}: planned motion", describe_headline(plan), describe_verdict(plan),
        describe_path(plan), sections, plan.warnings, r.RobotPicture(robot), r.Provenance(facts, robot=robot), plan.peaks, plan,
    )  # fmt: skip


def _build_forces(plan: MotionPlan) -> Iterator[r.Element]:
    yield r.Figures([_draw_force(plan, k) for k in range(len(plan.joints))], on=r.On.DRAWN)
    yield r.explain(
        "The model's forces for the motion, friction included. Dashed: the limit. At least one drive is at its limit for "
        f"{r.format_percent(100 * plan.share_at_force_limit)} of the time."
    )
    reached = [
        f"{b.quantity} of {b.joint}, {r.format_percent(100 * b.share)} of {plan.duration:.3f} s" for b in plan.binding
    ]
    if reached or plan.warnings:
        yield r.Listing([*reached, *plan.warnings])


def _draw_force(plan: MotionPlan, k: int) -> r.Figure:
    """Return a joint's force between its limits over time, as in Figure 3.10 of the thesis."""
    step, limit, tau = max(1, len(plan.t) // _POINTS), float(plan.limits.force[k]), plan.tau[:, k]
    edges = np.array([-limit, limit]) if np.isfinite(limit) else np.zeros(0)
    end = float(plan.t[-1])
    frame = [r.Line(np.array([0.0, end]), np.full(2, edge), "limit") for edge in edges]
    y = r.Axis(f"force [{r.format_unit(plan.model.robot.force_units[k])}]", r.pad_limits(tau, edges))
    return r.Figure(
        r.Axis("time [s]", (0.0, end)), y, (*frame, r.Line(plan.t[::step], tau[::step])), plan.joints[k], (r.THIRD, 220)
    )


def _build_joints(plan: MotionPlan) -> Iterator[r.Element]:

    def tell(quantity: str, suffix: str = "") -> Callable[[dict[str, Any]], str]:
        return lambda row: f"{r.format_fixed_digits(row[quantity])} {row['unit']}{suffix}"

    def use(row: dict[str, Any]) -> r.Bar | None:
        limit = row["force_limit"]
        return r.Bar(min(row["force"] / limit, 1.0)) if np.isfinite(limit) else None

    drawn = r.On.DRAWN
    yield r.tabulate_things(
        plan.peaks(),
        r.Column("joint", cell=lambda row: row["joint"]),
        r.Column("travel", "number", on=drawn, cell=tell("travel")),
        r.Column("top speed", "number", on=drawn, cell=tell("speed", "/s")),
        r.Column("limit", "number", "quiet", on=drawn, cell=lambda row: r.format_limit(row["speed_limit"], 4)),
        r.Column("top acceleration", "number", on=drawn, cell=tell("acceleration", "/s²")),
        r.Column(
            "force", "number", cell=lambda row: f"{r.format_number(row['force'], 4)} {r.format_unit(row['force_unit'])}"
        ),
        r.Column("limit", "number", "quiet", cell=lambda row: r.format_limit(row["force_limit"], 4)),
        r.Column("", "bar", "share", cell=use),
        r.Column("time at it", "number", cell=lambda row: r.format_percent(100 * row["at_force_limit"])),
        on=r.On.ALL,
    )
    yield r.ResultTable(
        [r.Column(), r.Column(kind="number")], [r.Row(row) for row in _list_facts(plan)], style="plain fitted"
    )
    yield r.Text(
        f"squared forces over time {plan.energy:.4g} {format_squares_unit(plan)} s, work {plan.work:.4g} J; ipopt: "
        f"{plan.iterations} iterations, {plan.seconds:.2g} s, from a trapezoidal profile of {plan.start_duration:.3g} "
        "s",
        "dim",
        on=r.On.TERMINAL,
    )


def _list_facts(plan: MotionPlan) -> list[tuple[str, str]]:
    return [
        ("duration", f"{plan.duration:.4f} s"),
        ("sum of squared forces over time", f"{plan.energy:.5g} {format_squares_unit(plan)} s"),
        ("work of the drives, without recovery", f"{plan.work:.4g} J"),
        ("weight of the squared forces", f"{plan.energy_weight:.4g} s per {format_squares_unit(plan)} s"),
        ("trapezoidal profile it started from", f"{plan.start_duration:.4f} s"),
    ]


def _build_way(plan: MotionPlan) -> Iterator[r.Element]:
    yield r.Figures([_draw_way(plan, *plane) for plane in _PLANES])
    yield r.explain(
        "Dashed: the straight line between both ends. Obstacles in the room are not known here: look before you run it."
    )
    speed, step = plan.tool_speed, max(1, len(plan.t) // _POINTS)
    if speed is not None:
        x, y = r.Axis("time [s]", (0.0, float(plan.t[-1]))), r.Axis("speed [m/s]", r.pad_limits(speed, np.zeros(1)))
        yield r.Figures(
            [r.Figure(x, y, (r.Line(plan.t[::step], speed[::step]),), "tool", (r.WHOLE, 240))], "wide-chart"
        )


def _draw_way(plan: MotionPlan, i: int, j: int) -> r.Figure:
    """Return the projection of the tool's path along an axis, with the straight line dashed; both axes at the same scale."""
    assert plan.tool is not None
    step = max(1, len(plan.t) // _POINTS)
    place = plan.tool[::step] if (len(plan.tool) - 1) % step == 0 else np.vstack([plan.tool[::step], plan.tool[-1:]])
    (x, y), ends = place[:, [i, j]].T, np.array([0, -1])
    xlim, ylim = _square(x, y)
    marks = r.Line(x[ends], y[ends], "expected"), r.Line(x, y), r.Dots(x[ends], y[ends])
    return r.Figure(
        r.Axis(f"{'xyz'[i]} [m]", xlim), r.Axis(f"{'xyz'[j]} [m]", ylim), marks, "xyz"[i] + "xyz"[j], (r.THIRD, 300)
    )


def _square(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return limits of a drawing of 288 by 246 points with the same scale on both axes."""
    (x0, x1), (y0, y1) = r.pad_limits(x), r.pad_limits(y)
    scale = max((x1 - x0) / 288, (y1 - y0) / 246, 1e-6)
    (xm, ym), (w, h) = ((x0 + x1) / 2, (y0 + y1) / 2), (144 * scale, 123 * scale)
    return (xm - w, xm + w), (ym - h, ym + h)


def _build_motion(plan: MotionPlan) -> Iterator[r.Element]:
    key = r.build_key(predicted="position, speed", residual="force", limit="limit")
    views = [_build_view(plan, k) for k in range(len(plan.joints))]
    yield r.TimeView("position, speed and force over time", views, key)
    yield r.explain(f"{ZOOM}A limit is drawn where the motion comes near it.")


def _build_view(plan: MotionPlan, k: int) -> r.View:
    robot, most = plan.model.robot, plan.limits
    unit, force = robot.position_units[k], r.format_unit(robot.force_units[k])
    strips = tuple(
        r.build_strip(f"{name} [{shown}]", 180, r.Curve(name, ink, x[:, k]), bounds=bounds)
        for name, shown, ink, x, bounds in (
            ("position", unit, "predicted", plan.q, (most.lower[k], most.upper[k])),
            ("speed", f"{unit}/s", "predicted", plan.v, (-most.speed[k], most.speed[k])),
            ("force", force, "residual", plan.tau, (-most.force[k], most.force[k])),
        )
    )
    return r.View("planned motion", plan.joints[k], plan.t, strips)


def describe_headline(plan: MotionPlan) -> str:
    """Return a sentence with the duration and the minimised cost."""
    aim = "the shortest time found" if plan.energy_weight == 0 else f"least effort at weight {plan.energy_weight:.3g}"
    return f"{plan.duration:.4f} s, {aim} {_WAYS[plan.path]}."


_WAYS = {"free": "on a path of its own choice", "line": "on a straight line", "points": "through the points given"}


def describe_verdict(plan: MotionPlan) -> r.Verdict:
    """Return the verdict, with the limits that are reached."""
    if plan.exceeds:
        return r.Verdict(
            "care", f"It leaves a limit by up to {100 * plan.excess:.2g} % between the nodes.", "Exceeds a limit"
        )
    if not plan.binding:
        if plan.energy_weight > 0:
            return r.Verdict("good", f"It reaches no limit at effort weight {plan.energy_weight:.3g}.", "Within limits")
        return r.Verdict("care", "It reaches no limit, although only the time is minimised.", "Within limits")
    reached = [f"{b.quantity} of {b.joint} ({r.format_percent(100 * b.share)} of the time)" for b in plan.binding]
    more = f" and {len(reached) - 4} more" if len(reached) > 4 else ""
    return r.Verdict("good", f"Limits reached: {r.format_list(reached[:4])}{more}.", "Within limits")


def describe_path(plan: MotionPlan) -> str:
    """Return a sentence with start, end and robot."""
    ends = plan.q[[0, -1]] if plan.tool is None else plan.tool[[0, -1]]
    unit = " m" if plan.tool is not None else ""
    start, end = (f"({', '.join(r.format_number(round(float(x), 6) + 0.0) for x in row)}){unit}" for row in ends)
    effects = ", ".join(dict.fromkeys(e.name.replace("_", " ") for e in plan.model.effects)) or "no friction"
    return f"{plan.model.robot.name} from {start} to {end}, rest to rest; rigid bodies with {effects}."


def format_squares_unit(plan: MotionPlan) -> str:
    """Return the unit of squared forces: of prismatic joints, of revolute joints, or of both."""
    units = set(plan.model.robot.force_units)
    return {frozenset({"N"}): "N²", frozenset({"N m"}): "(N m)²"}.get(frozenset(units), "(N², (N m)²)")
