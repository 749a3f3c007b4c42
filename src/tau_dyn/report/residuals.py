"""How a residual looks when nothing is left in it: its autocorrelation against that of noise through the fit's own filter.

Measured forces and columns were low-passed together, so even pure noise is correlated over a few samples; `filter_memory`
is that correlation, and what lies outside it is something the model misses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.estimate import Regression
from tau_dyn.identify import Identification
from tau_dyn.report.formatting import Z95

LAGS = 20.0
"""Longest lag times the low-pass' cutoff; at least 0.3 s and at most 2 s are shown."""
MAX_EXCESS_CORRELATION = 0.2
"""Autocorrelation beyond the filter's that counts as something left."""


@dataclass(frozen=True)
class ResidualSummary:
    """One joint's residual over the samples that the fit uses.

    Attributes:
        joint: The joint.
        unit: Unit of the force.
        values: Measured minus predicted (n,).
        lags: Time lags (m,) [s].
        correlation: Autocorrelation at the lags (m,).
        expected: That of noise through the same low-pass (m,).
        bound: 95 % bound of the autocorrelation of noise.
        lasts_s: Lag from which on it stays within 0.2 of what the filter leaves [s].
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
        """Whether nothing systematic is left beyond the filter's own correlation."""
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
    expected = filter_memory(lags, cutoff_hz)
    bound = Z95 * float(np.sqrt(np.sum(expected**2) * 2 / max(1, len(values))))
    beyond = np.flatnonzero(np.abs(correlation - expected) > max(MAX_EXCESS_CORRELATION, bound))
    lasts = float(lags[beyond[-1]]) if beyond.size else 0.0
    return ResidualSummary(
        regression.outputs[k], regression.units[k], values, lags, correlation, expected, bound, lasts
    )


def filter_memory(lags: np.ndarray, cutoff_hz: float, order: int = 4) -> np.ndarray:
    """Return the autocorrelation (m,) of white noise after the fit's zero-phase low-pass."""
    f = np.linspace(0.0, 4 * cutoff_hz, 4001)
    power = (1 / (1 + (f / cutoff_hz) ** (2 * order))) ** 2
    return np.array([np.sum(power * np.cos(2 * np.pi * f * lag)) for lag in lags]) / np.sum(power)


def _lagged_sum(x: np.ndarray, n_lags: int) -> np.ndarray:
    size = 1 << int(np.ceil(np.log2(len(x) + n_lags)))
    return np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[:n_lags]
