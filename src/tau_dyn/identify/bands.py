r"""Predictive bands for 90 % of a log's forces, from training data alone, and the share of held-out samples in them.

    y - W theta  in  [m - hypot(m - l, z s),  m + hypot(u - m, z s)]

`l, m, u`: quantiles at 5, 50 and 95 % of each output's cross-validated residual: every log in turn (with fewer than three logs,
every fifth of each) is predicted by least squares on the others. The residuals therefore contain the noise, its colour and the
model error on data that were not fitted. `s` is the parameters' standard error in the prediction beyond its mean over the
training data, which the cross-validation contains already: it widens the band at motions that excite parameters that the logs
do not determine. Reference: Stone 1974.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from tau_dyn.estimate import Estimate, Regression
from tau_dyn.identify.widening import compute_data_covariance, measure_logs
from tau_dyn.results import Brief

BAND_LEVEL = 0.90
"""Share of the samples that a band should contain."""
_FOLDS = 5  # parts of each log that are left out in turn, if there are fewer than three logs
_MIN_LOGS = 3  # from which whole logs are left out
_Z = float(stats.norm.ppf((1 + BAND_LEVEL) / 2))
_REFIT_TOLERANCE = 1e-10  # relative singular value below which the other folds do not determine a direction


@dataclass(frozen=True, eq=False)
class PredictiveBands(Brief):
    """Bands around predicted forces, and the share of samples in them.

    Attributes:
        joints: Outputs.
        lower: Lower ends of the residual of each run (n, m), NaN for an output without training samples.
        upper: Upper ends.
        inside: Used samples within their band, by joint (m,).
        used: Used samples, by joint (m,).
        inside_all: Samples within their band, masked ones included, by joint (m,).
        all: All samples, masked ones included, by joint (m,).
        width: Mean width over the used samples, by joint (m,) [N or N m].
    """

    joints: tuple[str, ...]
    lower: tuple[np.ndarray, ...]
    upper: tuple[np.ndarray, ...]
    inside: np.ndarray
    used: np.ndarray
    inside_all: np.ndarray
    all: np.ndarray
    width: np.ndarray

    @property
    def share(self) -> float:
        """Share of all joints' used samples within their band."""
        return float(self.inside.sum() / max(1, self.used.sum()))

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form; `null` for a joint without used samples."""
        rows = zip(self.joints, self.inside, self.used, self.width, self.inside_all, self.all, strict=True)
        per_joint = {
            j: {
                "share": int(k) / int(n) if n else None,
                "width": float(w) if n else None,
                "share_all_samples": int(k_all) / max(1, int(n_all)),
            }
            for j, k, n, w, k_all, n_all in rows
        }
        every = float(self.inside_all.sum() / max(1, self.all.sum()))
        return {"level": BAND_LEVEL, "share": self.share, "share_all_samples": every, "per_joint": per_joint}


def build_predictive_bands(estimate: Estimate, held: Regression, theta: np.ndarray) -> PredictiveBands | None:
    """Return the bands of held-out data from an estimate on other data.

    Args:
        estimate: Estimate on the training data alone.
        held: The held-out rows; their columns are named like `theta`.
        theta: The estimate as the held-out model's parameters (p,).

    Returns:
        The bands, or None if the rows of either data set are not in memory.
    """
    if held.everything is not None or estimate.regression.everything is not None:
        return None
    low_end, m, high_end = _compute_residual_quantiles(estimate)
    C = compute_data_covariance(estimate)
    C = C * measure_logs(estimate, C)
    kept = [estimate.base.names[c] for c in estimate.base.kept]
    mean = _average_variance(estimate, C, kept)
    size = len(held.outputs)
    lower, upper, counts, width = [], [], np.zeros((4, size)), np.zeros(size)
    for run in held.runs:
        used, every = ((W, _widen(W, held.parameters.names, kept, C, mean)) for W in (run.W, run.W_all))
        for k, (y, (W, extra), mask) in enumerate(
            ((run.y, used, run.usable), (run.y_all, every, np.ones_like(run.usable)))
        ):
            e = y - W @ theta
            low = m - np.sqrt((m - low_end) ** 2 + extra)
            high = m + np.sqrt((high_end - m) ** 2 + extra)
            counts[2 * k] += np.sum((e >= low) & (e <= high) & mask, axis=0)
            counts[2 * k + 1] += np.sum(mask, axis=0)
            width += np.sum(np.where(mask, high - low, 0.0), axis=0) * (k == 0)
        lower.append(low)
        upper.append(high)
    return PredictiveBands(held.outputs, tuple(lower), tuple(upper), *counts, width / np.maximum(counts[1], 1))  # type: ignore[call-arg]


def _widen(W: np.ndarray, names: tuple[str, ...], kept: list[str], C: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the parameters' contribution to the squared half width at rows (n, m, p), beyond its mean in the training."""
    return _Z**2 * np.maximum(_compute_variance(W, names, kept, C) - mean, 0.0)


def _compute_residual_quantiles(estimate: Estimate) -> np.ndarray:
    """Return the cross-validated residual's quantiles at 5, 50 and 95 % (3, m), NaN for an output without samples."""
    ends = ((1 - BAND_LEVEL) / 2, 0.5, (1 + BAND_LEVEL) / 2)
    residuals = _cross_validate(estimate)
    return np.column_stack([np.quantile(e, ends) if len(e) else np.full(3, np.nan) for e in residuals])


def _cross_validate(estimate: Estimate) -> list[np.ndarray]:
    """Return each output's residuals (n,) on folds that were predicted by fits to the others."""
    regression, sigma = estimate.regression, estimate.sigma
    kept = [regression.parameters.names.index(estimate.base.names[c]) for c in estimate.base.kept]
    logs = list(dict.fromkeys(run.name for run in regression.runs))
    rows = []
    for run, e in zip(regression.runs, estimate.residuals(), strict=True):
        if len(logs) >= _MIN_LOGS:
            fold = np.full(len(run.t), logs.index(run.name))
        else:
            fold = np.arange(len(run.t)) * _FOLDS // max(1, len(run.t))
        which, output = np.nonzero(run.usable)
        W = run.W[which, output][:, kept] / sigma[output, None]
        rows.append((fold[which], output, W, e[which, output] / sigma[output]))
    fold, output, W, e = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    left, scale = e.copy(), np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    for k in np.unique(fold):
        others = fold != k
        if others.any():
            shift = np.linalg.lstsq(W[others] / scale, e[others], rcond=_REFIT_TOLERANCE)[0] / scale
            left[~others] -= W[~others] @ shift
    return [sigma[j] * left[output == j] for j in range(len(sigma))]


def _compute_variance(W: np.ndarray, names: tuple[str, ...], kept: list[str], C: np.ndarray) -> np.ndarray:
    """Return the parameters' variance in predictions of rows (n, m, p): (n, m)."""
    columns = W[:, :, [names.index(name) for name in kept]]
    return np.einsum("nmr,nmr->nm", columns @ C, columns)


def _average_variance(estimate: Estimate, C: np.ndarray, kept: list[str]) -> np.ndarray:
    """Return the mean of the parameters' variance over the training rows of each output (m,)."""
    names = estimate.regression.parameters.names
    total, count = np.zeros(len(estimate.sigma)), np.zeros(len(estimate.sigma))
    for run in estimate.regression.runs:
        total += np.sum(_compute_variance(run.W, names, kept, C) * run.usable, axis=0)
        count += run.usable.sum(axis=0)
    return total / np.maximum(count, 1)
