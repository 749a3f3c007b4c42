"""The charts of resonances: response, coherence, stabilisation, poles, orders, residual tests, pulses.

Nothing is computed here that the result does not hold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from tau_dyn.modes.checks import CorrelationTest
from tau_dyn.modes.result import Modes
from tau_dyn.report.modes_svg import LogChart, across, along, between, ellipse, marks
from tau_dyn.report.modes_words import resonances
from tau_dyn.report.svg import Chart, padded

DOTS = 700
WIDTHS = {1: 1060, 2: 520}
NARROW, WIDE = 344, 1060
MOST_PAIRS = 9
FLOOR_DB = 70.0
"""Decibels below the highest peak at which a response is cut off."""
SIGMAS = 1.96


def pairs(found: Modes) -> list[tuple[int, int]]:
    """Return output and input of the responses that are drawn, by output; the strongest where there are too many."""
    p, m = len(found.outputs), len(found.inputs)
    every = [(i, j) for i in range(p) for j in range(m)]
    if len(every) <= MOST_PAIRS:
        return every
    size = np.abs(found.response.value).max(axis=0)
    size = size / size.max(axis=1, keepdims=True)  # outputs may have unlike units
    return sorted(sorted(every, key=lambda pair: -size[pair])[:MOST_PAIRS])


def columns(found: Modes) -> int:
    """Return how many charts of pairs stand side by side."""
    return min(len(found.inputs), 3) if len(pairs(found)) == len(found.inputs) * len(found.outputs) else 3


def _size(found: Modes, height: int) -> tuple[int, int]:
    width = WIDTHS.get(columns(found), NARROW)
    return width, height + (60 if width > NARROW else 0)


def bode_chart(found: Modes, i: int, j: int) -> Markup:
    """Return magnitude over frequency: the data's own response as dots, the model's with its 95 % band over it."""
    f, g, sigma = found.response.frequency, np.abs(found.response.value[:, i, j]), found.response.deviation[:, i, j]
    seen = _shown(found)
    dots = np.abs(found.empirical.response[seen, i, j])
    low, high = _decibel_limits(g, dots)
    chart = LogChart(
        *_size(found, 210), _limits(f), (low, high), f"{found.inputs[j]} → {found.outputs[i]}", "frequency [Hz]", "[dB]"
    )
    spread = SIGMAS * sigma / np.sqrt(2)  # along the vector: half of the squared radius
    at = found.empirical.frequency[seen]
    db = _decibels(dots)
    keep = np.isfinite(_within(db, low, high)) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(
        *[across(chart, m.frequency_hz, "mode-line") for m in resonances(found) if _inside(chart, m.frequency_hz)],
        chart.dots(*_thin(at[keep], db[keep]), "data"),
        between(chart, f, _decibels(np.maximum(g - spread, 1e-300)), _decibels(g + spread), "sure"),
        chart.line(f, _within(_decibels(g), low, high), "predicted"),
    )


def phase_chart(found: Modes, i: int, j: int) -> Markup:
    """Return phase over frequency, data and model."""
    f, seen = found.response.frequency, _shown(found)
    chart = LogChart(*_size(found, 130), _limits(f), (-190.0, 190.0), "", "frequency [Hz]", "phase [°]")
    phase = np.degrees(np.angle(found.response.value[:, i, j]))
    phase[1:][np.abs(np.diff(phase)) > 180] = np.nan  # a wrap is no line
    at = found.empirical.frequency[seen]
    dots = np.degrees(np.angle(found.empirical.response[seen, i, j]))
    keep = np.isfinite(dots) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(chart.dots(*_thin(at[keep], dots[keep]), "data"), chart.line(f, phase, "predicted"))


def coherence_chart(found: Modes, i: int) -> Markup:
    """Return the share of an output's power that the inputs explain, over frequency."""
    chart = LogChart(
        *_size(found, 130),
        _limits(found.response.frequency),
        (0.0, 1.05),
        found.outputs[i],
        "frequency [Hz]",
        "coherence",
    )
    at, value = found.empirical.frequency, found.empirical.coherence[:, i]
    keep = (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(
        *[across(chart, m.frequency_hz, "mode-line") for m in resonances(found) if _inside(chart, m.frequency_hz)],
        chart.line(at[keep], value[keep], "mean-line"),
    )


def stabilisation_chart(found: Modes) -> Markup:
    """Return modes of all orders: filled where stable, rings where only the frequency agrees, small where new; 95 % bars."""
    points = found.stabilisation
    orders = [t.order for t in found.order_choice.trials] or [found.order]
    limits = _limits(found.response.frequency)
    inside = [q for q in points if limits[0] <= q.frequency_hz <= limits[1]]
    chart = LogChart(WIDE, 470, limits, (0.0, max(orders) + 1.5), "", "frequency [Hz]", "order of the model")
    drawn = [across(chart, m.frequency_hz, "mode-line") for m in resonances(found) if _inside(chart, m.frequency_hz)]
    drawn += [_skyline(found, chart), along(chart, found.order, "chosen-line")]
    for kind in ("new", "frequency", "stable"):
        some = [q for q in inside if q.kind == kind]
        if not some:
            continue
        f, n = np.array([q.frequency_hz for q in some]), np.array([float(q.order) for q in some])
        half = SIGMAS * np.nan_to_num([q.frequency_stderr for q in some])
        if kind != "new":
            drawn.append(_bars(chart, np.clip(f - half, *limits), np.clip(f + half, *limits), n, f"bar-{kind}"))
        drawn.append(
            chart.dots(f, n, f"pole-{kind}")
            if kind != "frequency"
            else marks(chart, f, n, "ring", "pole-frequency", 3.5)
        )
    drawn.append(chart.text(limits[1], found.order + 0.25, "chosen", "chosen-name", "end"))
    return chart.render(*drawn)


def _skyline(found: Modes, chart: LogChart) -> Markup:
    """Return the data's own response, all pairs together, as a pale skyline behind the diagram."""
    seen = _shown(found)
    at, response = found.empirical.frequency[seen], found.empirical.response[seen]
    size = np.sqrt(np.mean(np.abs(response) ** 2, axis=2))
    size = np.sqrt(np.mean((size / np.nanmax(size, axis=0)) ** 2, axis=1))
    db = _decibels(size)
    keep = np.isfinite(db) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    if keep.sum() < 3:
        return Markup("")
    low, high = float(np.quantile(db[keep], 0.02)), float(db[keep].max())
    height = 0.96 * chart.ylim[1] * np.clip((db[keep] - low) / max(high - low, 1e-9), 0, 1)
    return between(chart, at[keep], np.zeros(keep.sum()), height, "skyline")


def _bars(chart: Chart, low: np.ndarray, high: np.ndarray, y: np.ndarray, class_: str) -> Markup:
    from tau_dyn.report.svg import tag

    ends = zip(chart.x(low), chart.x(high), chart.y(y), strict=True)
    return tag("path", d="".join(f"M{a:.1f} {c:.1f}H{b:.1f}" for a, b, c in ends), class_=class_)


def order_chart(found: Modes) -> Markup:
    """Return, over the order, how well models simulate data they were not fitted to."""
    trials = found.order_choice.trials
    n, fit = np.array([float(t.order) for t in trials]), np.array([t.fit_percent for t in trials])
    best = float(fit.max())
    low = max(float(fit.min()), best - 40.0)
    chart = Chart(344, 200, padded(n, share=0.05), padded(np.array([low, best]), share=0.12), "", "order", "fit [%]")
    return chart.render(
        across(chart, found.order, "chosen-line"),
        chart.line(n, np.clip(fit, chart.ylim[0], None), "predicted"),
        chart.dots(n, np.clip(fit, chart.ylim[0], None), "mean"),
    )


def criterion_chart(found: Modes) -> Markup:
    """Return the information criteria over the order, each above its own least value."""
    trials = found.order_choice.trials
    n = np.array([float(t.order) for t in trials])
    curves = [
        (np.array([getattr(t, name) for t in trials]), ink) for name, ink in (("bic", "predicted"), ("aic", "residual"))
    ]
    above = [(np.log10(1 + c - c.min()), ink) for c, ink in curves]
    chart = Chart(
        344, 200, padded(n, share=0.05), padded(*(c for c, _ in above), share=0.1), "", "order", "log₁₀(1 + above best)"
    )
    return chart.render(across(chart, found.order, "chosen-line"), *[chart.line(n, c, ink) for c, ink in above])


def delay_chart(found: Modes) -> Markup:
    """Return BIC above the best over the delay; nothing where no delay was scanned."""
    if len(found.delay_choice.scan) < 2:
        return Markup("")
    d, _, gap = (np.array(c, float) for c in zip(*found.delay_choice.scan, strict=True))
    height = np.log10(1 + gap)
    chart = Chart(
        344, 200, padded(d, share=0.05), padded(height, share=0.1), "", "delay [samples]", "log₁₀(1 + BIC above best)"
    )
    return chart.render(
        across(chart, found.delay, "chosen-line"), chart.line(d, height, "predicted"), chart.dots(d, height, "mean")
    )


def pole_chart(found: Modes) -> Markup:
    """Return poles and zeros in the s plane, each pole with its 95 % ellipse."""
    known = [q for q in found.poles if q.oscillates]
    if not known:
        return Markup("")
    re, im = np.array([q.s.real for q in known]), np.array([q.s.imag for q in known]) / (2 * np.pi)
    reach = [3.2 * np.sqrt(np.diag(q.covariance)) if q.covariance is not None else np.zeros(2) for q in known]
    some = np.array(reach)
    xlim = padded(np.concatenate([re - some[:, 0], re + some[:, 0], [0.0]]), share=0.08)
    xlim = (max(xlim[0], 3 * float(re.min())), xlim[1])
    ylim = padded(np.concatenate([im, [0.0]]), share=0.08)
    chart = Chart(WIDE, 420, xlim, (min(0.0, ylim[0]), ylim[1]), "", "decay, Re s [1/s]", "Im s / 2π [Hz]")
    turn = np.diag([1.0, 1 / (2 * np.pi)])
    drawn = [across(chart, 0.0, "zero")]
    for pole, x, y in zip(known, re, im, strict=True):
        if pole.covariance is not None and x >= xlim[0]:
            drawn.append(ellipse(chart, (float(x), float(y)), turn @ pole.covariance @ turn, "sure ring"))
    inside = re >= xlim[0]
    zeros = found.zeros[(found.zeros.real >= xlim[0]) & (found.zeros.real <= xlim[1])]
    zeros = zeros[zeros.imag / (2 * np.pi) <= chart.ylim[1]]
    drawn.append(marks(chart, zeros.real, zeros.imag / (2 * np.pi), "ring", "pole-frequency", 4.0))
    drawn.append(marks(chart, re[inside], im[inside], "cross", "pole-cross", 4.5))
    for x, y in zip(re[inside], im[inside], strict=True):
        natural = float(np.hypot(x / (2 * np.pi), y))
        drawn.append(
            chart.text(float(x), float(y) + 0.02 * (chart.ylim[1] - chart.ylim[0]), f"  {natural:.4g} Hz", "pole-name")
        )
    return chart.render(*drawn)


def test_chart(found: Modes, test: CorrelationTest) -> Markup:
    """Return a correlation curve with its 99 % band."""
    size = max(1.5 * test.band, float(np.abs(test.values[test.lags != 0]).max(initial=0.0)) * 1.15)
    name = f"{test.input} → {test.output}" if test.input else test.output
    xlim = (float(test.lags[0]) - 0.8, float(test.lags[-1]) + 0.8)
    chart = Chart(*_size(found, 150), xlim, (-size, size), name, "lag [samples]", "correlation")
    drawn = test.lags != 0 if not test.input else np.ones(len(test.lags), bool)  # with itself it is 1 at lag 0
    lags, value = test.lags[drawn], np.clip(test.values[drawn], -size, size)
    bound = np.full(2, test.band)
    ends = np.array(xlim)
    return chart.render(
        between(chart, ends, -bound, bound, "sure"),
        chart.verticals(lags, np.zeros_like(value), value, "stem"),
        chart.dots(lags, value, "steps" if not test.passed else "mean-small"),
    )


def impulse_chart(found: Modes, i: int, j: int) -> Markup:
    """Return the response to a unit pulse, measured and of the model."""
    r = found.impulse
    if r is None:
        return Markup("")
    t, seen, model = r.t, r.measured[:, i, j], r.model[:, i, j]
    step = max(1, len(t) // 900)
    chart = Chart(
        *_size(found, 190),
        (0.0, float(t[-1])),
        padded(seen, model),
        f"{found.inputs[j]} → {found.outputs[i]}",
        "time [s]",
        "response",
    )
    return chart.render(
        chart.line(t[::step], seen[::step], "measured"), chart.line(t[::step], model[::step], "predicted")
    )


def _shown(found: Modes) -> np.ndarray:
    return found.empirical.excited & np.isfinite(found.empirical.response).all(axis=(1, 2))


def _limits(f: np.ndarray) -> tuple[float, float]:
    return float(f[0]), float(f[-1])


def _inside(chart: Chart, f: float) -> bool:
    return chart.xlim[0] <= f <= chart.xlim[1]


def _decibels(x: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return 20 * np.log10(x)


def _within(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return values with those outside missing, so that a line leaves the chart instead of running along its edge."""
    return np.where((x >= low) & (x <= high), x, np.nan)


def _decibel_limits(model: np.ndarray, dots: np.ndarray) -> tuple[float, float]:
    both = _decibels(np.concatenate([model, dots[np.isfinite(dots)]]))
    both = both[np.isfinite(both)]
    top = float(_decibels(model).max())
    top = max(top, float(np.quantile(both, 0.995)))
    low = max(float(np.quantile(both, 0.005)) - 3, top - FLOOR_DB)
    return low, top + 6


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most so many dots, even on a logarithmic axis."""
    if len(x) <= DOTS:
        return x, y
    grid = np.geomspace(x[0], x[-1], DOTS)
    keep = np.unique(np.clip(np.searchsorted(x, grid), 0, len(x) - 1))
    return x[keep], y[keep]


def charts_of(items: Sequence[Markup]) -> list[Markup]:
    """Return the charts that hold anything."""
    return [c for c in items if c]
