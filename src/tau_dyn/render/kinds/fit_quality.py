"""Quality of a fit: forces over time, data used and left out, conditioning, friction curves, and residuals.

The residual of a complete model looks like noise through the fit's own filter: measured forces and columns have the same
low-pass, so even white noise is correlated over a few samples. `compute_noise_correlation` is the autocorrelation of noise in
forces and of noise in positions, differentiated once and twice. A deviation from it is a model error, or noise of another colour.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.stats import binom, norm

from tau_dyn import results as r
from tau_dyn.effects import JointwiseEffect, Motion, TorqueOffset
from tau_dyn.estimate import Regression
from tau_dyn.identify import Identification
from tau_dyn.render.kinds.parameter_rows import ParameterRow
from tau_dyn.render.presentation import pad_used

WELL, FAIR = 30.0, 200.0
_BIASED_LEVEL = 0.01  # p-value below which too few estimates are within 2 standard errors for an unbiased fit
MIN_REPORTED_CORRELATION = 0.9  # between two parameters; smaller correlations are harmless
LAGS = 20.0
"""Longest lag times the low-pass' cutoff; the shown range is limited to 0.3 s to 2 s."""
MAX_EXCESS_CORRELATION = 0.2
"""Deviation from the autocorrelation of noise above which a residual counts as systematic."""
CHANCE = 0.01
"""Probability that the noise of a joint exceeds its bound at any lag."""
FILTER_ORDER = 4
"""Order of the fit's Butterworth low-pass, in each direction."""
DOTS = 1200  # samples of a friction curve drawn at most


@dataclass(frozen=True)
class ResidualSummary:
    """One joint's residual over the samples that the fit uses.

    Attributes:
        joint: The joint.
        unit: Unit of the force.
        values: Measured minus predicted (n,).
        lags: Time lags (m,) [s].
        correlation: Autocorrelation at the lags (m,).
        expected: Autocorrelation of noise through the same low-pass (m,).
        bound: Bound on the autocorrelation of noise at all lags, valid in 99 of 100 logs.
        lasts_s: Lag after which the autocorrelation is within 0.2 (or the bound, if larger) of that of noise [s].
    """

    joint: str
    unit: str
    values: np.ndarray
    lags: np.ndarray
    correlation: np.ndarray
    expected: np.ndarray
    bound: float
    lasts_s: float

    @property
    def white(self) -> bool:
        """Whether the residual has no systematic part beyond the correlation of the filter."""
        return self.lasts_s <= 0.0


def compute_residuals(found: Identification) -> list[ResidualSummary]:
    """Return each joint's residual on the training logs; joints without a usable sample are left out."""
    regression = found.estimate.regression
    errors = found.estimate.residuals()
    cutoff = regression.preparation.force_cutoff_hz
    used = [any(run.usable[:, k].any() for run in regression.runs) for k in range(len(regression.outputs))]
    return [_residual(regression, errors, k, cutoff) for k in range(len(regression.outputs)) if used[k]]


def _residual(regression: Regression, errors: list[np.ndarray], k: int, cutoff_hz: float) -> ResidualSummary:
    values = np.concatenate([e[run.usable[:, k], k] for run, e in zip(regression.runs, errors, strict=True)])
    step = max(float(np.median(np.diff(run.t))) for run in regression.runs)
    longest = max(len(run.t) for run in regression.runs)
    n_lags = int(np.clip(np.clip(LAGS / cutoff_hz, 0.3, 2.0) / step, 8, min(400, longest // 2)))
    pairs, products = np.zeros(n_lags), np.zeros(n_lags)
    for run, error in zip(regression.runs, errors, strict=True):
        mask = run.usable[:, k].astype(float)
        pairs += _lagged_sum(mask, n_lags)
        products += _lagged_sum(np.where(run.usable[:, k], error[:, k], 0.0), n_lags)
    covariance = products / np.maximum(pairs, 1)
    correlation = covariance / covariance[0] if covariance[0] > 0 else np.zeros(n_lags)
    lags = np.arange(n_lags) * step
    expected = compute_noise_correlation(correlation, lags, cutoff_hz)
    z = float(norm.isf(CHANCE / (2 * n_lags)))
    bound = z * float(np.sqrt(np.sum(expected**2) * 2 / max(1, len(values))))
    beyond = np.flatnonzero(np.abs(correlation - expected) > max(MAX_EXCESS_CORRELATION, bound))
    lasts = float(lags[beyond[-1]]) if beyond.size else 0.0
    return ResidualSummary(
        regression.outputs[k], regression.units[k], values, lags, correlation, expected, bound, lasts
    )


def compute_noise_correlation(correlation: np.ndarray, lags: np.ndarray, cutoff_hz: float) -> np.ndarray:
    """Return the autocorrelation (m,) of noise after the fit's zero-phase low-pass that is closest to a given one (m,).

    The noise is the sum of white noise of a force and of a position differentiated once and twice: powers 0, 2, 4 of frequency.
    """
    f = np.linspace(0.0, 4 * cutoff_hz, 4001)
    passed = (1 / (1 + (f / cutoff_hz) ** (2 * FILTER_ORDER))) ** 2
    waves = np.cos(2 * np.pi * np.outer(lags, f))
    shapes = np.stack([waves @ power / power.sum() for power in (passed * f**p for p in (0, 2, 4))], axis=1)
    weights, _ = nnls(shapes, correlation)
    return shapes @ weights / weights.sum() if weights.any() else shapes[:, 0]


def _lagged_sum(x: np.ndarray, n_lags: int) -> np.ndarray:
    size = 1 << int(np.ceil(np.log2(len(x) + n_lags)))
    return np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[:n_lags]


@dataclass(frozen=True)
class Friction:
    """One joint's friction: measured force minus all other identified forces.

    The fit's low-pass smooths the law's step at zero speed in data and columns. Therefore a sample is shown at the value of the
    law plus its residual, which is the same difference without smoothing.

    Attributes:
        joint: The joint.
        unit: Unit of the force.
        speed_unit: Unit of the speed.
        v: Speeds of the used samples (n,).
        force: Law plus residual of these samples (n,).
        grid: Speeds at which the law is drawn (m,), with a step at zero.
        law: The identified law at these speeds (m,).
        offset: Constant force that was subtracted; 0 if the model has no offset.
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
    """Return the friction of every joint that moved and has a law of its own speed."""
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
    v = np.concatenate([row.signals["v"][m, k] for row, m in zip(regression.runs, masks, strict=True)])
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


def build_friction_figure(curve: Friction) -> r.Figure:
    """Return a friction curve: the cloud of samples, their mean in bins of speed, and the identified law."""
    at, mean, deviation = r.average_in_bins(curve.v, curve.force)
    ylim = r.pad_limits(np.quantile(curve.force, [0.003, 0.997]), curve.law, mean)
    step = max(1, len(curve.v) // DOTS)
    low, high = (np.clip(mean + side * deviation, *ylim) for side in (-1, 1))
    marks = (
        r.Spans([(-curve.threshold, curve.threshold)], "masked"),
        r.Dots(curve.v[::step], np.clip(curve.force[::step], *ylim), "cloud"),
        r.Strokes(at, low, at, high, "whisker"),
        r.Line(curve.grid, curve.law),
        r.Dots(at, mean),
    )
    x = r.Axis(f"speed [{curve.speed_unit}]", r.pad_limits(curve.grid, share=0.03))
    return r.Figure(x, r.Axis(f"friction [{curve.unit}]", ylim), marks, curve.joint)


def describe_offset(curve: Friction) -> str:
    """Return a sentence about the constant force subtracted from a friction curve; empty without an offset."""
    return (
        f"{curve.joint}: offset {r.format_number(curve.offset, 3)} {r.format_unit(curve.unit)}" if curve.offset else ""
    )


def build_residual_histogram(residual: ResidualSummary) -> r.Figure:
    """Return the histogram of the residual, with the normal distribution of the same standard deviation."""
    sigma = float(np.std(residual.values)) or 1.0
    edges = np.linspace(-4, 4, 41) * sigma
    counts, _ = np.histogram(np.clip(residual.values, edges[0], edges[-1]), edges)
    density = counts / max(1, len(residual.values)) / (edges[1] - edges[0]) * sigma
    grid = np.linspace(-4, 4, 161)
    normal = r.Line(grid * sigma, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), "expected")
    x = r.Axis(f"residual [{r.format_unit(residual.unit)}]", (float(edges[0]), float(edges[-1])))
    y = r.Axis("share [per σ]", (0, 1.15 * max(float(density.max()), 0.4)))
    return r.Figure(x, y, (r.build_histogram(edges, density), normal), residual.joint)


def build_correlation_figure(residual: ResidualSummary) -> r.Figure:
    """Return the residual's autocorrelation with that of noise."""
    ends = np.array([0, residual.lags[-1]])
    bounds = [r.Line(ends, np.full(2, side * residual.bound), "bound") for side in (1, -1)]
    curves = (
        r.Line(residual.lags, residual.expected, "expected"),
        r.Line(residual.lags, residual.correlation, "residual"),
    )
    y = r.Axis("autocorrelation", (min(-0.3, float(residual.correlation.min()) - 0.05), 1.05))
    return r.Figure(r.Axis("time lag [s]", (0, float(residual.lags[-1]))), y, (*bounds, *curves), residual.joint)


def describe_preparation(found: Identification) -> list[str]:
    """Return the preparation of the regression from the logs, one sentence per step."""
    regression = found.estimate.regression
    p, robot = regression.preparation, found.model.robot
    rate = 1 / float(np.median(np.diff(regression.runs[0].t)))
    slowest = [
        f"{_speed(float(v), unit)} ({joint})"
        for joint, v, unit in zip(regression.outputs, p.speed_threshold, robot.position_units, strict=True)
    ]
    sentences = [
        f"Positions pass a zero-phase low-pass of {r.format_number(p.position_cutoff_hz, 3)} Hz before they are differentiated; "
        f"forces and every column of the regression pass the same one of {r.format_number(p.force_cutoff_hz, 3)} Hz.",
        f"Both are then decimated to {r.format_number(rate, 3)} Hz.",
        f"Samples within {r.format_number(1000 * p.window_s, 2)} ms of a reversal and of speeds below "
        f"{r.format_list(slowest)} are left out: the sign of friction is uncertain there. The ends of each log and "
        "saturated forces are left out, too.",
    ]
    if p.exclude:
        sentences.append(f"Samples flagged by {r.format_list(p.exclude)} are left out.")
    return sentences


def _speed(v: float, unit: str) -> str:
    return f"{r.format_number(1000 * v, 2)} mm/s" if unit == "m" and v < 0.1 else f"{r.format_number(v, 2)} {unit}/s"


def describe_used_data(found: Identification) -> str:
    """Return a sentence about the share of data that the fit uses, and about the rest."""
    train, n = found.train, found.estimate.regression.n_samples
    text = (
        f"The fit uses {r.format_percent(100 * train.used_share)} of the samples: {r.format_thousands(n)} force values."
    )
    if train.all_samples is not None:
        text += f" Training error: {r.format_percent(train.relative_error_percent)} of the used samples, "
        text += f"{r.format_percent(train.all_samples.relative_error_percent)} of all."
    return text


def describe_conditioning(cond: float) -> str:
    """Return how well a motion separates the parameters, by its condition number."""
    judged = describe_separation(cond)
    return f"Condition number {r.format_number(cond, 3)} (below {WELL:g} is good, above {FAIR:g} is poor): {judged}."


def describe_separation(cond: float) -> str:
    """Return the meaning of a condition number, as a clause."""
    if cond < WELL:
        return "the parameters are well separated"
    if cond < FAIR:
        return "acceptable; a richer motion would lower the standard errors"
    return "ill-conditioned; single estimates are sensitive to noise, their combinations are not"


def list_correlations(found: Identification, most: int = 8) -> list[tuple[str, str, str]]:
    """Return the strongest correlations above 0.9: both parameters, and the number."""
    estimate, matrix = found.estimate, np.triu(found.estimate.correlation, 1)
    pairs = sorted(np.argwhere(np.abs(matrix) > MIN_REPORTED_CORRELATION), key=lambda ij: -abs(matrix[ij[0], ij[1]]))[
        :most
    ]
    return [
        (estimate.expression(int(i)), estimate.expression(int(j)), f"{matrix[i, j]:+.3f}".replace("-", "−"))
        for i, j in pairs
    ]


def list_combinations(found: Identification) -> list[str]:
    """Return the identifiable combinations of parameters, with values; smallest relative error first."""
    together = [row for row in found.base_rows() if row["expression"] != row["name"]]
    if found.determined_combinations is not None:
        together = found.combination_rows()
    together.sort(key=lambda row: row["stderr"] / max(abs(row["value"]), 1e-300))
    return [
        f"{r.format_expression(row['expression'])} = {r.format_with_uncertainty(row['value'], row['stderr'], row['unit'])}"
        for row in together
    ]


def describe_truth_errors(rows: list[ParameterRow]) -> str:
    """Return how the estimates compare with the true values of a simulation, by a binomial test of their coverage."""
    distances = [float(row.distance) for row in rows if row.distance]
    if not distances:
        return ""
    near = sum(d <= 2 for d in distances)
    text = f"{near} of {r.count(len(distances), 'estimate')} lie within 2 standard errors of the true value; "
    text += "95 % are expected."
    if binom.cdf(near, len(distances), 0.95) < _BIASED_LEVEL:
        text += " The model lacks a force that the simulated robot has; the estimates are biased."
    return text


def describe_whiteness(residuals: list[ResidualSummary]) -> str:
    """Return a sentence about the autocorrelation of the residuals."""
    left = [f"{row.joint} ({r.format_number(row.lasts_s, 2)} s)" for row in residuals if not row.white]
    if not left:
        return "The residuals' autocorrelation is that of noise through the low-pass."
    return (
        f"The residual of {r.format_list(left)} is correlated for longer than noise through the low-pass: the model lacks a "
        "force, or the noise is coloured. The standard errors include the coloured noise, but not a bias."
    )


def describe_fixed(found: Identification) -> list[str]:
    """Return the parameters that were fixed at a given value."""
    return [
        f"{p.name} = {r.format_number(p.value)} {r.format_unit(p.unit)} ({p.origin})"
        for p in found.parameters
        if not p.free
    ]


def describe_inputs(found: Identification) -> str:
    """Return a summary of the inputs in a line: logs, seconds, data for evaluation."""
    runs = found.estimate.regression.runs
    logs = list(dict.fromkeys(run.name for run in runs))
    seconds = sum(float(run.t[-1] - run.t[0]) for run in runs)
    named = r.format_list(logs, 3) if len(logs) <= 3 else r.count(len(logs), "log")
    return f"{named}, {r.format_number(seconds, 3)} s; evaluated on {found.holdout_how}"


def list_views(found: Identification) -> Iterator[r.View]:
    """Yield a view of every segment and joint: held-out logs first."""
    own_logs, train = bool(found.model.provenance.get("held_out")), found.estimate.regression
    if own_logs and found.held is not None:
        yield from _list_stretches(found, found.held, True, None)
    yield from _list_stretches(found, train, False, None if own_logs else found.held)


def _list_stretches(
    found: Identification, data: Regression, held_out: bool, part: Regression | None
) -> Iterator[r.View]:
    for i, run in enumerate(data.runs):
        predicted = run.W @ found.estimate.theta
        told = run if held_out else None if part is None else part.runs[i]
        bands = () if told is None else ((float(told.t[0]), float(told.t[-1]), "held"),)
        for k, joint in enumerate(data.outputs):
            used, unit = run.usable[:, k], r.format_unit(data.units[k])
            y, fitted = run.y[:, k], predicted[:, k]
            left = np.abs((y - fitted)[used])
            both = r.Curve("measured", "measured", y), r.Curve("predicted", "predicted", fitted)
            above = r.Strip(f"force [{unit}]", both, pad_used(np.concatenate([y[used], fitted[used]])), 290)
            rest = (r.Curve("residual", "residual", y - fitted),)
            if held_out and found.bands is not None:
                ends = (("90 % band", found.bands.lower), ("90 % band", found.bands.upper))
                rest += tuple(r.Curve(name, "predicted", x[i][:, k]) for name, x in ends)
            below = r.Strip(f"residual [{unit}]", rest, pad_used(np.concatenate([left, -left]), 0.25), 180, masked=True)
            yield r.View(run.name, joint, run.t, (above, below), held_out, bands, used)
