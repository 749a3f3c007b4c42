"""The charts of what a structure answers: response, coherence, pulses, and tests of what the model leaves.

Nothing is computed here that the result does not hold.
"""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from tau_dyn.modes import CorrelationTest, Modes
from tau_dyn.report.formatting import Z95
from tau_dyn.report.log_chart import LogChart
from tau_dyn.report.modes_svg import draw_across, draw_between
from tau_dyn.report.modes_text import select_known_resonances
from tau_dyn.report.svg import HALF, THIRD, WHOLE, Chart, pad_limits

DOTS = 700  # frequencies drawn at most
WIDTHS = {1: WHOLE, 2: HALF}
MAX_PAIRS = 9  # of output and input that are drawn
FLOOR_DB = 70.0
"""Decibels below the highest peak at which a response is cut off."""


def list_pairs(found: Modes) -> list[tuple[int, int]]:
    """Return output and input of the responses that are drawn, by output; the strongest where there are too many."""
    p, m = len(found.outputs), len(found.inputs)
    every = [(i, j) for i in range(p) for j in range(m)]
    if len(every) <= MAX_PAIRS:
        return every
    size = np.abs(found.response.value).max(axis=0)
    size = size / size.max(axis=1, keepdims=True)  # outputs may have unlike units
    return sorted(sorted(every, key=lambda pair: -size[pair])[:MAX_PAIRS])


def count_chart_columns(found: Modes) -> int:
    """Return how many charts of pairs stand side by side."""
    return min(len(found.inputs), 3) if len(list_pairs(found)) == len(found.inputs) * len(found.outputs) else 3


def _size(found: Modes, height: int) -> tuple[int, int]:
    width = WIDTHS.get(count_chart_columns(found), THIRD)
    return width, height + (60 if width > THIRD else 0)


def draw_bode_chart(found: Modes, i: int, j: int) -> Markup:
    """Return magnitude over frequency: the data's own response as dots, the model's with its 95 % band over it."""
    f, g, sigma = found.response.frequency, np.abs(found.response.value[:, i, j]), found.response.deviation[:, i, j]
    seen = select_excited(found)
    dots = np.abs(found.empirical.response[seen, i, j])
    low, high = _decibel_limits(g, dots)
    chart = LogChart(
        *_size(found, 210),
        select_ends(f),
        (low, high),
        f"{found.inputs[j]} → {found.outputs[i]}",
        "frequency [Hz]",
        "[dB]",
    )
    spread = Z95 * sigma / np.sqrt(2)  # along the vector: half of the squared radius
    at = found.empirical.frequency[seen]
    db = convert_to_decibels(dots)
    keep = np.isfinite(_within(db, low, high)) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(
        *draw_mode_lines(found, chart),
        chart.dots(*_thin(at[keep], db[keep]), "data"),
        draw_between(
            chart, f, convert_to_decibels(np.maximum(g - spread, 1e-300)), convert_to_decibels(g + spread), "sure"
        ),
        chart.line(f, _within(convert_to_decibels(g), low, high), "predicted"),
    )


def draw_phase_chart(found: Modes, i: int, j: int) -> Markup:
    """Return phase over frequency, data and model."""
    f, seen = found.response.frequency, select_excited(found)
    chart = LogChart(*_size(found, 130), select_ends(f), (-190.0, 190.0), "", "frequency [Hz]", "phase [°]")
    phase = np.degrees(np.angle(found.response.value[:, i, j]))
    phase[1:][np.abs(np.diff(phase)) > 180] = np.nan  # a wrap is no line
    at = found.empirical.frequency[seen]
    dots = np.degrees(np.angle(found.empirical.response[seen, i, j]))
    keep = np.isfinite(dots) & (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(chart.dots(*_thin(at[keep], dots[keep]), "data"), chart.line(f, phase, "predicted"))


def draw_coherence_chart(found: Modes, i: int) -> Markup:
    """Return the share of an output's power that the inputs explain, over frequency."""
    chart = LogChart(
        *_size(found, 130),
        select_ends(found.response.frequency),
        (0.0, 1.05),
        found.outputs[i],
        "frequency [Hz]",
        "coherence",
    )
    at, value = found.empirical.frequency, found.empirical.coherence[:, i]
    keep = (at >= chart.xlim[0]) & (at <= chart.xlim[1])
    return chart.render(
        *draw_mode_lines(found, chart),
        chart.line(at[keep], value[keep], "mean-line"),
    )


def draw_test_chart(found: Modes, test: CorrelationTest) -> Markup:
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
        draw_between(chart, ends, -bound, bound, "sure"),
        chart.verticals(lags, np.zeros_like(value), value, "stem"),
        chart.dots(lags, value, "steps" if not test.passed else "mean-small"),
    )


def draw_impulse_chart(found: Modes, i: int, j: int) -> Markup:
    """Return the response to a unit pulse, measured and of the model."""
    r = found.impulse
    if r is None:
        return Markup("")
    t, seen, model = r.t, r.measured[:, i, j], r.model[:, i, j]
    step = max(1, len(t) // 900)
    chart = Chart(
        *_size(found, 190),
        (0.0, float(t[-1])),
        pad_limits(seen, model),
        f"{found.inputs[j]} → {found.outputs[i]}",
        "time [s]",
        "response",
    )
    return chart.render(
        chart.line(t[::step], seen[::step], "measured"), chart.line(t[::step], model[::step], "predicted")
    )


def select_excited(found: Modes) -> np.ndarray:
    """Return which frequencies of the data's own response are drawn: those that were excited."""
    return found.empirical.excited & np.isfinite(found.empirical.response).all(axis=(1, 2))


def select_ends(f: np.ndarray) -> tuple[float, float]:
    """Return the first and last of frequencies in order."""
    return float(f[0]), float(f[-1])


def draw_mode_lines(found: Modes, chart: Chart) -> list[Markup]:
    """Return a line across a chart over frequency at each resonance within it."""
    within = [
        m.frequency_hz for m in select_known_resonances(found) if chart.xlim[0] <= m.frequency_hz <= chart.xlim[1]
    ]
    return [draw_across(chart, f, "mode-line") for f in within]


def convert_to_decibels(x: np.ndarray) -> np.ndarray:
    """Return sizes in decibels, minus infinity for zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return 20 * np.log10(x)


def _within(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return values with those outside missing, so that a line leaves the chart instead of running along its edge."""
    return np.where((x >= low) & (x <= high), x, np.nan)


def _decibel_limits(model: np.ndarray, dots: np.ndarray) -> tuple[float, float]:
    both = convert_to_decibels(np.concatenate([model, dots[np.isfinite(dots)]]))
    both = both[np.isfinite(both)]
    top = float(convert_to_decibels(model).max())
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
