"""The page's charts: friction over speed, and what is left. Each takes results, none estimates anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from tau_dyn.effects import JointwiseEffect, Motion, TorqueOffset
from tau_dyn.identify import Identification
from tau_dyn.report.formatting import format_number, format_unit
from tau_dyn.report.parameter_rows import ParameterRow
from tau_dyn.report.residuals import ResidualSummary
from tau_dyn.report.svg import THIRD, Chart, format_tag, pad_limits

DOTS = 1200  # samples of a friction curve drawn at most
BINS = 24  # of speed; a curve of 24 points reads as one line
SMALL = (THIRD, 240)


@dataclass(frozen=True)
class Friction:
    """One joint's friction: measured force minus every other identified force.

    The fit's low-pass smears the law's step at zero speed in data and columns alike. A sample is therefore shown at the law's
    own value plus its residual, which is the same difference without that smear.

    Attributes:
        joint: The joint.
        unit: Unit of the force.
        speed_unit: Unit of the speed.
        v: Speeds of the used samples (n,).
        force: Law plus residual of these samples (n,).
        grid: Speeds at which the law is drawn (m,), with a step at zero.
        law: The identified law there (m,).
        offset: Constant force that was taken off; 0 where the model has none.
        threshold: Speed below which samples are masked.
    """

    joint: str
    unit: str
    speed_unit: str
    v: np.ndarray
    force: np.ndarray
    grid: np.ndarray
    law: np.ndarray
    offset: float
    threshold: float


def build_friction_curves(found: Identification) -> list[Friction]:
    """Return the friction of every joint that has a law of its own speed and moved."""
    effects = [e for e in found.model.effects if isinstance(e, JointwiseEffect) and not isinstance(e, TorqueOffset)]
    joints = found.model.robot.actuated
    curves = [_friction(found, k, [e for e in effects if joint in e.joints]) for k, joint in enumerate(joints)]
    return [curve for curve in curves if curve is not None]


def _friction(found: Identification, k: int, effects: list[JointwiseEffect]) -> Friction | None:
    regression, robot = found.estimate.regression, found.model.robot
    joint = robot.actuated[k]
    masks = [run.usable[:, k] for run in regression.runs]
    if not effects or not any(m.any() for m in masks):
        return None
    v = np.concatenate([r.signals["v"][m, k] for r, m in zip(regression.runs, masks, strict=True)])
    residual = np.concatenate([e[m, k] for e, m in zip(found.estimate.residuals(), masks, strict=True)])
    force, grid = _law(found, k, effects, v) + residual, _speeds(v)
    offset = found.parameters[f"{joint}.offset"].value if f"{joint}.offset" in found.parameters else 0.0
    return Friction(
        joint, regression.units[k], f"{robot.position_units[k]}/s", v, force, grid, _law(found, k, effects, grid), offset,
        float(regression.preparation.speed_threshold[k]),
    )  # fmt: skip


def _speeds(v: np.ndarray) -> np.ndarray:
    low, high = min(0.0, float(v.min())), max(0.0, float(v.max()))
    tiny = 1e-9 * max(high - low, 1e-12)
    down = np.linspace(low, -tiny, 60) if low < 0 else np.empty(0)
    up = np.linspace(tiny, high, 60) if high > 0 else np.empty(0)
    return np.concatenate([down, up])


def _law(found: Identification, k: int, effects: list[JointwiseEffect], grid: np.ndarray) -> np.ndarray:
    robot = found.model.robot
    v = np.zeros((len(grid), robot.na))
    v[:, k] = grid
    motion = Motion.of(robot.actuated, np.zeros_like(v), v, np.zeros_like(v))
    return np.sum([effect.force(motion, found.parameters)[:, k] for effect in effects], axis=0)


def draw_friction_chart(curve: Friction) -> Markup:
    """Return the friction curve: the cloud of samples, their mean in bins of speed, and the identified law."""
    at, mean, deviation = average_in_bins(curve.v, curve.force)
    ylim = pad_limits(np.quantile(curve.force, [0.003, 0.997]), curve.law, mean)
    chart = Chart(
        *SMALL, pad_limits(curve.grid, share=0.03), ylim, curve.joint,
        f"speed [{curve.speed_unit}]", f"friction [{curve.unit}]",
    )  # fmt: skip
    step = max(1, len(curve.v) // DOTS)
    v, force = curve.v[::step], np.clip(curve.force[::step], *ylim)
    return chart.render(
        chart.band([(-curve.threshold, curve.threshold)], "masked"),
        chart.dots(v, force, "cloud"),
        chart.verticals(at, np.clip(mean - deviation, *ylim), np.clip(mean + deviation, *ylim), "whisker"),
        chart.line(curve.grid, curve.law, "predicted"),
        chart.dots(at, mean, "mean"),
    )


def average_in_bins(x: np.ndarray, y: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean x, mean y and y's deviation in steps of x that do not straddle zero; steps of few samples are left out."""
    width = float(np.ptp(x)) / bins or 1.0
    index = np.floor(x / width).astype(int)
    rows = []
    for i in np.unique(index):
        members = index == i
        if members.sum() >= 5:
            rows.append((x[members].mean(), y[members].mean(), y[members].std()))
    at, mean, deviation = np.array(rows).T if rows else np.empty((3, 0))
    return at, mean, deviation


def draw_histogram(residual: ResidualSummary) -> Markup:
    """Return how the residual is distributed, with the normal distribution of the same width."""
    sigma = float(np.std(residual.values)) or 1.0
    edges = np.linspace(-4, 4, 41) * sigma
    counts, _ = np.histogram(np.clip(residual.values, edges[0], edges[-1]), edges)
    density = counts / max(1, len(residual.values)) / (edges[1] - edges[0]) * sigma
    grid = np.linspace(-4, 4, 161)
    normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
    top = 1.15 * max(float(density.max()), 0.4)
    chart = Chart(
        *SMALL, (float(edges[0]), float(edges[-1])), (0, top), residual.joint,
        f"residual [{format_unit(residual.unit)}]", "share [per σ]",
    )  # fmt: skip
    steps = np.repeat(edges, 2)[1:-1], np.repeat(density, 2)
    area = np.concatenate([[edges[0]], steps[0], [edges[-1]]]), np.concatenate([[0], steps[1], [0]])
    return chart.render(chart.line(*area, "histogram"), chart.line(grid * sigma, normal, "expected"))


def draw_correlation_chart(residual: ResidualSummary) -> Markup:
    """Return the residual's autocorrelation with what the filter alone would leave."""
    low = min(-0.3, float(residual.correlation.min()) - 0.05)
    chart = Chart(*SMALL, (0, float(residual.lags[-1])), (low, 1.05), residual.joint, "time lag [s]", "autocorrelation")
    bound = np.full(2, residual.bound)
    ends = np.array([0, residual.lags[-1]])
    return chart.render(
        chart.line(ends, bound, "bound"),
        chart.line(ends, -bound, "bound"),
        chart.line(residual.lags, residual.expected, "expected"),
        chart.line(residual.lags, residual.correlation, "residual"),
    )


def draw_interval_bar(low: float, high: float, at: float | None, trust: float, state: str, anchored: bool) -> Markup:
    """Return a parameter's estimate and 95 % interval relative to its nominal value at the middle, cut at the scale."""

    def x(share: float) -> float:
        return 70.0 + 64.0 * share

    pieces = [format_tag("path", d="M6 9H134", class_="bar-axis")]
    if trust:
        pieces.append(format_tag("rect", x=x(-trust), y=4, width=128.0 * trust, height=10, class_="bar-trust"))
    if anchored:
        pieces.append(format_tag("path", d="M70 2V16", class_="bar-nominal"))
    pieces.append(format_tag("path", d=f"M{x(low):.1f} 9H{max(x(high), x(low) + 0.5):.1f}", class_="bar-interval"))
    if low <= -1:
        pieces.append(format_tag("path", d="M7 5L2 9L7 13", class_="bar-cut"))
    if high >= 1:
        pieces.append(format_tag("path", d="M133 5L138 9L133 13", class_="bar-cut"))
    if at is not None:
        pieces.append(format_tag("circle", cx=x(at), cy=9, r=3.4, class_="bar-dot"))
    return format_tag(
        "svg", *pieces, viewBox="0 0 140 18", width=140, height=18, class_=f"bar {state}", aria_hidden="true"
    )


def draw_row_bar(row: ParameterRow) -> Markup:
    """Return the bar of a line of the parameter table; nothing where it has none."""
    if row.bar is None:
        return Markup("")
    return draw_interval_bar(row.bar.low, row.bar.high, row.bar.at, row.bar.trust, row.state, bool(row.nominal))


def describe_offset(curve: Friction) -> str:
    """Return what constant force was taken off a friction curve, empty if none."""
    return f"{curve.joint}: offset {format_number(curve.offset, 3)} {format_unit(curve.unit)}" if curve.offset else ""
