"""Baseline values from which a delay or a low-pass of the logged forces is taken out.

A fit of late forces takes a part of the delay for viscous friction and for masses: `m a(t - d)` has `m w^2 d v` in it, of 60 ms
at 1 Hz more than many a joint's friction. The force that such a fit predicts is no longer the one that was logged late, and
what it leaves looks like springs and hysteresis. So the delay `d` and the time constant `T` of each output are profiled
(variable projection, Golub & Pereyra 1973): forces are moved back, `y(t + d) + T y'(t + d)`, the baseline is refitted, and the
values at the best `d` and `T` predict the force that effects of the recording act on. Short ones change nothing worth it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.diagnose.null_model import orthonormalise
from tau_dyn.estimate import RegressionRun

MAX_TIME_S = 0.1
"""Longest delay and time constant that are looked for: the end of the plausible range of `delay` and `drive_lag`."""
MIN_TIME_S = 3e-3
"""Time below which values are left as they are: of a motion at 2 Hz it turns 4 % of the force into another."""
_STEPS_S = (1e-2, 2.5e-3, 6e-4, 1.5e-4, 4e-5)
"""Steps of the search: the misfit of motions up to 10 Hz has one minimum within 10 ms."""
_MAX_ROWS = 8000
"""Samples looked at, evenly over the runs: enough for a time to a tenth of a millisecond."""
_MIN_IMPROVEMENT = 0.02
"""Share of the squared misfit that a time must take away; what noise makes of some forty tries is far less."""


@dataclass(frozen=True, eq=False)
class ForceTiming:
    """Timing of the logged forces that fits the baseline best.

    Attributes:
        delays: Of each output (m,) [s].
        lags: Time constants of each output's low-pass (m,) [s].
        change: What that timing changes in the baseline's values (p,).
    """

    delays: np.ndarray
    lags: np.ndarray
    change: np.ndarray


def find_timing(runs: Sequence[RegressionRun], values: np.ndarray, free: np.ndarray) -> ForceTiming | None:
    """Return the timing of the forces that fits the baseline best; None where it is as good as none.

    Args:
        runs: The training runs, with the baseline's columns.
        values: The fitted baseline's values (p,).
        free: Which of them are fitted (p,).
    """
    profile = _Profile(runs, free)
    if profile.Q.shape[1] == 0:
        return None
    delays, lags = profile.minimise()
    if max(np.abs(delays).max(), lags.max()) < MIN_TIME_S:
        return None
    W, weight = profile.W, profile.weight
    norm = np.linalg.norm(W, axis=0)
    unit = np.where(norm > 0, norm, 1.0)
    predicted = np.concatenate([(run.W_all @ values)[mask] for run, mask in zip(runs, profile.usable, strict=True)])
    changed = weight * (profile.moved(delays, lags) - predicted)
    found = np.zeros(len(free))
    found[free] = np.linalg.lstsq(W * weight[:, None] / unit, changed, rcond=1e-8)[0] / unit
    return ForceTiming(delays, lags, found)


class _Profile:
    """The baseline's misfit at any timing of the forces."""

    def __init__(self, runs: Sequence[RegressionRun], free: np.ndarray) -> None:
        """Prepare the projection; rows (R,) are the usable samples, outputs by their own residual."""
        every = 1 + sum(int(run.usable.sum()) for run in runs) // _MAX_ROWS
        self.usable = [run.usable & (np.arange(len(run.t)) % every == 0)[:, None] for run in runs]
        self.t = [run.t for run in runs]
        self.splines = [CubicSpline(run.t, run.y_all) if len(run.t) > 3 else None for run in runs]
        self.y = [run.y_all for run in runs]
        self.m = runs[0].y_all.shape[1]
        self.output = np.concatenate([np.nonzero(mask)[1] for mask in self.usable])
        self.W = np.concatenate([run.W_all[:, :, free][mask] for run, mask in zip(runs, self.usable, strict=True)])
        now = np.concatenate([y[mask] for y, mask in zip(self.y, self.usable, strict=True)])
        Q = orthonormalise(self.W)
        e = now - Q @ (Q.T @ now)
        count = np.maximum(np.bincount(self.output, minlength=self.m), 1)
        size = np.sqrt(np.bincount(self.output, e**2, self.m) / count)
        self.weight = 1 / np.maximum(size, 1e-12 * max(float(np.abs(now).max(initial=0.0)), 1e-300))[self.output]
        self.Q = orthonormalise(self.W * self.weight[:, None])

    def moved(self, delays: np.ndarray, lags: np.ndarray) -> np.ndarray:
        """Return usable forces (R,) with the outputs' delays (m,) and low-passes (m,) [s] taken out."""
        found = []
        for t, y, spline, mask in zip(self.t, self.y, self.splines, self.usable, strict=True):
            whole = y.copy()
            for k in range(self.m):
                if spline is not None and (delays[k] or lags[k]):
                    when = np.clip(t + delays[k], t[0], t[-1])
                    whole[:, k] = spline(when)[:, k]
                    if lags[k]:
                        whole[:, k] += lags[k] * spline(when, 1)[:, k]
            found.append(whole[mask])
        return np.concatenate(found)

    def misfit(self, delays: np.ndarray, lags: np.ndarray) -> float:
        """Return the squared misfit of the refitted baseline."""
        y = self.weight * self.moved(delays, lags)
        return float(y @ y - np.sum((self.Q.T @ y) ** 2))

    def minimise(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the best delays and time constants (m,) [s]: of all outputs alike, then of each alone where better."""
        best = np.zeros(self.m), np.zeros(self.m)
        least = self.misfit(*best)
        alone = [np.arange(self.m) == k for k in range(self.m)]
        for which in [np.ones(self.m, bool), *(alone if self.m > 1 else [])]:
            found = [self._search(best, least, which, kind) for kind in (0, 1)]
            value, trial = min(found, key=lambda x: x[0])
            if value < (1 - _MIN_IMPROVEMENT) * least:
                least, best = value, trial
        return best

    def _search(
        self, start: tuple[np.ndarray, np.ndarray], least: float, which: np.ndarray, kind: int
    ) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
        """Return the least misfit over the delay (kind 0) or the time constant (1) of some outputs (m,), and where it is."""

        def at(x: float) -> tuple[np.ndarray, np.ndarray]:
            times = [np.array(one) for one in start]
            times[kind][which] = x
            return times[0], times[1]

        now = float(start[kind][which][0])
        near = [x for x in (now - MIN_TIME_S, now + MIN_TIME_S) if x >= 0 or kind == 0]
        if min(self.misfit(*at(x)) for x in near) >= least:
            return least, start
        low, best, reach = (-MAX_TIME_S if kind == 0 else 0.0), (least, now), MAX_TIME_S
        for step in _STEPS_S:
            middle = best[1] if reach < MAX_TIME_S else 0.0
            tries = np.arange(max(low, middle - reach), min(MAX_TIME_S, middle + reach) + step / 2, step)
            best = min([best, *((self.misfit(*at(float(x))), float(x)) for x in tries)])
            reach = step
        return best[0], at(best[1])
