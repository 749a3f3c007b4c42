"""The tool's position from a log, with intervals: the result of `tau-dyn observe`.

With a model from computed to true tool positions (6.13): the Kalman filter, tuned on the log itself. Without one: the
complementary filter, whose interval holds noise and the deflection that its low-pass takes for the carts'.

Intervals under a wrong model: they grow if the innovations are not white. The filter's own covariance is valid only for a
correct model. Two faults of a model are visible in a log without any tool position:

* its frequencies: with poles `p^s` and the same static gain, the scale `s` under which the innovations are most likely;
* the accelerometer's bias: over a motion from rest to rest the tool's mean acceleration is zero.

With `z` the estimate and `z_s` that of the scaled model from accelerations without the bias, the variance of an error is taken as

    mean (z - z_s)^2 + ratio^2 P_s,

`P_s` the scaled filter's own variance, `ratio` the size of its innovations over the expected one (overdispersion).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import fractional_matrix_power
from scipy.optimize import minimize

from tau_dyn.control.observers.complementary import ComplementaryToolObserver, require_signals
from tau_dyn.control.observers.kalman import KalmanToolObserver
from tau_dyn.control.observers.tuning import Whiteness, check_whiteness, log_likelihood, tune_kalman
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes import StateSpace
from tau_dyn.results import Z95, Shown

_SCALES = (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15)  # of all frequencies, where the search starts
_DECADES = (-3, -1, 1)  # of the process noise around the tuned one


@dataclass(frozen=True, eq=False)
class ObserverError:
    """Error of an estimate.

    Attributes:
        stderr: Standard deviation of the error, one per axis (m,) [m].
        own: Standard deviation by the filter's own covariance (m,) [m].
        frequency_scale: Factor of all frequencies of the model with the largest likelihood of the innovations.
        bias: Bias of the accelerometer, one per axis (m,) [m/s^2].
        whiteness: Whiteness of the innovations of the unchanged filter.
    """

    stderr: np.ndarray
    own: np.ndarray
    frequency_scale: float
    bias: np.ndarray
    whiteness: Whiteness


def estimate_observer_error(
    observer: KalmanToolObserver, kinematic: np.ndarray, acceleration: np.ndarray
) -> ObserverError:
    """Return the error of the estimate of a log.

    Args:
        observer: The filter, tuned.
        kinematic: Tool positions computed from the actuators (N, m) [m], from rest to rest.
        acceleration: Acceleration of the tool, without gravity (N, m) [m/s^2].
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
    quiet = np.mean(np.diff(acceleration, n=3, axis=0) ** 2) / 20  # its white part, independent of the filter's tuning
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


_MIN_P = 1e-3  # p-value below which innovations are reported as not white
_SCALE = 0.02  # share by which a model's frequencies may be off without a warning


@dataclass(frozen=True, eq=False)
class ToolObservation(Shown):
    """Estimated tool positions.

    Attributes:
        axes: Names of the tool's directions.
        t: Time (N,) [s].
        kinematic: Tool positions computed from the actuators (N, m) [m].
        position: Estimated tool positions (N, m) [m].
        stderr: Standard deviation of their error (m,) [m].
        how: The filter in words.
        error: Error of the estimate by the innovations; None without a Kalman filter.
        notes: Further warnings.
    """

    axes: tuple[str, ...]
    t: np.ndarray
    kinematic: np.ndarray
    position: np.ndarray
    stderr: np.ndarray
    how: str
    error: ObserverError | None
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Properties of the model that the log contradicts, and notes."""
        if self.error is None:
            return self.notes
        said, e = [], self.error
        if abs(e.frequency_scale - 1) > _SCALE:
            said.append(
                f"the log looks like a model whose frequencies are {e.frequency_scale:.3g} times the given ones; the intervals "
                "allow for it, a new model is better"
            )
        said += [
            f"the innovations of {axis} are not white (largest correlation {r:.2g}); the intervals allow for it"
            for axis, p, r in zip(self.axes, e.whiteness.p_value, e.whiteness.correlation, strict=True)
            if p < _MIN_P
        ]
        return (*self.notes, *(CodedWarning("model_contradicted", sentence) for sentence in said))

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one row an axis: deflection [m], standard error and 95 % half-width [m], bias [m/s^2]."""
        deflection = self.position - self.kinematic
        rows = []
        for k, axis in enumerate(self.axes):
            bias = None if self.error is None else float(self.error.bias[k])
            rows.append({
                "axis": axis, "deflection_rms": float(np.sqrt(np.mean(deflection[:, k] ** 2))),
                "deflection_max": float(np.abs(deflection[:, k]).max()), "stderr": float(self.stderr[k]),
                "half_width95": float(Z95 * self.stderr[k]), "accelerometer_bias": bias,
            })  # fmt: skip
        return rows

    def to_csv(self) -> str:
        """Return a table: t, the tool's positions, and the ends of their 95 % intervals."""
        import pandas as pd

        columns = {"t": self.t}
        for k, axis in enumerate(self.axes):
            x, half = self.position[:, k], Z95 * self.stderr[k]
            columns |= {axis: x, f"{axis}_low": x - half, f"{axis}_high": x + half}
        return pd.DataFrame(columns).to_csv(index=False, float_format="%.12g", lineterminator="\n")


def observe_tool(
    axes: Sequence[str],
    t: np.ndarray,
    kinematic: np.ndarray,
    acceleration: np.ndarray,
    *,
    model: StateSpace | None = None,
    cutoff_hz: Sequence[float] = (),
) -> ToolObservation:
    """Return the tool's positions of a log that begins at rest; with a model it must also end at rest.

    Args:
        axes: Names of the tool's directions (m of them).
        t: Time (N,) [s], evenly spaced.
        kinematic: Tool positions computed from the actuators (N, m) [m].
        acceleration: Acceleration of the tool, without gravity (N, m) [m/s^2].
        model: Model from computed to true tool positions; None for the complementary filter.
        cutoff_hz: Cutoff of the complementary filter, one for all axes or one per axis.

    Raises:
        InputError: Shapes or steps differ, or the model is unstable.
    """
    require_signals(kinematic, acceleration, len(axes))
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    if model is None:
        cutoffs = tuple(cutoff_hz) * (len(axes) if len(cutoff_hz) == 1 else 1)
        observer = ComplementaryToolObserver(cutoffs, dt)
        position = observer.estimate(kinematic, acceleration)
        stderr = _estimate_complementary_error(observer, position - kinematic, kinematic, acceleration)
        how = f"complementary filter, {', '.join(f'{f:.3g}' for f in cutoffs)} Hz"
        return ToolObservation(tuple(axes), t, kinematic, position, stderr, how, None)
    bias = acceleration.mean(axis=0)  # from rest to rest the tool's mean acceleration is zero
    tuned = tune_kalman(model, kinematic, acceleration - bias)
    error = estimate_observer_error(tuned.observer, kinematic, acceleration - bias)
    error = replace(error, bias=error.bias + bias)
    position = tuned.observer.estimate(kinematic, acceleration - bias)
    how = f"Kalman filter of order {model.order}, tuned on this log"
    return ToolObservation(tuple(axes), t, kinematic, position, error.stderr, how, error)


def _estimate_complementary_error(
    observer: ComplementaryToolObserver, deflection: np.ndarray, kinematic: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    """Return the standard deviation (m,) [m] of a complementary filter's error.

    The filter estimates `(1 - G) d` of the deflection d, so its error is `G d`. A tool on damped springs has
    `d = -c a - b v`: both coefficients are fitted to the estimate (least squares) and predict the error. The noise of both
    sensors and the effect of a bias are added.
    """
    nothing = np.zeros_like(acceleration)
    causes = (acceleration, np.gradient(kinematic, observer.dt, axis=0))
    low = [observer.estimate(x, nothing) for x in causes]
    missed = np.empty_like(deflection)
    for k in range(observer.axes):
        passed = np.column_stack([x[:, k] for x in low])
        seen = np.column_stack([x[:, k] for x in causes]) - passed
        missed[:, k] = passed @ np.linalg.lstsq(seen, deflection[:, k], rcond=None)[0]
    bias = observer.estimate(nothing, nothing + acceleration.mean(axis=0))
    noise = [_estimate_white_noise(x) for x in (kinematic, acceleration)]
    variance = observer.standard_error(*noise) ** 2
    return np.sqrt(variance + np.mean(missed**2, axis=0) + np.mean(bias**2, axis=0))


def _estimate_white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation (m,) of white noise in signals (N, m), by third differences, which a motion hardly has."""
    return np.sqrt(np.mean(np.diff(x, n=3, axis=0) ** 2, axis=0) / 20)
