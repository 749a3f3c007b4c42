"""The charts of accuracy: maps over the section, enlarged errors, error bodies, guideways and orientation. Reads results only."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from markupsafe import Markup

from tau_dyn.kinematics.accuracy import AccuracyResult, Body
from tau_dyn.kinematics.assumptions import Guideway, Orientation
from tau_dyn.report.accuracy_words import scale_of
from tau_dyn.report.level_plot import Map, draw_level_plot
from tau_dyn.report.log_chart import LogChart
from tau_dyn.report.projection import compute_hull
from tau_dyn.report.svg import BOTTOM, HALF, LEFT, RIGHT, TOP, WHOLE, Chart, format_path, format_tag, pad_limits

AXES = "xyz"
COMPARED = {
    "exact": "predicted",
    "linear": "residual",
    "parallelepiped": "first",
    "certified": "proved",
    "ellipsoid": "shells",
}
"""Methods in the chart of enlarged errors and their line styles."""


def draw_error_map(found: AccuracyResult, method: str) -> Markup:
    """Return the level plot of one method's largest error over the section (Figures 4.8, 4.10)."""
    a, grid = found.accuracy, found.grid
    assert a is not None and grid is not None
    factor, unit = scale_of(a.largest[method])
    return draw_level_plot(_map(found, factor * grid.on_grid(a.largest[method]), "largest error", unit))


def draw_usual_map(found: AccuracyResult) -> Markup:
    """Return the level plot of what 95 % of random errors stay below."""
    a, grid = found.accuracy, found.grid
    assert a is not None and grid is not None
    factor, unit = scale_of(a.usual)
    return draw_level_plot(_map(found, factor * grid.on_grid(a.usual), "95 % of random errors stay below", unit))


def draw_departure_map(found: AccuracyResult, method: str) -> Markup:
    """Return the level plot of a method's departure from the exact worst case [%]."""
    a, grid = found.accuracy, found.grid
    assert a is not None and grid is not None
    return draw_level_plot(_map(found, 100 * np.abs(grid.on_grid(a.off(method))), f"{method}: off by", "%"))


def turn_map(found: AccuracyResult) -> Markup:
    """Return the level plot of the largest change of orientation."""
    a, grid = found.accuracy, found.grid
    assert a is not None and grid is not None
    method = "exact" if "exact" in a.turned else next(iter(a.turned))
    return draw_level_plot(_map(found, 1e3 * grid.on_grid(a.turned[method]), "largest change of orientation", "mrad"))


def _map(found: AccuracyResult, values: np.ndarray, title: str, unit: str) -> Map:
    grid = found.grid
    assert grid is not None
    a, b = grid.section.others
    marks, names = _guideways(found)
    return Map(grid.u, grid.v, values, title, f"{AXES[a]} [m]", f"{AXES[b]} [m]", unit, marks, names)


def _guideways(found: AccuracyResult) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return where straight guideways pierce the section (K, 2) and whose they are."""
    grid, robot = found.grid, found.robot
    assert grid is not None
    points, names = [], []
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, pin.neutral(robot.model))
    pin.computeJointJacobians(robot.model, data)
    for joint, kind in zip(robot.actuated, robot.joint_kinds, strict=True):
        k = robot.model.getJointId(joint)
        if kind != "prismatic" or robot.model.parents[k] != 0:
            continue
        line = np.reshape(data.J, (6, -1))[:3, robot.model.joints[k].idx_v]  # of one joint Pinocchio gives a vector
        along = line[grid.section.axis]
        if abs(along) > 0.3:
            at = data.oMi[k].translation
            at = at + line * (grid.section.value - at[grid.section.axis]) / along
            points.append(at[list(grid.section.others)])
            names.append(joint)
    return np.array(points).reshape(-1, 2), tuple(names)


def draw_growth_chart(found: AccuracyResult) -> Markup:
    """Return how each bound departs from the exact worst case when all errors are enlarged together."""
    g = found.growth
    if g is None or len(g.factors) < 3:
        return Markup("")
    exact = g.largest["exact"]
    curves = {m: 100 * np.abs(g.largest[m] / exact - 1) for m in g.largest if m != "exact"}
    seen = np.concatenate([c[np.isfinite(c)] for c in curves.values()] or [np.ones(1)])
    if not seen.size:
        return Markup("")
    ylim = 1e-3, max(1.0, 1.3 * float(seen.max()))
    xlim = float(g.factors[0]), float(g.factors[-1])
    chart = LogChart(
        HALF, 300, xlim, ylim, "all errors enlarged, worst pose", "times the stated errors", "off by [%]", log_y=True
    )
    lines = [
        chart.line(g.factors, np.where(np.isfinite(c), np.clip(c, *ylim), np.nan), COMPARED[m])
        for m, c in curves.items()
    ]
    return chart.render(*lines)


def draw_body_charts(body: Body) -> list[Markup]:
    """Return the error body at one pose from three sides: random errors, the parallelepiped, the worst case."""
    everything = np.concatenate([body.cloud, body.corners, body.worst[None]])
    factor, unit = scale_of(np.linalg.norm(everything, axis=1))
    reach = 1.12 * factor * float(np.nanmax(np.abs(everything)))
    return [_body_chart(body, i, j, factor, unit, reach) for i, j in ((0, 1), (0, 2), (1, 2))]


def _body_chart(body: Body, i: int, j: int, factor: float, unit: str, reach: float) -> Markup:
    side = 300
    chart = Chart(side + LEFT + RIGHT, side + TOP + BOTTOM, (-reach, reach), (-reach, reach), "", f"{AXES[i]} [{unit}]",
                  f"{AXES[j]} [{unit}]")  # fmt: skip
    cloud, corners, worst = (factor * x[..., [i, j]] for x in (body.cloud, body.corners, body.worst))
    content = [chart.dots(cloud[:, 0], cloud[:, 1], "cloud")]
    if len(corners):
        content.append(_outline(chart, corners))
    if np.isfinite(worst).all():
        ends = np.array([[0.0, 0.0], worst])
        content.append(chart.line(ends[:, 0], ends[:, 1], "worst"))
    return chart.render(*content)


def _outline(chart: Chart, corners: np.ndarray) -> Markup:
    around = compute_hull(corners)
    if around is None:
        return Markup("")
    ring = corners[around]
    return format_tag(
        "path", d=format_path(np.column_stack([chart.x(ring[:, 0]), chart.y(ring[:, 1])]), closed=True), class_="box"
    )


def draw_guideway_charts(line: Guideway) -> list[Markup]:
    """Return a guideway's error along and across it over the travel (Figure 4.4)."""
    order = np.argsort(line.q, kind="stable")
    across = np.linalg.norm(line.across, axis=1)
    factor, unit = scale_of(np.concatenate([line.along, across]))
    charts = []
    for name, values, style in (("along", line.along, "predicted"), ("across", across, "residual")):
        values = factor * values
        chart = Chart(HALF, 220, pad_limits(line.q, share=0.02), pad_limits(values, np.zeros(1)), f"{line.joint}, {name}",
                      f"{line.joint} [m]", f"error {name} [{unit}]")  # fmt: skip
        charts.append(chart.render(chart.line(line.q[order], values[order], style), chart.dots(line.q, values, "mean")))
    return charts


def draw_orientation_chart(found: Orientation) -> Markup:
    """Return the ZYZ Euler angles over the poses, each less its mean (Figure 4.7)."""
    n = np.arange(1, len(found.euler) + 1)
    angles = np.degrees(found.euler - found.euler.mean(axis=0))
    chart = Chart(
        WHOLE, 260, (0.0, float(len(n) + 1)), pad_limits(angles), "ZYZ Euler angles less their means", "pose", "[°]"
    )
    styles = ("predicted", "residual", "expected")
    return chart.render(*[chart.line(n.astype(float), angles[:, k], styles[k]) for k in range(3)])
