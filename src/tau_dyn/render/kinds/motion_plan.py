"""A planned motion: forces against their limits over time, the tool's way in space, its speed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn.control.motion import MotionPlan
from tau_dyn.render.presentation import ZOOM, list_assumptions, present_kind
from tau_dyn.results import (
    THIRD,
    WHOLE,
    Axis,
    Bar,
    Chapter,
    Column,
    Curve,
    Dots,
    Element,
    Figure,
    Figures,
    Key,
    Line,
    Listing,
    On,
    Presentation,
    Provenance,
    ResultTable,
    RobotPicture,
    Row,
    Text,
    TimeView,
    Verdict,
    View,
    build_strip,
    format_fixed_digits,
    format_limit,
    format_list,
    format_number,
    format_percent,
    format_unit,
    pad_limits,
)

_POINTS = 1200  # points of a chart at most
_PLANES = ((0, 1), (0, 2), (1, 2))


@present_kind.register
def present_motion_plan(plan: MotionPlan) -> Presentation:
    """Return how a planned motion is presented."""
    robot = plan.model.robot
    sections = [
        Chapter("forces", "Forces and their limits", lambda: _build_forces(plan), On.PAGE | On.NOTEBOOK),
        Chapter("joints", "Joint by joint", lambda: _build_joints(plan), On.ALL),
        *([Chapter("way", "The tool's way", lambda: _build_way(plan))] if plan.tool is not None else []),
        Chapter("motion", "The motion", lambda: _build_motion(plan)),
        *list_assumptions(robot.assumed),
    ]
    facts = [("solver", f"ipopt, {plan.status}, {plan.iterations} iterations in {plan.seconds:.2f} s")]
    return Presentation(
        "Planned motion", robot.name, f"{robot.name}: planned motion", describe_headline(plan), describe_verdict(plan),
        describe_path(plan), sections, plan.warnings, RobotPicture(robot), Provenance(facts, robot=robot), plan.peaks, plan,
    )  # fmt: skip


def _build_forces(plan: MotionPlan) -> Iterator[Element]:
    yield Figures([_draw_force(plan, k) for k in range(len(plan.joints))], on=On.PAGE | On.NOTEBOOK)
    yield Text(
        "What the model needs for the motion, friction included. Dashed: the limit. In the shortest time at least "
        "one drive is at its "
        "limit nearly always.",
        "note",
    )
    reached = [
        f"{b.quantity} of {b.joint}, {format_percent(100 * b.share)} of {plan.duration:.3f} s" for b in plan.binding
    ]
    if reached or plan.warnings:
        yield Listing([*reached, *plan.warnings])


def _draw_force(plan: MotionPlan, k: int) -> Figure:
    """Return a joint's force between its limits over time, as Figure 3.10 of the thesis draws it."""
    step, limit, tau = max(1, len(plan.t) // _POINTS), float(plan.limits.force[k]), plan.tau[:, k]
    edges = np.array([-limit, limit]) if np.isfinite(limit) else np.zeros(0)
    end = float(plan.t[-1])
    frame = [Line(np.array([0.0, end]), np.full(2, edge), "limit") for edge in edges]
    y = Axis(f"force [{format_unit(plan.model.robot.force_units[k])}]", pad_limits(tau, edges))
    return Figure(
        Axis("time [s]", (0.0, end)), y, (*frame, Line(plan.t[::step], tau[::step])), plan.joints[k], (THIRD, 220)
    )


def _build_joints(plan: MotionPlan) -> Iterator[Element]:
    page = On.PAGE | On.NOTEBOOK
    columns = [
        Column("joint"), Column("travel", "number", on=page), Column("top speed", "number", on=page),
        Column("limit", "number", "quiet", on=page), Column("top acceleration", "number", on=page), Column("force", "number"),
        Column("limit", "number", "quiet"), Column("", "bar", "share"), Column("time at it", "number"),
    ]  # fmt: skip
    rows = []
    for r in plan.peaks():
        limit = r["force_limit"]
        rows.append(Row([
            r["joint"], f"{format_fixed_digits(r['travel'])} {r['unit']}", f"{format_fixed_digits(r['speed'])} {r['unit']}/s",
            format_limit(r["speed_limit"], 4), f"{format_fixed_digits(r['acceleration'])} {r['unit']}/s²",
            f"{format_number(r['force'], 4)} {format_unit(r['force_unit'])}", format_limit(limit, 4),
            Bar(min(r["force"] / limit, 1.0)) if np.isfinite(limit) else None, format_percent(100 * r["at_force_limit"]),
        ]))  # fmt: skip
    yield ResultTable(columns, rows, on=On.ALL)
    yield ResultTable([Column(), Column(kind="number")], [Row(row) for row in _list_facts(plan)], style="plain fitted")
    yield Text(
        f"squared forces over time {plan.energy:.4g} {format_squares_unit(plan)} s, work {plan.work:.4g} J; ipopt: "
        f"{plan.iterations} "
        f"iterations, {plan.seconds:.2g} s, from a trapezoidal profile of {plan.start_duration:.3g} s",
        "dim",
        on=On.TERMINAL,
    )


def _list_facts(plan: MotionPlan) -> list[tuple[str, str]]:
    return [
        ("duration", f"{plan.duration:.4f} s"),
        ("sum of squared forces over time", f"{plan.energy:.5g} {format_squares_unit(plan)} s"),
        ("work of the drives, nothing recovered", f"{plan.work:.4g} J"),
        ("weight of the squared forces", f"{plan.energy_weight:.4g} s per {format_squares_unit(plan)} s"),
        ("trapezoidal profile it started from", f"{plan.start_duration:.4f} s"),
    ]


def _build_way(plan: MotionPlan) -> Iterator[Element]:
    yield Figures([_draw_way(plan, *plane) for plane in _PLANES])
    yield Text(
        "Dashed: the straight line between both ends. What stands in the room is not known here: look before you run it.",
        "note",
    )
    speed, step = plan.tool_speed, max(1, len(plan.t) // _POINTS)
    if speed is not None:
        x, y = Axis("time [s]", (0.0, float(plan.t[-1]))), Axis("speed [m/s]", pad_limits(speed, np.zeros(1)))
        yield Figures([Figure(x, y, (Line(plan.t[::step], speed[::step]),), "tool", (WHOLE, 240))], "wide-chart")


def _draw_way(plan: MotionPlan, i: int, j: int) -> Figure:
    """Return the tool's way seen along an axis, the straight line dashed; both axes to one scale."""
    assert plan.tool is not None
    step = max(1, len(plan.t) // _POINTS)
    place = plan.tool[::step] if (len(plan.tool) - 1) % step == 0 else np.vstack([plan.tool[::step], plan.tool[-1:]])
    (x, y), ends = place[:, [i, j]].T, np.array([0, -1])
    xlim, ylim = _square(x, y)
    marks = Line(x[ends], y[ends], "expected"), Line(x, y), Dots(x[ends], y[ends])
    return Figure(
        Axis(f"{'xyz'[i]} [m]", xlim), Axis(f"{'xyz'[j]} [m]", ylim), marks, "xyz"[i] + "xyz"[j], (THIRD, 300)
    )


def _square(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return limits of a drawing of 288 by 246 points in which a metre is as long either way."""
    (x0, x1), (y0, y1) = pad_limits(x), pad_limits(y)
    scale = max((x1 - x0) / 288, (y1 - y0) / 246, 1e-6)
    (xm, ym), (w, h) = ((x0 + x1) / 2, (y0 + y1) / 2), (144 * scale, 123 * scale)
    return (xm - w, xm + w), (ym - h, ym + h)


def _build_motion(plan: MotionPlan) -> Iterator[Element]:
    key = [Key("predicted", "position, speed"), Key("residual", "force"), Key("limit", "limit")]
    views = [_build_view(plan, k) for k in range(len(plan.joints))]
    yield TimeView("position, speed and force over time", views, key)
    yield Text(f"{ZOOM}A limit is drawn where the motion comes near it.", "note")


def _build_view(plan: MotionPlan, k: int) -> View:
    robot, most = plan.model.robot, plan.limits
    unit, force = robot.position_units[k], format_unit(robot.force_units[k])
    strips = tuple(
        build_strip(f"{name} [{shown}]", 180, Curve(name, ink, x[:, k]), bounds=bounds)
        for name, shown, ink, x, bounds in (
            ("position", unit, "predicted", plan.q, (most.lower[k], most.upper[k])),
            ("speed", f"{unit}/s", "predicted", plan.v, (-most.speed[k], most.speed[k])),
            ("force", force, "residual", plan.tau, (-most.force[k], most.force[k])),
        )
    )
    return View("planned motion", plan.joints[k], plan.t, strips)


def describe_headline(plan: MotionPlan) -> str:
    """Return duration and what was minimised in a sentence."""
    aim = "the shortest time" if plan.energy_weight == 0 else f"least effort at weight {plan.energy_weight:.3g}"
    return f"{plan.duration:.4f} s, {aim} {_WAYS[plan.path]}."


_WAYS = {"free": "on a path of its own choice", "line": "on a straight line", "points": "through the points given"}


def describe_verdict(plan: MotionPlan) -> Verdict:
    """Return what holds the motion back."""
    if not plan.binding:
        return Verdict("good", "It reaches no limit: the effort holds it back.", "Within limits")
    reached = [f"{b.quantity} of {b.joint} ({format_percent(100 * b.share)} of the time)" for b in plan.binding]
    more = f" and {len(reached) - 4} more" if len(reached) > 4 else ""
    return Verdict("good", f"What holds it back: {format_list(reached[:4])}{more}.", "Within limits")


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
