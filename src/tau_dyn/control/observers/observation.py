"""The tool's position from a log, with intervals: what `tau-dyn observe` finds.

With a model from computed to true tool positions (6.13): the Kalman filter, tuned on the log itself. Without one: the
complementary filter, whose interval holds noise and the deflection that its low-pass takes for the carts'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.control.observers.complementary import ComplementaryToolObserver, require_signals
from tau_dyn.control.observers.observer_error import ObserverError, estimate_observer_error
from tau_dyn.control.observers.tuning import tune_kalman
from tau_dyn.modes import StateSpace
from tau_dyn.results import Z95, Shown

_MIN_P = 1e-3  # p-value below which innovations are said not to be white
_SCALE = 0.02  # share by which a model's frequencies may be off before it is said


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
        error: What the innovations say of the model; None of the complementary filter.
    """

    axes: tuple[str, ...]
    t: np.ndarray
    kinematic: np.ndarray
    position: np.ndarray
    stderr: np.ndarray
    how: str
    error: ObserverError | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What of the model the log contradicts."""
        if self.error is None:
            return ()
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
        return tuple(said)

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
    """Return the tool's positions of a log that begins at rest, and with a model ends there.

    Args:
        axes: Names of the tool's directions (m of them).
        t: Time (N,) [s], evenly spaced.
        kinematic: Tool positions computed from the actuators (N, m) [m].
        acceleration: Of the tool, without gravity (N, m) [m/s^2].
        model: From computed to true tool positions; None for the complementary filter.
        cutoff_hz: Of the complementary filter, one or one an axis.

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

    The filter sees `(1 - G) d` of the deflection d, and errs by `G d`. A tool on damped springs has `d = -c a - b v`: both
    numbers are fitted to what is seen (least squares), and tell what is missed. Beside it both sensors' noise, and the trace of
    a bias.
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
    slow, fast = observer.responses((np.arange(4096) + 0.5) / 8192 / observer.dt)
    power = [np.mean(np.abs(np.einsum("fii->fi", x)) ** 2, axis=0) for x in (slow, fast)]
    variance = power[0] * noise[0] ** 2 + power[1] * noise[1] ** 2
    return np.sqrt(variance + np.mean(missed**2, axis=0) + np.mean(bias**2, axis=0))


def _estimate_white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation (m,) of what is white in signals (N, m): of third differences, which a motion hardly has."""
    return np.sqrt(np.mean(np.diff(x, n=3, axis=0) ** 2, axis=0) / 20)
