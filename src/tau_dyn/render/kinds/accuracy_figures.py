"""Figures of accuracy, from results only: maps over the section, enlarged errors, error bodies, guideways, orientation."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from tau_dyn import results as r
from tau_dyn.kinematics.accuracy import AccuracyResult, Body
from tau_dyn.kinematics.assumptions import Guideway, Orientation
from tau_dyn.render.chart import LEGEND, choose_ticks
from tau_dyn.render.sketch import compute_hull

AXES = "xyz"
COMPARED = {
    "exact": "predicted",
    "linear": "residual",
    "parallelepiped": "first",
    "certified": "proved",
    "ellipsoid": "shells",
}
"""Methods in the chart of enlarged errors and their line styles."""


def format_size(metres: float, digits: int = 3) -> str:
    """Return a length in the most readable of um, mm and m."""
    if not np.isfinite(metres):
        return "none"
    factor, unit = next(
        ((f, u) for f, u, top in ((1e6, "µm", 1e-3), (1e3, "mm", 1.0)) if abs(metres) < top), (1.0, "m")
    )
    return f"{r.format_number(factor * metres, digits)} {unit}"


def scale_of(values: np.ndarray) -> tuple[float, str]:
    """Return factor and unit for a set of lengths [m]."""
    there = np.abs(values[np.isfinite(values)])
    top = float(np.quantile(there, 0.98)) if there.size else 0.0
    return (1e6, "µm") if top < 2e-3 else (1e3, "mm") if top < 2 else (1.0, "m")


def build_error_map(found: AccuracyResult, method: str) -> r.Figure:
    """Return the level plot of one method's largest error over the section (Figures 4.8, 4.10)."""
    a = found.accuracy
    assert a is not None
    return _build_map(found, a.largest[method], "largest error")


def build_usual_map(found: AccuracyResult) -> r.Figure:
    """Return the level plot of the bound that 95 % of random errors do not exceed."""
    a = found.accuracy
    assert a is not None
    return _build_map(found, a.usual, "95 % of random errors stay below")


def build_departure_map(found: AccuracyResult, method: str) -> r.Figure:
    """Return the level plot of a method's departure from the exact worst case [%]."""
    a = found.accuracy
    assert a is not None
    return _build_map(found, np.abs(a.off(method)), f"{method}: off by", (100.0, "%"))


def build_turn_map(found: AccuracyResult) -> r.Figure:
    """Return the level plot of the largest change of orientation."""
    a = found.accuracy
    assert a is not None
    turned = a.turned.get("exact", next(iter(a.turned.values())))
    return _build_map(found, turned, "largest change of orientation", (1e3, "mrad"))


def _build_map(
    found: AccuracyResult, values: np.ndarray, title: str, shown: tuple[float, str] | None = None
) -> r.Figure:
    """Return values of the poses over the section, both axes at the same scale, without empty rows and columns at the edges."""
    grid = found.grid
    assert grid is not None
    factor, unit = shown or scale_of(values)
    u, v, z = grid.u, grid.v, factor * grid.on_grid(values)
    rows, columns = (np.flatnonzero(np.isfinite(z).any(axis=axis)) for axis in (1, 0))
    if rows.size and rows[0] != rows[-1] and columns[0] != columns[-1]:
        row, c = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        u, v, z = u[c], v[row], z[row, c]
    spots, names = _find_guideways(found)
    reach, air = 0.35 * max(np.ptp(u), np.ptp(v)), 0.03 * max(np.ptp(u), np.ptp(v))
    near = np.all((spots > [u[0] - reach, v[0] - reach]) & (spots < [u[-1] + reach, v[-1] + reach]), axis=1)
    spots, names = spots[near], [name for name, close in zip(names, near, strict=True) if close]
    xlim, ylim = (
        (min(x[0], *s, x[0]) - air, max(x[-1], *s, x[-1]) + air) for x, s in zip((u, v), spots.T, strict=True)
    )
    marks: list[r.Mark] = [r.Levels(u, v, z, _choose_levels(z))]
    marks.append(r.Dots(spots[:, 0], spots[:, 1], "place", "square", 4.5))
    marks += [r.Label(float(x), float(y), f"  {name}", "place-name") for (x, y), name in zip(spots, names, strict=True)]
    scale = (r.HALF - 56 - LEGEND) / (xlim[1] - xlim[0])
    height = round(float(np.clip(scale * (ylim[1] - ylim[0]), 120, 560))) + 54
    a, b = grid.section.others
    x, y = r.Axis(f"{AXES[a]} [m]", xlim), r.Axis(f"{AXES[b]} [m]", ylim)
    return r.Figure(x, y, marks, title, (r.HALF, height), unit, "map")


def _choose_levels(values: np.ndarray) -> np.ndarray:
    """Return round levels over all values except the largest 2 %."""
    there = values[np.isfinite(values)]
    low, high = (float(there.min()), float(np.quantile(there, 0.98))) if there.size else (0.0, 1.0)
    if not high > low * (1 + 1e-9):
        high = low + (abs(low) or 1.0) * 1e-3
    inner = choose_ticks(low, high, about=8)
    step = inner[1] - inner[0] if len(inner) > 1 else high - low
    return np.concatenate([[inner[0] - step], inner, [inner[-1] + step]])


def _find_guideways(found: AccuracyResult) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the intersections of straight guideways with the section (K, 2), and the names of the guideways."""
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
        line = np.reshape(data.J, (6, -1))[:3, robot.model.joints[k].idx_v]  # for one joint Pinocchio gives a vector
        along = line[grid.section.axis]
        if abs(along) > 0.3:
            at = data.oMi[k].translation
            at = at + line * (grid.section.value - at[grid.section.axis]) / along
            points.append(at[list(grid.section.others)])
            names.append(joint)
    return np.array(points).reshape(-1, 2), tuple(names)


def build_growth_figure(found: AccuracyResult) -> r.Figure | None:
    """Return the departure of each bound from the exact worst case over a common factor on all errors."""
    g = found.growth
    if g is None or len(g.factors) < 3:
        return None
    curves = {m: 100 * np.abs(x / g.largest["exact"] - 1) for m, x in g.largest.items() if m != "exact"}
    seen = np.concatenate([c[np.isfinite(c)] for c in curves.values()] or [np.ones(1)])
    if not seen.size:
        return None
    ylim = 1e-3, max(1.0, 1.3 * float(seen.max()))
    lines = [
        r.Line(g.factors, np.where(np.isfinite(c), np.clip(c, *ylim), np.nan), COMPARED[m]) for m, c in curves.items()
    ]
    x = r.Axis("times the stated errors", (float(g.factors[0]), float(g.factors[-1])), log=True)
    return r.Figure(x, r.Axis("off by [%]", ylim, log=True), lines, "all errors enlarged, worst pose", (r.HALF, 300))


def build_body_figures(body: Body) -> list[r.Figure]:
    """Return the error body at one pose from three sides: random errors, the parallelepiped, the worst case."""
    everything = np.concatenate([body.cloud, body.corners, body.worst[None]])
    factor, unit = scale_of(np.linalg.norm(everything, axis=1))
    reach = 1.12 * factor * float(np.nanmax(np.abs(everything)))
    return [_build_body(body, i, j, factor, unit, (-reach, reach)) for i, j in ((0, 1), (0, 2), (1, 2))]


def _build_body(body: Body, i: int, j: int, factor: float, unit: str, limits: tuple[float, float]) -> r.Figure:
    cloud, corners, worst = (factor * x[..., [i, j]] for x in (body.cloud, body.corners, body.worst))
    marks: list[r.Mark] = [r.Dots(cloud[:, 0], cloud[:, 1], "cloud")]
    around = compute_hull(corners) if len(corners) else None
    marks += [] if around is None else [r.Ring(corners[around], "box")]
    if np.isfinite(worst).all():
        ends = np.array([[0.0, 0.0], worst])
        marks.append(r.Line(ends[:, 0], ends[:, 1], "worst"))
    x, y = (r.Axis(f"{AXES[k]} [{unit}]", limits) for k in (i, j))
    return r.Figure(x, y, marks, "", (356, 354))


def build_guideway_figures(line: Guideway) -> list[r.Figure]:
    """Return a guideway's error along and across it over the travel (Figure 4.4)."""
    order, across = np.argsort(line.q, kind="stable"), np.linalg.norm(line.across, axis=1)
    factor, unit = scale_of(np.concatenate([line.along, across]))
    figures, x = [], r.Axis(f"{line.joint} [m]", r.pad_limits(line.q, share=0.02))
    for name, values, ink in (("along", factor * line.along, "predicted"), ("across", factor * across, "residual")):
        y = r.Axis(f"error {name} [{unit}]", r.pad_limits(values, np.zeros(1)))
        marks = r.Line(line.q[order], values[order], ink), r.Dots(line.q, values)
        figures.append(r.Figure(x, y, marks, f"{line.joint}, {name}", (r.HALF, 220)))
    return figures


def build_orientation_figure(found: Orientation) -> r.Figure:
    """Return the ZYZ Euler angles over the poses, each minus its mean (Figure 4.7)."""
    n, angles = np.arange(1.0, len(found.euler) + 1), np.degrees(found.euler - found.euler.mean(axis=0))
    lines = [r.Line(n, angles[:, k], ink) for k, ink in enumerate(("predicted", "residual", "expected"))]
    x, y = r.Axis("pose", (0.0, float(len(n) + 1))), r.Axis("[°]", r.pad_limits(angles))
    return r.Figure(x, y, lines, "ZYZ Euler angles less their means", (r.WHOLE, 260))
