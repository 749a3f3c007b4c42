"""How far an observer's estimate may be off where its model is: intervals that grow with innovations that are not white.

The filter's own covariance holds for a right model. Two faults of a model show in a log without any tool position:

* its frequencies: with poles `p^s` and the same static gain, the scale `s` under which the innovations are most likely;
* the accelerometer's bias: over a motion from rest to rest the tool's mean acceleration is zero.

With `z` the estimate and `z_s` that of the scaled model from accelerations without the bias, the variance of an error is taken as

    mean (z - z_s)^2 + ratio^2 P_s,

`P_s` the scaled filter's own variance, `ratio` the size of its innovations over the expected one (overdispersion).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import fractional_matrix_power
from scipy.optimize import minimize

from tau_dyn.control.observers.kalman import KalmanToolObserver
from tau_dyn.control.observers.tuning import Whiteness, check_whiteness, log_likelihood
from tau_dyn.modes import StateSpace

_SCALES = (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15)  # of all frequencies, where the search starts
_DECADES = (-3, -1, 1)  # of the process noise around the tuned one


@dataclass(frozen=True, eq=False)
class ObserverError:
    """What an estimate may be off by.

    Attributes:
        stderr: Standard deviation of the error, one an axis (m,) [m].
        own: What the filter states itself (m,) [m].
        frequency_scale: All frequencies of the model times this make the innovations most likely.
        bias: Of the accelerometer, one an axis (m,) [m/s^2].
        whiteness: Of the innovations of the filter as it is.
    """

    stderr: np.ndarray
    own: np.ndarray
    frequency_scale: float
    bias: np.ndarray
    whiteness: Whiteness


def estimate_observer_error(
    observer: KalmanToolObserver, kinematic: np.ndarray, acceleration: np.ndarray
) -> ObserverError:
    """Return what the estimate of a log may be off by.

    Args:
        observer: The filter, tuned.
        kinematic: Tool positions computed from the actuators (N, m) [m], from rest to rest.
        acceleration: Of the tool, without gravity (N, m) [m/s^2].
    """
    z, innovations = observer.run(kinematic, acceleration)
    dt = observer.dt
    bias = np.mean(acceleration[1:-1] - np.diff(z, n=2, axis=0) / dt**2, axis=0)
    best, scale = _rescale(observer, kinematic, acceleration - bias)
    other, rest = best.run(kinematic, acceleration - bias)
    own, white = observer.standard_error(), check_whiteness(innovations, observer.innovation_covariance)
    ratio = check_whiteness(rest, best.innovation_covariance).ratio
    variance = np.mean((z - other) ** 2, axis=0) + (np.maximum(ratio, 1) * best.standard_error()) ** 2
    return ObserverError(np.sqrt(variance), own, scale, bias, white)


def scale_frequencies(model: StateSpace, scale: float) -> StateSpace:
    """Return a model whose poles are `p^scale`, that is all frequencies and decay rates times a scale, with its static gain."""
    A = np.real(fractional_matrix_power(model.A, scale))
    eye = np.eye(len(A))
    return replace(model, A=A, B=(eye - A) @ np.linalg.solve(eye - model.A, model.B))


def _rescale(
    observer: KalmanToolObserver, kinematic: np.ndarray, acceleration: np.ndarray
) -> tuple[KalmanToolObserver, float]:
    """Return the filter of the scaled model, its process and measurement noise chosen again, and the scale."""
    quiet = (
        np.mean(np.diff(acceleration, n=3, axis=0) ** 2) / 20
    )  # what is white in it, whatever the filter was tuned to
    alternative = float(np.log(max(quiet, 1e-12) / np.mean(np.diag(observer.R2))))

    def build(x: np.ndarray) -> KalmanToolObserver:
        process, measurement = (
            np.asarray(p) * np.exp(np.clip(k, -40, 40))
            for p, k in zip((observer.process, observer.R2), x[1:], strict=True)
        )
        model = scale_frequencies(observer.model, float(np.exp(x[0])))
        return replace(observer, model=model, process=process, measurement=measurement)

    def cost(x: np.ndarray) -> float:
        return -log_likelihood(build(x), kinematic, acceleration) / len(kinematic)

    starts = [np.array([np.log(s), np.log(10.0) * k, r]) for s in _SCALES for k in _DECADES for r in (0.0, alternative)]
    at = min(starts, key=cost)
    simplex = at + np.vstack([np.zeros(3), np.diag([0.02, 1.0, 0.3])])
    options = {"xatol": 1e-3, "fatol": 1e-5, "maxfev": 120, "initial_simplex": simplex}
    found = minimize(cost, at, method="Nelder-Mead", options=options).x
    return build(found), float(np.exp(found[0]))
