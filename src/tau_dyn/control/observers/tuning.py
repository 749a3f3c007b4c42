"""Tuning of observers from logs.

Kalman filter: the process noise `r` and the accelerometer's variance by maximum likelihood of the innovations, from actuators
and accelerometer alone - no measurement of the tool's position is needed. Every channel has its own variance. If the
innovations are not white, the model is wrong, and the maximum of the likelihood has more process noise.

Complementary filter: the cutoff of each axis that leaves the smallest error against a measured tool position, as the thesis does
"by inspection" for (7.18).

Whiteness: a filter's innovations are white if model and covariances are correct. They are tested by the portmanteau test of
Ljung and Box (1978), each channel alone: `N (N + 2) sum r_k^2 / (N - k)` over the first lags follows a chi-squared law if the
innovations are white. In addition, the size of the innovations is compared with the size that the filter expects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi2

from tau_dyn.control.observers.complementary import ComplementaryToolObserver
from tau_dyn.control.observers.kalman import KalmanToolObserver
from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Tests of a filter by its innovations.

    Attributes:
        p_value: p-value of the hypothesis that they are white, one per channel (p,).
        correlation: The largest autocorrelation among the lags, one per channel (p,).
        ratio: Their standard deviation over the expected one (p,).
    """

    p_value: np.ndarray
    correlation: np.ndarray
    ratio: np.ndarray


def check_whiteness(innovations: np.ndarray, covariance: np.ndarray, lags: int = 20) -> Whiteness:
    """Return how white innovations (N, p) are, of which the filter expects a covariance (p, p)."""
    n = len(innovations)
    if n <= 2 * lags:
        raise InputError("too_little_data", f"{n} samples are too few to look at correlations over {lags} lags")
    x = innovations - innovations.mean(axis=0)
    power = np.mean(x**2, axis=0)
    r = np.array([np.sum(x[k:] * x[:-k], axis=0) / (n * power) for k in range(1, lags + 1)])
    statistic = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1))[:, None], axis=0)
    worst = np.abs(r).max(axis=0)
    return Whiteness(
        np.asarray(chi2.sf(statistic, lags)), worst, np.sqrt(np.mean(innovations**2, axis=0) / np.diag(covariance))
    )


@dataclass(frozen=True, eq=False)
class KalmanTuning:
    """A tuned filter and its fit to the data.

    Attributes:
        observer: The filter.
        log_likelihood: Log-likelihood of the innovations.
        whiteness: Whiteness of the innovations.
    """

    observer: KalmanToolObserver
    log_likelihood: float
    whiteness: Whiteness


def log_likelihood(observer: KalmanToolObserver, kinematic: np.ndarray, acceleration: np.ndarray) -> float:
    """Return the Gaussian log-likelihood of the innovations of signals (N, m)."""
    _, v = observer.run(kinematic, acceleration)
    S = observer.innovation_covariance
    _, log_det = np.linalg.slogdet(2 * np.pi * S)
    return float(-0.5 * (len(v) * log_det + np.einsum("ni,ni->", v, np.linalg.solve(S, v.T).T)))


def tune_kalman(
    model: StateSpace, kinematic: np.ndarray, acceleration: np.ndarray, *, start: KalmanToolObserver | None = None
) -> KalmanTuning:
    """Return the Kalman filter whose innovations are most likely.

    Args:
        model: Model from computed to true tool positions.
        kinematic: Tool positions computed from the actuators (N, m) [m].
        acceleration: The tool's, measured (N, m) [m/s^2].
        start: Filter from which the search starts; its settings `aligned` and `predict` are kept.
    """
    rest = acceleration - acceleration.mean(axis=0)
    quiet = np.maximum(np.var(np.diff(rest, n=2, axis=0), axis=0) / 6, 1e-12)  # its white part
    first = start or KalmanToolObserver(model, 1e-12, np.diag(quiet))
    scale = float(np.trace(np.atleast_2d(first.R2)) / first.axes)

    def observer(x: np.ndarray) -> KalmanToolObserver:
        r, *variances = np.exp(np.clip(x, -80, 20))
        return replace(first, process=float(r) * 1e-12, measurement=np.diag(scale * np.array(variances)))

    def cost(x: np.ndarray) -> float:
        return -log_likelihood(observer(x), kinematic, acceleration) / len(kinematic)

    variances = np.log(np.diag(first.R2) / scale)
    starts = [np.concatenate([[np.log(10.0) * k], variances]) for k in (-4, -2, 0, 2)]
    at = min(starts, key=cost)
    simplex = np.vstack([at, at + np.eye(len(at)) * np.array([2.0, *[0.3] * (len(at) - 1)])[:, None]])
    options = {"xatol": 0.05, "fatol": 1e-5, "maxfev": 100, "initial_simplex": simplex}
    best = observer(minimize(cost, at, method="Nelder-Mead", options=options).x)
    _, innovations = best.run(kinematic, acceleration)
    white = check_whiteness(innovations, best.innovation_covariance)
    return KalmanTuning(best, log_likelihood(best, kinematic, acceleration), white)


def tune_complementary(
    kinematic: np.ndarray, acceleration: np.ndarray, tool: np.ndarray, dt: float, *, causal: bool = False
) -> ComplementaryToolObserver:
    """Return the complementary filter with the smallest error against measured tool positions (N, m) [m].

    Raises:
        InputError: The signals are too short to choose a cutoff, or their shapes differ.
    """
    if not kinematic.shape == acceleration.shape == tool.shape or kinematic.ndim != 2:
        raise InputError(
            "wrong_shape", "positions, accelerations and measured tool positions must be (N, m), all the same"
        )
    lowest, highest = 3 / (len(tool) * dt), 0.4 / dt
    if not lowest < highest / 2:
        raise InputError("too_little_data", f"{len(tool)} samples of {1000 * dt:g} ms are too short to choose a cutoff")
    found = []
    for k in range(tool.shape[1]):
        z, a, truth = (x[:, k : k + 1] for x in (kinematic, acceleration, tool))

        def error(log_cutoff: float, z: np.ndarray = z, a: np.ndarray = a, truth: np.ndarray = truth) -> float:
            left = ComplementaryToolObserver((float(np.exp(log_cutoff)),), dt, causal).estimate(z, a) - truth
            return float(np.log(np.mean((left - left[0]) ** 2)))

        grid = np.linspace(np.log(lowest), np.log(highest), 25)
        near = int(np.argmin([error(x) for x in grid]))
        ends = grid[max(near - 1, 0)], grid[min(near + 1, len(grid) - 1)]
        found.append(float(np.exp(minimize_scalar(error, bounds=ends, method="bounded", options={"xatol": 1e-3}).x)))
    return ComplementaryToolObserver(tuple(found), dt, causal)
