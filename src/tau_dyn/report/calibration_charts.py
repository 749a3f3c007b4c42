"""Drawings of a calibration: errors pose by pose, error vectors in space, errors along a joint."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from tau_dyn.calibrate import Calibration, CandidateModel
from tau_dyn.report.log_chart import LogChart
from tau_dyn.report.projection import BOX_EDGES, compute_box_corners, project
from tau_dyn.report.svg import Chart, format_tag, pad_limits

_ARROW = 0.13
"""Length of the largest error vector, as a share of the picture."""


def draw_error_chart(found: Calibration, *, turned: bool = False) -> Markup:
    """Return absolute errors pose by pose, before and after (thesis, figures 5.1, 5.9, 5.26)."""
    before, after = (found.errors(m) for m in (found.models[0], found.chosen))
    if turned:
        assert before.angle is not None and after.angle is not None
        rows, name, unit = (before.angle, after.angle), "orientation error", "mrad"
    else:
        rows, name, unit = (before.distance, after.distance), "position error", "mm"
    a, b = (1e3 * row for row in rows)
    index = np.arange(1, len(a) + 1)
    values = np.concatenate([a, b])
    values = values[np.isfinite(values) & (values > 0)]
    low, high = (float(values.min()), float(values.max())) if values.size else (1.0, 1.0)
    chart = LogChart(
        1100,
        260,
        (0.0, len(a) + 1.0),
        (low / 1.3, high * 1.3),
        name,
        "unseen pose",
        f"[{unit}]",
        log_x=False,
        log_y=True,
    )
    return chart.render(
        chart.line(index, a, "measured thin"), chart.line(index, b, "predicted"), chart.dots(index, b, "pose")
    )


def draw_vector_pictures(found: Calibration) -> list[tuple[str, str, Markup]]:
    """Return the error vectors in space before and after: title, scale in words, drawing."""
    pictures = []
    for title, model in (("robot file", found.models[0]), ("calibrated", found.chosen)):
        drawn = _vectors(found, model)
        if drawn is not None:
            pictures.append((title, *drawn))
    return pictures[-1:] if len(found.models) == 1 else pictures


def _vectors(found: Calibration, model: CandidateModel) -> tuple[str, Markup] | None:
    poses, error = found.at(), found.errors(model).position
    turn = found.fit.frames.device[0].rotation
    base = (poses.position - found.fit.frames.device[0].translation) @ turn
    error = error @ turn
    ok = np.isfinite(error).all(axis=1)
    if not ok.any():
        return None
    base, error = base[ok], error[ok]
    at, along = project(base), project(error)
    corners = project(compute_box_corners(base.min(axis=0), base.max(axis=0)))
    low, high = corners.min(axis=0), corners.max(axis=0)
    extent = float(np.max(high - low)) or 1.0
    largest = float(np.percentile(np.linalg.norm(error, axis=1), 95)) or 1.0
    times = _round_down(_ARROW * extent / largest)
    scale = 440.0 / (extent * (1 + 2 * _ARROW))
    shift = low - _ARROW * extent
    size = (high - low + 2 * _ARROW * extent) * scale
    x = (at - shift) * scale
    y = (at + times * along - shift) * scale
    lines = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in zip(x, y, strict=True))
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in x)
    svg = format_tag(
        "svg",
        format_tag("title", "error vectors at unseen poses"),
        _edges(base, shift, scale),
        format_tag("path", d=lines, class_="error"),
        format_tag("path", d=dots, class_="place"),
        viewBox=f"0 0 {size[0]:.0f} {size[1]:.0f}",
        role="img",
        class_="chart vectors",
    )
    return f"errors drawn {times:g} times their size", svg


def _edges(base: np.ndarray, shift: np.ndarray, scale: float) -> Markup:
    """Return the box around the poses, and the base's axes' names at its lower corner."""
    at = (project(compute_box_corners(base.min(axis=0), base.max(axis=0))) - shift) * scale
    lines = "".join(f"M{at[i][0]:.1f} {at[i][1]:.1f}L{at[j][0]:.1f} {at[j][1]:.1f}" for i, j in BOX_EDGES)
    names = [
        format_tag("text", "xyz"[a], x=float(at[1 << a][0]), y=float(at[1 << a][1]) - 4, class_="axis-name")
        for a in range(3)
    ]
    return format_tag("path", d=lines, class_="box") + Markup("").join(names)


def _round_down(x: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(x, 1e-9)))
    return float(power * max(m for m in (1, 2, 5) if m * power <= x * (1 + 1e-9)))


def draw_residuals_along_joints(found: Calibration) -> list[Markup]:
    """Return, joint by joint, what is left over that joint's position: what is still cyclic or crooked would show."""
    poses, after = found.at(), found.errors(found.chosen)
    turn = found.fit.frames.device[0].rotation
    error = 1e6 * (after.position @ turn)
    charts = []
    for k, joint in enumerate(found.robot.actuated):
        axis = int(np.nanargmax(np.nanstd(error, axis=0))) if np.isfinite(error).any() else 0
        x, y = poses.q[:, k], error[:, axis]
        ok = np.isfinite(y)
        unit = found.robot.position_units[k]
        chart = Chart(
            340,
            200,
            pad_limits(x[ok]),
            pad_limits(y[ok], np.zeros(1)),
            joint,
            f"q [{unit}]",
            f"left along {'xyz'[axis]} [µm]",
        )
        charts.append(chart.render(chart.dots(x[ok], y[ok], "pose")))
    return charts
