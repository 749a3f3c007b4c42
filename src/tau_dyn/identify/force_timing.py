"""Is the force as old as the motion: late, early, or low-passed by its drive?

A force that is logged late by `d` is `tau(t - d)`; a drive that filters it gives `tau / (1 + T s)`. Both are told from wrong
parameters by the jerk: to first order the log holds `tau - d * dtau/dt`, and no body and no friction makes a force of the rate of
the whole force. So the columns of a linear model with all parameters free (no prior: wrong masses must not look like a delay) are
joined by `-d(model force)/dt` of each joint, and by Gauss-Newton the delays of all joints are found with the parameters. Standard
errors are robust to residuals that are correlated in time (cluster-robust, Liang & Zeger 1986, blocks of a second).

A delay is said where it exceeds one sample and 8 standard errors, and either all joints agree on it or it removes two fifths of
the joint's residual power: friction that follows the load, or a drive that yields, also leave a trace of jerk, in single joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.identify.excerpt import Excerpt
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import Robot

MIN_Z = 8.0
"""Least size of a delay in its standard errors: jerk-like model errors of sound robots reach 5."""

MIN_SAMPLES_LATE = 0.7
"""Smaller delays are the hold of a sampled force, half a sample [samples]."""

MAX_DELAY_S = 0.1
"""Longer delays are not looked for: a motion turns round in the meantime."""

MIN_POWER_REMOVED = 0.4
"""Share of a joint's residual power that its own delay removes before it is believed on its own."""

MIN_POWER_REMOVED_TOGETHER = 0.2
"""The same, on average, where all joints agree on one delay."""

AGREEMENT = 0.3
"""Joints agree on a delay that lies within this share of their mean, or within three standard errors."""

BLOCK_S = 1.0
"""Length of the blocks within which residuals may be correlated [s]: longer than friction and cables remember."""

ITERATIONS = 6
"""Gauss-Newton converges in four steps for delays below a quarter of the motion's shortest period."""

LAG_GAIN_NATS = 5.0
"""Log-likelihood gain from which a lag and a delay are told apart."""


class ForceDelay(NamedTuple):
    """How late forces are.

    Attributes:
        delay_s: Of each joint (na,) [s].
        stderr_s: Standard errors (na,) [s].
        removed: Share of each joint's residual power that its delay removes (na,).
        residual: Weighted residual power with the delays (na,).
        judged: Joints with enough samples (na,).
    """

    delay_s: np.ndarray
    stderr_s: np.ndarray
    removed: np.ndarray
    residual: np.ndarray
    judged: np.ndarray


def check_timing(robot: Robot, excerpt: Excerpt, name: str) -> list[CodedWarning]:
    """Return `force_late` or `force_lowpassed` of a log, with the evidence and the mend.

    Args:
        robot: The robot file; only its geometry counts.
        excerpt: Its log.
        name: The log's name, for the sentences.
    """
    fitter = _Fitter.of(robot, excerpt)
    if fitter is None:
        return []
    found = fitter.delays()
    late = _believed(found, excerpt.log.dt)
    if not late.any():
        return []
    return [_say(robot, name, found, late, _gain_of_lag(fitter, found, late), excerpt.log.dt)]


def _gain_of_lag(fitter: _Fitter, found: ForceDelay, late: np.ndarray) -> float:
    """Return by how many nats a first-order lag explains the joints that are late better than a delay does."""
    late = late & (found.delay_s > 0)
    if not late.any():
        return -np.inf
    by_lag = fitter.residual_with_lags(np.where(late, found.delay_s, 0.0))
    ratio = np.log(np.maximum(found.residual[late], 1e-300) / np.maximum(by_lag[late], 1e-300))
    return float(fitter.used.sum(axis=0)[late] @ ratio / 2)


def _believed(found: ForceDelay, dt: float) -> np.ndarray:
    """Return which joints' delays are said (na,)."""
    z = np.abs(found.delay_s) / found.stderr_s
    large = np.abs(found.delay_s) > MIN_SAMPLES_LATE * dt
    alone = found.judged & large & (z > MIN_Z) & (found.removed > MIN_POWER_REMOVED)
    weight = np.where(found.judged, found.stderr_s**-2.0, 0.0)
    mean = float(weight @ found.delay_s / max(weight.sum(), 1e-300))
    near = np.abs(found.delay_s - mean) < np.maximum(AGREEMENT * abs(mean), 3 * found.stderr_s)
    together = (
        found.judged.sum() >= 2
        and bool(np.all(near | ~found.judged))
        and abs(mean) > MIN_SAMPLES_LATE * dt
        and abs(mean) * np.sqrt(weight.sum()) > MIN_Z
        and np.count_nonzero(found.judged & (z > 3)) >= 2
        and float(np.mean(found.removed[found.judged & (z > 3)])) > MIN_POWER_REMOVED_TOGETHER
    )
    return found.judged if together else alone


class _Fitter:
    """The linear model of all joints on an excerpt, whose forces may be shifted in time."""

    def __init__(self, excerpt: Excerpt, columns: np.ndarray, used: np.ndarray) -> None:
        """Take columns (n, na, p) whose directions are independent enough."""
        self.excerpt, self.columns, self.used = excerpt, columns, used
        self.blocks = (np.arange(len(used)) * excerpt.dt / BLOCK_S).astype(int)

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt) -> _Fitter | None:
        """Return the fitter; None where the robot cannot move as logged, or nothing is left."""
        q, v, a = excerpt.q, excerpt.v, excerpt.a
        try:
            rigid = build_mechanism(robot).regressor(q, v, a)
        except (InputError, LoopClosureError, np.linalg.LinAlgError):
            return None
        na = robot.na
        used = excerpt.used & (excerpt.used.sum(axis=0) > 100)
        if not used.any() or not np.all(np.isfinite(rigid)):
            return None
        drives = np.zeros((len(q), na, 5 * na))
        for j in range(na):
            forward = v[:, j] > 0
            terms = (forward, ~forward, v[:, j] * forward, v[:, j] * ~forward, a[:, j])
            drives[:, j, 5 * j : 5 * j + 5] = np.column_stack(terms)
        columns = np.concatenate([rigid, drives], axis=2)
        flat = columns[used]
        size = np.linalg.norm(flat, axis=0)
        columns = columns[:, :, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()]
        _, singular, right = np.linalg.svd(np.linalg.qr(columns[used], mode="r"))
        return cls(excerpt, columns @ right[singular > 1e-6 * singular[0]].T, used)

    def delays(self) -> ForceDelay:
        """Return the delays of all joints, by Gauss-Newton together with the parameters."""
        na, n = self.used.shape[1], len(self.used)
        _, power, theta = self._solve(self.columns, np.zeros((n, na, 0)), np.zeros(na), None)
        before = power.copy()
        delay, stderr = np.zeros(na), np.full(na, np.inf)
        last = theta
        for _ in range(ITERATIONS):
            rate = np.gradient(self.columns @ last, self.excerpt.dt, axis=0)
            extra = np.zeros((n, na, na))
            for j in range(na):
                extra[:, j, j] = -rate[:, j]
            residual, power, both = self._solve(self.columns, extra, delay, power)
            step = both[-na:]
            last = both[:-na]
            stderr = self._errors(extra, residual, power)
            delay = np.clip(delay + step, -MAX_DELAY_S, MAX_DELAY_S)
            if np.all(np.abs(step) < 0.1 * stderr):
                break
        _, power, _ = self._solve(self.columns, np.zeros((n, na, 0)), delay, power)
        judged = self.used.any(axis=0) & np.isfinite(stderr) & (stderr > 0) & (np.abs(delay) < 0.99 * MAX_DELAY_S)
        removed = 1 - power / np.maximum(before, 1e-300)
        return ForceDelay(delay, np.where(judged, stderr, np.inf), removed, power, judged)

    def residual_with_lags(self, lags: np.ndarray) -> np.ndarray:
        """Return the residual power (na,) where each joint's columns pass a first-order lag near the given one [s]."""
        best = np.full(len(lags), np.inf)
        for factor in (0.8, 1.0, 1.25, 1.6):
            columns = np.stack(
                [_lagged(self.columns[:, j], factor * lags[j], self.excerpt.dt) for j in range(len(lags))], axis=1
            )
            _, power, _ = self._solve(columns, np.zeros((*self.used.shape, 0)), np.zeros(len(lags)), None)
            if np.sum(np.log(power[lags > 0])) < np.sum(np.log(best[lags > 0])):
                best = power
        return best

    def _solve(
        self, columns: np.ndarray, extra: np.ndarray, delay: np.ndarray, power: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (n, na), their robust power (na,) and the weighted least-squares solution for shifted forces."""
        whole = np.concatenate([columns, extra], axis=2)
        force = _shifted(self.excerpt, delay)
        weight = np.ones(len(delay)) if power is None else power**-0.5
        residual = np.zeros_like(force)
        solution = np.zeros(whole.shape[2])
        for _ in range(2 if power is None else 1):
            rows, target = [], []
            for j in range(len(delay)):
                mask = self.used[:, j]
                rows.append(weight[j] * whole[mask, j])
                target.append(weight[j] * force[mask, j])
            W, y = np.concatenate(rows), np.concatenate(target)
            gram = W.T @ W
            gram[np.diag_indices_from(gram)] *= 1 + 1e-12
            solution = np.linalg.lstsq(gram, W.T @ y, rcond=1e-13)[0]
            residual = np.where(self.used, force - whole @ solution, 0.0)
            power = np.array([max(_power(residual[self.used[:, j], j]), 1e-30) for j in range(len(delay))])
            weight = power**-0.5
        assert power is not None
        return residual, power, solution

    def _errors(self, extra: np.ndarray, residual: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Return standard errors of the delays (na,), robust to correlation within blocks."""
        na, m = extra.shape[2], self.columns.shape[2]
        weight = power**-0.5
        W = np.concatenate([weight[j] * self.columns[self.used[:, j], j] for j in range(na)])
        D = np.concatenate([weight[j] * extra[self.used[:, j], j] for j in range(na)])
        r = np.concatenate([weight[j] * residual[self.used[:, j], j] for j in range(na)])
        block = np.concatenate([self.blocks[self.used[:, j]] for j in range(na)])
        D = D - W @ np.linalg.lstsq(W.T @ W + 1e-12 * np.eye(m), W.T @ D, rcond=1e-13)[0]
        gram = D.T @ D
        scores = np.zeros((block.max() + 1, na))
        np.add.at(scores, block, D * r[:, None])
        inverse = np.linalg.pinv(gram)
        variance = np.diag(inverse @ (scores.T @ scores) @ inverse)
        return np.sqrt(np.maximum(variance, np.diag(inverse)))


def _power(r: np.ndarray) -> float:
    """Return the mean square of residuals within four robust standard deviations, 0 without any."""
    if not r.size:
        return 0.0
    limit = 4 * 1.4826 * float(np.median(np.abs(r)))
    return float(np.mean(np.minimum(r**2, limit**2))) if limit > 0 else float(np.mean(r**2))


def _shifted(excerpt: Excerpt, delay: np.ndarray) -> np.ndarray:
    """Return the forces (n, na) that were logged `delay` later, by the Fourier shift theorem; ends are masked anyway."""
    if not delay.any():
        return excerpt.tau
    line = np.linspace(0, 1, len(excerpt.tau))[:, None]
    trend = excerpt.tau[:1] + (excerpt.tau[-1:] - excerpt.tau[:1]) * line
    omega = 2 * np.pi * np.fft.rfftfreq(2 * len(excerpt.tau), excerpt.dt)
    slope = (excerpt.tau[-1] - excerpt.tau[0]) / max((len(excerpt.tau) - 1) * excerpt.dt, 1e-300)
    odd = np.concatenate([excerpt.tau - trend, -(excerpt.tau - trend)[::-1]])
    moved = np.fft.irfft(np.fft.rfft(odd, axis=0) * np.exp(1j * omega[:, None] * delay), len(odd), axis=0)
    return moved[: len(trend)] + trend + slope * delay


def _lagged(columns: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Return columns (n, p) through `1 / (1 + lag s)`."""
    if lag <= 0:
        return columns
    n = len(columns)
    trend = columns[:1] + (columns[-1:] - columns[:1]) * np.linspace(0, 1, n)[:, None]
    omega = 2 * np.pi * np.fft.rfftfreq(2 * n, dt)
    odd = np.concatenate([columns - trend, -(columns - trend)[::-1]])
    passed = np.fft.irfft(np.fft.rfft(odd, axis=0) / (1 + 1j * omega[:, None] * lag), 2 * n, axis=0)[:n]
    return passed + trend - lag * (columns[-1:] - columns[:1]) / max((n - 1) * dt, 1e-300)


def _say(robot: Robot, name: str, found: ForceDelay, late: np.ndarray, gain: float, dt: float) -> CodedWarning:
    """Return the warning of a delay or a lag: of all joints the mean, else the largest."""
    chosen: Sequence[int] = np.flatnonzero(late).tolist()
    weight = found.stderr_s[late] ** -2.0
    mean = float(weight @ found.delay_s[late] / weight.sum())
    of = ", ".join(robot.actuated[k] for k in chosen)
    size = (
        f"{1e3 * abs(mean):.3g} ms ({abs(mean) / dt:.2g} samples, standard error {1e3 * weight.sum() ** -0.5:.1g} ms)"
    )
    removed = (
        f"taking that into account removes {100 * float(np.max(found.removed[late])):.0f} % of the residual's power"
    )
    if mean > 0 and gain > LAG_GAIN_NATS:
        words = (
            f"{name}: the force of {of} is low-passed: a first-order lag of about {size} explains it better than a delay; "
            f"{removed}. Log the drive's force before its filter, or low-pass the positions alike"
        )
        return CodedWarning("force_lowpassed", words + ".")
    alike = " (a first-order lag of as much would look the same)" if mean > 0 and gain > -LAG_GAIN_NATS else ""
    direction = "late" if mean > 0 else "early"
    words = (
        f"{name}: the force of {of} is {direction} by {size}{alike}; {removed}. Give all channels one clock: shift tau by "
        "that time before use, and look where the logger takes its values"
    )
    return CodedWarning("force_late", words + ".")
