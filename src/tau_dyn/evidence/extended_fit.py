"""The model extended by causes, refitted, and judged on the test data; and the noise floor.

The noise floor is the residual that remains if every output may depend smoothly on all its own variables: an estimate of the
lower bound for any model of these variables. It is corrected for the degrees of freedom of the smooth functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.effects import Effect
from tau_dyn.estimate import (
    Estimate,
    PhysicalConstraints,
    Regression,
    assign_blocks,
    scale_columns,
    solve_least_squares,
)
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.confirmation import Confirmation
from tau_dyn.evidence.measurements import EVERY, TEST, TRAIN, VALIDATION, Measurements
from tau_dyn.evidence.null_model import build_smooth_columns
from tau_dyn.evidence.result import Gain, OutputErrors, WholeErrors
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameters
from tau_dyn.results import Z95

_DRAWS = 1000  # bootstrap draws of an interval; its ends vary by a few per cent of its width
_INTERVAL = (2.5, 97.5)


@dataclass(frozen=True, eq=False)
class EvaluatedFit:
    """A fitted model on the test data.

    Attributes:
        estimate: The fit, on training and confirmation parts; None for values that were not fitted.
        theta: All parameters (p,), the baseline's and then the effects'.
        regression: Baseline and effects on all data.
        residuals: Measured minus predicted (n, m) of each run, all parts.
        errors: Errors on the test data, filtered as for the search.
        other: The same values on the measurements for reported errors, if these differ; see `Channel.report`.
    """

    estimate: Estimate | None
    theta: np.ndarray
    regression: Regression
    residuals: list[np.ndarray]
    errors: OutputErrors
    other: EvaluatedFit | None = None

    @property
    def reported(self) -> EvaluatedFit:
        """The same values on the measurements for reported errors."""
        return self.other or self

    @property
    def parameters(self) -> Parameters:
        """The fitted parameters."""
        assert self.estimate is not None  # only the nominal values lack one
        return self.estimate.parameters


def build_extended_regression(channel: Channel, effects: Sequence[Effect]) -> Regression:
    """Return the baseline's regression with the columns of further effects."""
    made = [channel.columns(effect) for effect in effects]
    whole = [channel.whole_columns(effect) for effect in effects]
    runs = tuple(
        replace(
            run,
            W=np.concatenate([run.W, *(c[r] for c in made)], axis=2),
            W_all=np.concatenate([run.W_all, *(c[r] for c in whole)], axis=2),
        )
        for r, run in enumerate(channel.runs)
    )
    parameters = channel.parameters + Parameters([p for effect in effects for p in effect.parameters])
    return Regression(parameters, channel.outputs, channel.units, runs)


def fit_extended_model(
    channel: Channel, effects: Sequence[Effect], physics: PhysicalConstraints | None, rng: np.random.Generator
) -> EvaluatedFit:
    """Fit baseline and effects on training and confirmation parts, and judge them on the rest."""
    regression = build_extended_regression(channel, effects)
    estimate = solve_with_fallback(restrict_to_parts(regression, channel, TRAIN, VALIDATION), physics)
    return evaluate_fit(channel, regression, estimate.theta, estimate, rng, effects)


def solve_with_fallback(regression: Regression, physics: PhysicalConstraints | None) -> Estimate:
    """Return the fit with physical consistency and bounds, or the plain one if the constrained solver fails."""
    try:
        return solve_least_squares(regression, physics=physics)
    except InputError:
        opened = {p.name: {"lower": -np.inf, "upper": np.inf} for p in regression.parameters}
        return solve_least_squares(regression.with_parameters(regression.parameters.update(opened)))


def evaluate_fit(
    channel: Channel,
    regression: Regression,
    theta: np.ndarray,
    estimate: Estimate | None,
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
) -> EvaluatedFit:
    """Judge parameter values (p,), those of the channel and then those of effects."""
    residuals = regression.residuals(theta)
    errors = compute_errors(channel, residuals, rng, whole=regression.residuals_all(theta))
    shown, other = channel.report(), None
    if shown is not channel:
        rows = build_extended_regression(shown, effects)
        other = evaluate_fit(shown, rows, theta, estimate, rng.spawn(1)[0], effects)
    return EvaluatedFit(estimate, theta, regression, residuals, errors, other)


def restrict_to_parts(regression: Regression, channel: Measurements, *parts: int) -> Regression:
    """Return a regression that may use samples of these parts only."""
    masks = channel.masks(*parts)
    return replace(
        regression, runs=tuple(replace(run, usable=m) for run, m in zip(regression.runs, masks, strict=True))
    )


def compute_errors(
    channel: Measurements,
    residuals: Sequence[np.ndarray],
    rng: np.random.Generator,
    *,
    whole: Sequence[np.ndarray] | None = None,
) -> OutputErrors:
    """Return rms and relative error on the test data, with intervals from blocks.

    Args:
        channel: The data.
        residuals: Measured minus predicted (n, m) of each run, filtered as the masked measurements are.
        rng: Random numbers for drawing blocks.
        whole: The same without masks, if known.
    """
    squares, counts = _sum_blocks(channel, residuals)
    power, _ = _sum_blocks(channel, [run.y for run in channel.runs])
    rms = np.sqrt(squares.sum(axis=0) / np.maximum(counts.sum(axis=0), 1))
    draws = _resample(squares, counts, rng)
    ci95 = np.percentile(draws, _INTERVAL, axis=0).T
    relative = 100 * float(np.sqrt(squares.sum() / max(power.sum(), 1e-300)))
    pick = rng.integers(len(counts), size=(_DRAWS, len(counts)))
    shares = 100 * np.sqrt(
        squares.sum(axis=1)[pick].sum(axis=1) / np.maximum(power.sum(axis=1)[pick].sum(axis=1), 1e-300)
    )
    low, high = np.percentile(shares, _INTERVAL)
    found = OutputErrors(channel.outputs, rms, ci95, relative, (float(low), float(high)))
    return found if whole is None else _add_all_samples(found, channel, whole)


def _add_all_samples(errors: OutputErrors, channel: Measurements, whole: Sequence[np.ndarray]) -> OutputErrors:
    """Return errors together with those over all samples of the test data."""
    inside = [part == TEST for part in channel.parts]
    e = np.concatenate([x[i] for x, i in zip(whole, inside, strict=True)])
    y = np.concatenate([run.y_all[i] for run, i in zip(channel.runs, inside, strict=True)])
    used = np.concatenate([run.usable[i] for run, i in zip(channel.runs, inside, strict=True)])
    relative = 100 * float(np.linalg.norm(e) / max(float(np.linalg.norm(y)), 1e-150))
    every = WholeErrors(np.sqrt(np.mean(e**2, axis=0)), relative)
    return replace(errors, all_samples=every, used_shares=tuple(map(float, used.mean(axis=0))))


def compute_gain(
    channel: Measurements,
    before: Sequence[np.ndarray],
    after: Sequence[np.ndarray],
    joints: Sequence[str],
    rng: np.random.Generator,
    shown: Confirmation | None = None,
) -> Gain:
    """Return the reduction of the error of some outputs on the test data.

    If the share `s` of a predicted change `x` is true, the sums of squares are `N + s^2 |x|^2` before it and
    `N + (1 - s)^2 |x|^2` with it. With `s` from generalised least squares the interval follows from its standard error, and
    always contains the measured reduction; raw residuals scatter far more than white ones. Without `s` it is a bootstrap of
    paired blocks.

    Args:
        channel: The data.
        before: Residuals (n, m) of each run without the cause.
        after: The same with it.
        joints: Outputs that are used; all outputs if the list names no output.
        rng: Random numbers of the bootstrap.
        shown: Share of the predicted effect that this part shows.
    """
    which = [k for k, output in enumerate(channel.outputs) if output in joints] or list(range(len(channel.outputs)))
    (b, counts), (a, _) = (_sum_blocks(channel, x) for x in (before, after))
    b, a, n = (x[:, which].sum(axis=1) for x in (b, a, counts))
    pick = rng.integers(len(n), size=(_DRAWS, len(n)))
    ratio = np.sqrt(a[pick].sum(axis=1) / np.maximum(b[pick].sum(axis=1), 1e-300))
    low, high = np.percentile(100 * (1 - ratio), _INTERVAL)
    total = max(float(n.sum()), 1.0)
    rms_before, rms_after = (float(np.sqrt(x.sum() / total)) for x in (b, a))
    reduction = 100 * (1 - rms_after / rms_before) if rms_before > 0 else 0.0
    if shown is not None and np.isfinite(shown.stderr) and b.sum() > 0:
        changed, _ = _sum_blocks(channel, [one - other for one, other in zip(before, after, strict=True)])
        x = float(changed[:, which].sum())
        noise = max(float(a.sum()) - (1 - shown.share) ** 2 * x, 1e-12 * float(b.sum()))
        s = shown.share + Z95 * shown.stderr * np.array([-1.0, 1.0])
        ends = 100 * (1 - np.sqrt((noise + (1 - s) ** 2 * x) / (noise + s**2 * x)))
        low, high = min(*ends, reduction), max(*ends, reduction)
    return Gain(rms_before, rms_after, reduction, (float(low), float(high)))


def _sum_blocks(channel: Measurements, residuals: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of squares and counts (blocks, m) over 2 s blocks of the test data."""
    squares, counts = [], []
    for run, e, mask in zip(channel.runs, residuals, channel.masks(TEST), strict=True):
        number = assign_blocks(run.t - run.t[0])
        for b in np.unique(number[mask.any(axis=1)]):
            rows = number == b
            squares.append(np.sum(np.where(mask[rows], e[rows], 0.0) ** 2, axis=0))
            counts.append(mask[rows].sum(axis=0))
    return np.array(squares), np.array(counts)


def _resample(squares: np.ndarray, counts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rms (draws, m) over blocks drawn with replacement."""
    pick = rng.integers(len(counts), size=(_DRAWS, len(counts)))
    return np.sqrt(squares[pick].sum(axis=1) / np.maximum(counts[pick].sum(axis=1), 1))


def estimate_noise_floor(channel: Channel, extended: EvaluatedFit, rng: np.random.Generator) -> OutputErrors:
    """Return the floor on the test data, and over all samples: the residual after a fit of smooth functions of the motion.

    Args:
        channel: The measurements for reported errors.
        extended: The extended model on them.
        rng: For intervals.
    """
    runs = extended.regression.runs
    every = [np.ones(run.usable.shape, dtype=bool) for run in runs]
    whole = extended.regression.residuals_all(extended.theta)
    left = _subtract_smooth(channel, extended.residuals, [run.W for run in runs], channel.masks(*EVERY))
    return compute_errors(
        channel, left, rng, whole=_subtract_smooth(channel, whole, [run.W_all for run in runs], every)
    )


def _subtract_smooth(
    channel: Channel, residuals: Sequence[np.ndarray], columns: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return residuals (n, m) minus their fit by baseline and smooth functions, scaled for its degrees of freedom."""
    found, variables = [e.copy() for e in residuals], channel.variables()
    for k, output in enumerate(channel.outputs):
        smooth = build_smooth_columns(variables, output)
        basis = [np.concatenate([W[:, k], rich], axis=1) for W, rich in zip(columns, smooth, strict=True)]
        rows = np.concatenate([b[m[:, k]] for b, m in zip(basis, masks, strict=True)])
        y = np.concatenate([e[m[:, k], k] for e, m in zip(residuals, masks, strict=True)])
        unit, norm = scale_columns(rows)
        theta, _, rank, _ = np.linalg.lstsq(unit, y, rcond=1e-7)
        scale = np.sqrt(len(y) / max(1, len(y) - rank))
        for e, b in zip(found, basis, strict=True):
            e[:, k] = (e[:, k] - b @ (theta / norm)) * scale
    return found
