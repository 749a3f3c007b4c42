"""The charts of how a model of resonances was chosen, and what it is: stabilisation, orders, delays, poles.

Nothing is computed here that the result does not hold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from tau_dyn.modes import Modes, OperationalModes, StabilityPoint
from tau_dyn.report.formatting import Z95
from tau_dyn.report.log_chart import LogChart
from tau_dyn.report.modes_charts import convert_to_decibels, draw_mode_lines, select_ends, select_excited
from tau_dyn.report.modes_svg import draw_across, draw_along, draw_between, draw_ellipse, draw_marks
from tau_dyn.report.svg import THIRD, WHOLE, Chart, format_tag, pad_limits


def draw_stabilisation_chart(found: Modes) -> Markup:
    """Return modes of all orders: filled where stable, rings where only the frequency agrees, small where new; 95 % bars."""
    orders = [t.order for t in found.order_choice.trials] or [found.order]
    limits = select_ends(found.response.frequency)
    chart = _stabilisation_axes(limits, max(orders))
    return chart.render(
        *draw_mode_lines(found, chart),
        _skyline(found, chart),
        draw_along(chart, found.order, "chosen-line"),
        *_stability_points(found.stabilisation, chart),
        chart.text(limits[1], found.order + 0.25, "chosen", "chosen-name", "end"),
    )


def draw_operational_stabilisation_chart(found: OperationalModes) -> Markup:
    """Return the same for responses alone."""
    f = [q.frequency_hz for q in found.stabilisation]
    limits = (0.8 * min(f), min(1.25 * max(f), 0.5 / found.dt))
    chart = _stabilisation_axes(limits, found.order)
    lines = [draw_across(chart, m.frequency_hz, "mode-line") for m in found.modes]
    return chart.render(*lines, *_stability_points(found.stabilisation, chart))


def _stabilisation_axes(limits: tuple[float, float], highest: int) -> LogChart:
    return LogChart(WHOLE, 470, limits, (0.0, highest + 1.5), "", "frequency [Hz]", "order of the model")


def _stability_points(points: Sequence[StabilityPoint], chart: LogChart) -> list[Markup]:
    """Return the marks of modes by kind, with their 95 % bars."""
    limits, drawn = chart.xlim, []
    inside = [q for q in points if limits[0] <= q.frequency_hz <= limits[1]]
    for kind in ("new", "frequency", "stable"):
        some = [q for q in inside if q.kind == kind]
        if not some:
            continue
        f, n = np.array([q.frequency_hz for q in some]), np.array([float(q.order) for q in some])
        half = Z95 * np.nan_to_num([q.frequency_stderr for q in some])
        if kind != "new":
            drawn.append(_bars(chart, np.clip(f - half, *limits), np.clip(f + half, *limits), n, f"bar-{kind}"))
        drawn.append(
            chart.dots(f, n, f"pole-{kind}")
            if kind != "frequency"
            else draw_marks(chart, f, n, "ring", "pole-frequency", 3.5)
        )
    return drawn


def _skyline(found: Modes, chart: LogChart) -> Markup:
    """Return the data's own response, all pairs together, as a pale skyline behind the diagram."""
    seen = select_excited(found)
    at, response = found.empirical.frequency[seen], found.empirical.response[seen]
    size = np.sqrt(np.mean(np.abs(response) ** 2, axis=2))
    size = np.sqrt(np.mean((size / np.nanmax(size, axis=0)) ** 2, axis=1))
    db = convert_to_decibels(size)
    keep = np.isfinite(db) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    if keep.sum() < 3:
        return Markup("")
    low, high = float(np.quantile(db[keep], 0.02)), float(db[keep].max())
    height = 0.96 * chart.ylim[1] * np.clip((db[keep] - low) / max(high - low, 1e-9), 0, 1)
    return draw_between(chart, at[keep], np.zeros(keep.sum()), height, "skyline")


def _bars(chart: Chart, low: np.ndarray, high: np.ndarray, y: np.ndarray, class_: str) -> Markup:
    ends = zip(chart.x(low), chart.x(high), chart.y(y), strict=True)
    return format_tag("path", d="".join(f"M{a:.1f} {c:.1f}H{b:.1f}" for a, b, c in ends), class_=class_)


def order_chart(found: Modes) -> Markup:
    """Return, over the order, how well models simulate data they were not fitted to."""
    trials = found.order_choice.trials
    n, fit = np.array([float(t.order) for t in trials]), np.array([t.fit_percent for t in trials])
    best = float(fit.max())
    low = max(float(fit.min()), best - 40.0)
    chart = Chart(
        THIRD, 200, pad_limits(n, share=0.05), pad_limits(np.array([low, best]), share=0.12), "", "order", "fit [%]"
    )
    return chart.render(
        draw_across(chart, found.order, "chosen-line"),
        chart.line(n, np.clip(fit, chart.ylim[0], None), "predicted"),
        chart.dots(n, np.clip(fit, chart.ylim[0], None), "mean"),
    )


def draw_criterion_chart(found: Modes) -> Markup:
    """Return the information criteria over the order, each above its own least value."""
    trials = found.order_choice.trials
    n = np.array([float(t.order) for t in trials])
    curves = [
        (np.array([getattr(t, name) for t in trials]), ink) for name, ink in (("bic", "predicted"), ("aic", "residual"))
    ]
    above = [(np.log10(1 + c - c.min()), ink) for c, ink in curves]
    chart = Chart(
        THIRD,
        200,
        pad_limits(n, share=0.05),
        pad_limits(*(c for c, _ in above), share=0.1),
        "",
        "order",
        "log₁₀(1 + above best)",
    )
    return chart.render(draw_across(chart, found.order, "chosen-line"), *[chart.line(n, c, ink) for c, ink in above])


def draw_delay_chart(found: Modes) -> Markup:
    """Return BIC above the best over the delays that were scanned."""
    d, _, gap = (np.array(c, float) for c in zip(*found.delay_choice.scan, strict=True))
    height = np.log10(1 + gap)
    chart = Chart(
        THIRD,
        200,
        pad_limits(d, share=0.05),
        pad_limits(height, share=0.1),
        "",
        "delay [samples]",
        "log₁₀(1 + BIC above best)",
    )
    return chart.render(
        draw_across(chart, found.delay, "chosen-line"),
        chart.line(d, height, "predicted"),
        chart.dots(d, height, "mean"),
    )


def draw_pole_chart(found: Modes) -> Markup:
    """Return poles and zeros in the s plane, each pole with its 95 % ellipse."""
    known = [q for q in found.poles if q.oscillates]
    if not known:
        return Markup("")
    re, im = np.array([q.s.real for q in known]), np.array([q.s.imag for q in known]) / (2 * np.pi)
    reach = [3.2 * np.sqrt(np.diag(q.covariance)) if q.covariance is not None else np.zeros(2) for q in known]
    some = np.array(reach)
    xlim = pad_limits(np.concatenate([re - some[:, 0], re + some[:, 0], [0.0]]), share=0.08)
    xlim = (max(xlim[0], 3 * float(re.min())), xlim[1])
    ylim = pad_limits(np.concatenate([im, [0.0]]), share=0.08)
    chart = Chart(WHOLE, 420, xlim, (min(0.0, ylim[0]), ylim[1]), "", "decay, Re s [1/s]", "Im s / 2π [Hz]")
    turn = np.diag([1.0, 1 / (2 * np.pi)])
    drawn = [draw_across(chart, 0.0, "zero")]
    for pole, x, y in zip(known, re, im, strict=True):
        if pole.covariance is not None and x >= xlim[0]:
            drawn.append(draw_ellipse(chart, (float(x), float(y)), turn @ pole.covariance @ turn, "sure ring"))
    inside = re >= xlim[0]
    zeros = found.zeros[(found.zeros.real >= xlim[0]) & (found.zeros.real <= xlim[1])]
    zeros = zeros[zeros.imag / (2 * np.pi) <= chart.ylim[1]]
    drawn.append(draw_marks(chart, zeros.real, zeros.imag / (2 * np.pi), "ring", "pole-frequency", 4.0))
    drawn.append(draw_marks(chart, re[inside], im[inside], "cross", "pole-cross", 4.5))
    for x, y in zip(re[inside], im[inside], strict=True):
        natural = float(np.hypot(x / (2 * np.pi), y))
        drawn.append(
            chart.text(float(x), float(y) + 0.02 * (chart.ylim[1] - chart.ylim[0]), f"  {natural:.4g} Hz", "pole-name")
        )
    return chart.render(*drawn)
