"""Figures of resonances: frequency responses, choice of the model, poles, residuals.

All values come from the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn import results as r
from tau_dyn.modes import CorrelationTest, Mode, Modes, OperationalModes, StabilityPoint

DOTS = 700  # frequencies drawn at most
WIDTHS = {1: r.WHOLE, 2: r.HALF}
MAX_PAIRS = 9  # of output and input that are drawn
FLOOR_DB = 70.0
"""Decibels below the highest peak at which a response is cut off."""
CHI2_95 = 5.991
"""Quantile of chi-squared with two degrees of freedom: an ellipse of 95 %."""
MAX_RELATIVE_FREQUENCY_STDERR = 0.05
"""Relative standard error of a frequency above which a mode is not reported as a resonance."""
MAX_DAMPING_RATIO = 0.3
"""Damping ratio above which a mode is not reported as a resonance."""


def select_known_resonances(found: Modes | OperationalModes) -> list[Mode]:
    """Return the lightly damped modes with known frequency."""
    return [m for m in found.modes if is_resonance(m)]


def is_resonance(mode: Mode) -> bool:
    """Return whether a mode is lightly damped and its frequency known to a few percent."""
    return (
        mode.damping_ratio < MAX_DAMPING_RATIO
        and not mode.frequency_stderr > MAX_RELATIVE_FREQUENCY_STDERR * mode.frequency_hz
    )


def list_pairs(found: Modes) -> list[tuple[int, int]]:
    """Return output and input of the drawn responses, by output; the strongest if there are too many."""
    p, m = len(found.outputs), len(found.inputs)
    every = [(i, j) for i in range(p) for j in range(m)]
    if len(every) <= MAX_PAIRS:
        return every
    size = np.abs(found.response.value).max(axis=0)
    size = size / size.max(axis=1, keepdims=True)  # outputs may have different units
    return sorted(sorted(every, key=lambda pair: -size[pair])[:MAX_PAIRS])


def count_chart_columns(found: Modes) -> int:
    """Return the number of charts of pairs in a row."""
    return min(len(found.inputs), 3) if len(list_pairs(found)) == len(found.inputs) * len(found.outputs) else 3


def _size(found: Modes, height: int) -> tuple[int, int]:
    width = WIDTHS.get(count_chart_columns(found), r.THIRD)
    return width, height + (60 if width > r.THIRD else 0)


def _frequencies(limits: tuple[float, float]) -> r.Axis:
    return r.Axis("frequency [Hz]", limits, log=True)


def build_bode_figure(found: Modes, i: int, j: int) -> r.Figure:
    """Return magnitude over frequency: the response of the data as dots, that of the model as a line with its 95 % band."""
    f, g, sigma = found.response.frequency, np.abs(found.response.value[:, i, j]), found.response.deviation[:, i, j]
    seen = _select_excited(found)
    dots, at = np.abs(found.empirical.response[seen, i, j]), found.empirical.frequency[seen]
    (low, high), ends = _choose_decibels(g, dots), _get_ends(f)
    spread = r.Z95 * sigma / np.sqrt(2)  # along the vector: half of the squared radius
    db = _to_decibels(dots)
    keep = np.isfinite(_within(db, low, high)) & (at >= ends[0]) & (at <= ends[1])
    marks = (
        *_build_mode_lines(found, ends),
        r.Dots(*_thin(at[keep], db[keep]), "data"),
        r.Ribbon(f, _to_decibels(np.maximum(g - spread, 1e-300)), _to_decibels(g + spread)),
        r.Line(f, _within(_to_decibels(g), low, high)),
    )
    title = f"{found.inputs[j]} → {found.outputs[i]}"
    return r.Figure(_frequencies(ends), r.Axis("[dB]", (low, high)), marks, title, _size(found, 210))


def build_phase_figure(found: Modes, i: int, j: int) -> r.Figure:
    """Return phase over frequency, data and model."""
    f, seen = found.response.frequency, _select_excited(found)
    ends = _get_ends(f)
    phase = np.degrees(np.angle(found.response.value[:, i, j]))
    phase[1:][np.abs(np.diff(phase)) > 180] = np.nan  # no line across a wrap
    at, dots = found.empirical.frequency[seen], np.degrees(np.angle(found.empirical.response[seen, i, j]))
    keep = np.isfinite(dots) & (at >= ends[0]) & (at <= ends[1])
    marks = r.Dots(*_thin(at[keep], dots[keep]), "data"), r.Line(f, phase)
    return r.Figure(_frequencies(ends), r.Axis("phase [°]", (-190.0, 190.0)), marks, "", _size(found, 130))


def build_coherence_figure(found: Modes, i: int) -> r.Figure:
    """Return the share of an output's power that the inputs explain, over frequency."""
    at, value, ends = found.empirical.frequency, found.empirical.coherence[:, i], _get_ends(found.response.frequency)
    keep = (at >= ends[0]) & (at <= ends[1])
    marks = *_build_mode_lines(found, ends), r.Line(at[keep], value[keep], "mean-line")
    return r.Figure(_frequencies(ends), r.Axis("coherence", (0.0, 1.05)), marks, found.outputs[i], _size(found, 130))


def build_test_figure(found: Modes, test: CorrelationTest) -> r.Figure:
    """Return a correlation curve with its 99 % band."""
    size = max(1.5 * test.band, float(np.abs(test.values[test.lags != 0]).max(initial=0.0)) * 1.15)
    name = f"{test.input} → {test.output}" if test.input else test.output
    limits = (float(test.lags[0]) - 0.8, float(test.lags[-1]) + 0.8)
    drawn = test.lags != 0 if not test.input else np.ones(len(test.lags), bool)  # an autocorrelation is 1 at lag 0
    lags, value, bound = test.lags[drawn], np.clip(test.values[drawn], -size, size), np.full(2, test.band)
    marks = (
        r.Ribbon(np.array(limits), -bound, bound),
        r.Strokes(lags, np.zeros_like(value), lags, value, "stem"),
        r.Dots(lags, value, "steps" if not test.passed else "mean-small"),
    )
    return r.Figure(
        r.Axis("lag [samples]", limits), r.Axis("correlation", (-size, size)), marks, name, _size(found, 150)
    )


def build_impulse_figure(found: Modes, i: int, j: int) -> r.Figure | None:
    """Return the measured and the modelled response to a unit pulse, or `None` without impulse responses."""
    row = found.impulse
    if row is None:
        return None
    t, seen, model = row.t, row.measured[:, i, j], row.model[:, i, j]
    step = max(1, len(t) // 900)
    marks = r.Line(t[::step], seen[::step], "measured"), r.Line(t[::step], model[::step])
    title = f"{found.inputs[j]} → {found.outputs[i]}"
    y = r.Axis("response", r.pad_limits(seen, model))
    return r.Figure(r.Axis("time [s]", (0.0, float(t[-1]))), y, marks, title, _size(found, 190))


def build_stabilisation_figure(found: Modes | OperationalModes) -> r.Figure:
    """Return modes of all orders: filled if stable, rings if only the frequency agrees, small if new; with 95 % bars."""
    if isinstance(found, OperationalModes):
        f = [q.frequency_hz for q in found.stabilisation]
        ends, top = (0.8 * min(f), min(1.25 * max(f), 0.5 / found.dt)), found.order + 1.5
        lines: list[r.Mark] = [r.Rule("mode-line", x=m.frequency_hz) for m in found.modes]
        chosen: list[r.Mark] = []
    else:
        orders = [t.order for t in found.order_choice.trials] or [found.order]
        ends, top = _get_ends(found.response.frequency), max(orders) + 1.5
        lines = [
            *_build_mode_lines(found, ends),
            *_build_skyline(found, ends, top),
            r.Rule("chosen-line", y=found.order),
        ]
        chosen = [r.Label(ends[1], found.order + 0.25, "chosen", "chosen-name", "end")]
    marks = (*lines, *_build_stability_marks(found.stabilisation, ends), *chosen)
    return r.Figure(_frequencies(ends), r.Axis("order of the model", (0.0, top)), marks, "", (r.WHOLE, 470))


def _build_stability_marks(points: Sequence[StabilityPoint], ends: tuple[float, float]) -> list[r.Mark]:
    """Return the marks of modes by kind, with their 95 % bars."""
    marks: list[r.Mark] = []
    inside = [q for q in points if ends[0] <= q.frequency_hz <= ends[1]]
    for kind in ("new", "frequency", "stable"):
        some = [q for q in inside if q.kind == kind]
        if not some:
            continue
        f, n = np.array([q.frequency_hz for q in some]), np.array([float(q.order) for q in some])
        half = r.Z95 * np.nan_to_num([q.frequency_stderr for q in some])
        if kind != "new":
            marks.append(r.Strokes(np.clip(f - half, *ends), n, np.clip(f + half, *ends), n, f"bar-{kind}"))
        marks.append(r.Dots(f, n, f"pole-{kind}", "ring" if kind == "frequency" else "dot", 3.5))
    return marks


def _build_skyline(found: Modes, ends: tuple[float, float], top: float) -> list[r.Mark]:
    """Return the response of the data over all pairs as a pale curve in the background of the diagram."""
    seen = _select_excited(found)
    at, response = found.empirical.frequency[seen], found.empirical.response[seen]
    size = np.sqrt(np.mean(np.abs(response) ** 2, axis=2))
    size = np.sqrt(np.mean((size / np.nanmax(size, axis=0)) ** 2, axis=1))
    db = _to_decibels(size)
    keep = np.isfinite(db) & (at >= ends[0]) & (at <= ends[1])
    if keep.sum() < 3:
        return []
    low, high = float(np.quantile(db[keep], 0.02)), float(db[keep].max())
    height = 0.96 * top * np.clip((db[keep] - low) / max(high - low, 1e-9), 0, 1)
    return [r.Ribbon(at[keep], np.zeros(keep.sum()), height, "skyline")]


def build_choice_figures(found: Modes) -> list[r.Figure]:
    """Return the figures about the choice of order and delay: fit on held-out data, criteria, scan of delays."""
    trials, figures = found.order_choice.trials, []
    if len(trials) > 1:
        n, fit = np.array([float(t.order) for t in trials]), np.array([t.fit_percent for t in trials])
        limits = r.pad_limits(np.array([max(float(fit.min()), float(fit.max()) - 40.0), float(fit.max())]), share=0.12)
        fit, orders, chosen = (
            np.clip(fit, limits[0], None),
            r.Axis("order", r.pad_limits(n, share=0.05)),
            r.Rule("chosen-line", x=found.order),
        )
        figures.append(
            r.Figure(orders, r.Axis("fit [%]", limits), (chosen, r.Line(n, fit), r.Dots(n, fit)), "", (r.THIRD, 200))
        )
        bic, aic = (np.array([getattr(t, name) for t in trials]) for name in ("bic", "aic"))
        above = [np.log10(1 + c - c.min()) for c in (bic, aic)]
        y = r.Axis("log₁₀(1 + above best)", r.pad_limits(*above, share=0.1))
        figures.append(
            r.Figure(orders, y, (chosen, r.Line(n, above[0]), r.Line(n, above[1], "residual")), "", (r.THIRD, 200))
        )
    if len(found.delay_choice.scan) > 1:
        d, _, gap = (np.array(c, float) for c in zip(*found.delay_choice.scan, strict=True))
        height = np.log10(1 + gap)
        y = r.Axis("log₁₀(1 + BIC above best)", r.pad_limits(height, share=0.1))
        marks = r.Rule("chosen-line", x=found.delay), r.Line(d, height), r.Dots(d, height)
        figures.append(r.Figure(r.Axis("delay [samples]", r.pad_limits(d, share=0.05)), y, marks, "", (r.THIRD, 200)))
    return figures


def build_pole_figure(found: Modes) -> r.Figure | None:
    """Return poles and zeros in the s plane, each pole with its 95 % ellipse; None without oscillating poles."""
    known = [q for q in found.poles if q.oscillates]
    if not known:
        return None
    re, im = np.array([q.s.real for q in known]), np.array([q.s.imag for q in known]) / (2 * np.pi)
    reach = [3.2 * np.sqrt(q.covariance[0, 0]) if q.covariance is not None else 0.0 for q in known]
    xlim = r.pad_limits(np.concatenate([re - reach, re + reach, [0.0]]), share=0.08)
    xlim = (max(xlim[0], 3 * float(re.min())), xlim[1])
    ylim = r.pad_limits(np.concatenate([im, [0.0]]), share=0.08)
    ylim = (min(0.0, ylim[0]), ylim[1])
    turn = np.diag([1.0, 1 / (2 * np.pi)])
    marks: list[r.Mark] = [r.Rule("zero", x=0.0)]
    for pole, x, y in zip(known, re, im, strict=True):
        if pole.covariance is not None and x >= xlim[0]:
            marks.append(r.Ring(_trace_ellipse((float(x), float(y)), turn @ pole.covariance @ turn), "sure ring"))
    zeros = found.zeros[(found.zeros.real >= xlim[0]) & (found.zeros.real <= xlim[1])]
    zeros = zeros[zeros.imag / (2 * np.pi) <= ylim[1]]
    marks.append(r.Dots(zeros.real, zeros.imag / (2 * np.pi), "pole-frequency", "ring"))
    inside = re >= xlim[0]
    marks.append(r.Dots(re[inside], im[inside], "pole-cross", "cross", 4.5))
    for x, y in zip(re[inside], im[inside], strict=True):
        natural = float(np.hypot(x / (2 * np.pi), y))
        marks.append(r.Label(float(x), float(y) + 0.02 * (ylim[1] - ylim[0]), f"  {natural:.4g} Hz", "pole-name"))
    return r.Figure(r.Axis("decay, Re s [1/s]", xlim), r.Axis("Im s / 2π [Hz]", ylim), marks, "", (r.WHOLE, 420))


def _trace_ellipse(centre: tuple[float, float], covariance: np.ndarray) -> np.ndarray:
    """Return the 95 % ellipse (n, 2) of a point with a covariance (2, 2), both in data units."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.sqrt(CHI2_95 * np.maximum(values, 0))[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return np.array(centre) + (vectors @ ring).T


def _build_mode_lines(found: Modes, ends: tuple[float, float]) -> list[r.Mark]:
    known = [m.frequency_hz for m in select_known_resonances(found)]
    return [r.Rule("mode-line", x=f) for f in known if ends[0] <= f <= ends[1]]


def _select_excited(found: Modes) -> np.ndarray:
    """Return the mask of drawn frequencies of the data's response: those that were excited."""
    return found.empirical.excited & np.isfinite(found.empirical.response).all(axis=(1, 2))


def _get_ends(f: np.ndarray) -> tuple[float, float]:
    return float(f[0]), float(f[-1])


def _to_decibels(x: np.ndarray) -> np.ndarray:
    """Return magnitudes in decibels, minus infinity for zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return 20 * np.log10(x)


def _within(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return values with nan outside the limits, so that a line leaves the chart instead of following its edge."""
    return np.where((x >= low) & (x <= high), x, np.nan)


def _choose_decibels(model: np.ndarray, dots: np.ndarray) -> tuple[float, float]:
    both = _to_decibels(np.concatenate([model, dots[np.isfinite(dots)]]))
    both = both[np.isfinite(both)]
    top = float(_to_decibels(model).max())
    top = max(top, float(np.quantile(both, 0.995)))
    low = max(float(np.quantile(both, 0.005)) - 3, top - FLOOR_DB)
    return low, top + 6


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `DOTS` points, spread evenly on a logarithmic axis."""
    if len(x) <= DOTS:
        return x, y
    grid = np.geomspace(x[0], x[-1], DOTS)
    keep = np.unique(np.clip(np.searchsorted(x, grid), 0, len(x) - 1))
    return x[keep], y[keep]
