"""The linear model of a whole robot on an excerpt with all parameters free: delays of its forces, zeros of its joints.

There is no prior: wrong masses must not look like a delay. Gauss-Newton finds delays, or zeros, together with the parameters.
A delay `d` adds `-d * d(model force)/dt` to its joint's force; a zero adds the slope of the rigid bodies' force by the position.
Standard errors are robust to residuals that are correlated in time (cluster-robust, Liang & Zeger 1986, blocks of a second).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.identify.integrity.excerpt import Excerpt, compute_clipped_power
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.robot import Robot

MAX_DELAY_S = 0.1
"""Longer delays are not searched [s]: a motion reverses in the meantime."""

BLOCK_S = 1.0
"""Length of the blocks within which residuals may be correlated [s]: longer than the memory of friction and cables."""

ITERATIONS = 6
"""Gauss-Newton converges in four steps for delays below a quarter of the motion's shortest period."""

ZERO_PRIOR = 0.3
"""Standard deviation of a joint's zero before the data [rad, m]."""


class ForceDelay(NamedTuple):
    """Delays of the forces.

    Attributes:
        delay_s: Delay of each joint's force (na,) [s].
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


class FreeFit:
    """The linear model of all joints on an excerpt, whose forces may be shifted in time."""

    def __init__(
        self, excerpt: Excerpt, columns: np.ndarray, used: np.ndarray, rigid: np.ndarray, zeros: np.ndarray
    ) -> None:
        """Take columns (n, na, p) of independent directions, the rigid bodies' share of each (r, p), and the zeros (na,)."""
        self.excerpt, self.columns, self.used, self.rigid, self.zeros = excerpt, columns, used, rigid, zeros
        self.blocks = (np.arange(len(used)) * excerpt.dt / BLOCK_S).astype(int)

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt, zeros: np.ndarray | float = 0.0) -> FreeFit | None:
        """Return the fitter at positions plus zeros (na,); None if the robot cannot move there, or no sample is left."""
        v, a = excerpt.v, excerpt.a
        try:
            rigid = build_mechanism(robot).regressor(excerpt.q + zeros, v, a)
        except (InputError, LoopClosureError, np.linalg.LinAlgError):
            return None
        na = robot.na
        used = excerpt.used & (excerpt.used.sum(axis=0) > 100)
        if not used.any() or not np.all(np.isfinite(rigid)):
            return None
        drives = np.zeros((len(v), na, 5 * na))
        for j in range(na):
            forward = v[:, j] > 0
            terms = (forward, ~forward, v[:, j] * forward, v[:, j] * ~forward, a[:, j])
            drives[:, j, 5 * j : 5 * j + 5] = np.column_stack(terms)
        columns = np.concatenate([rigid, drives], axis=2)
        flat = columns[used]
        size = np.linalg.norm(flat, axis=0)
        kept = size > 1e-9 * size.max()
        columns = columns[:, :, kept] / size[kept]
        _, singular, right = np.linalg.svd(np.linalg.qr(columns[used], mode="r"))
        basis = right[singular > 1e-6 * singular[0]].T
        whole = np.zeros((len(kept), basis.shape[1]))
        whole[kept] = basis / size[kept, None]
        return cls(excerpt, columns @ basis, used, whole[: rigid.shape[2]], np.zeros(na) + zeros)

    def with_zeros(self, robot: Robot) -> FreeFit:
        """Return the fitter at the zeros of the joints that fit best without delays, by Gauss-Newton.

        It is this fitter where the robot cannot move at other zeros, or where they do not lower the residual.
        """
        na = self.used.shape[1]
        best = self
        residual, power, solution = self._solve_without_delay()
        mechanism = build_mechanism(robot)
        for _ in range(ITERATIONS):
            try:
                slopes = best._slopes(mechanism, solution)
            except (InputError, LoopClosureError, np.linalg.LinAlgError):
                break
            free, r = best._freed(slopes, residual, power)
            prior = np.eye(na) / ZERO_PRIOR**2
            step = np.linalg.solve(free.T @ free + prior, free.T @ r - prior @ best.zeros)
            tried = FreeFit.of(robot, self.excerpt, best.zeros + step)
            if tried is None:
                break
            at = tried._solve_without_delay()
            if not np.sum(np.log(at[1])) < np.sum(np.log(power)) - 1e-3:
                break
            best, (residual, power, solution) = tried, at
        return best

    def _slopes(self, mechanism: Mechanism, solution: np.ndarray) -> np.ndarray:
        """Return the slope of the rigid bodies' force by each joint's zero (n, na, na)."""
        excerpt, theta, zeros = self.excerpt, self.rigid @ solution, self.zeros
        found = np.zeros((*self.used.shape, len(zeros)))
        for j in range(len(zeros)):
            move = np.where(np.arange(len(zeros)) == j, 1e-4, 0.0)
            up, down = (
                mechanism.regressor(excerpt.q + zeros + sign * move, excerpt.v, excerpt.a) @ theta for sign in (1, -1)
            )
            found[:, :, j] = (up - down) / 2e-4
        return found

    def _solve_without_delay(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        na = self.used.shape[1]
        return self._solve(self.columns, np.zeros((*self.used.shape, 0)), np.zeros(na), None)

    def delays(self) -> ForceDelay:
        """Return the delays of all joints, by Gauss-Newton together with the parameters."""
        na, n = self.used.shape[1], len(self.used)
        delay, stderr = np.zeros(na), np.full(na, np.inf)
        _, before, last = self._solve(self.columns, np.zeros((n, na, 0)), delay, None)
        power = before
        for _ in range(ITERATIONS):
            rate = np.gradient(self.columns @ last, self.excerpt.dt, axis=0)
            extra = -rate[:, :, None] * np.eye(na)
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
            columns = self.columns.copy()
            for j in np.flatnonzero(lags > 0):
                lag = factor * lags[j]
                columns[:, j] = _passed(columns[:, j], self.excerpt.dt, lambda w, s=lag: 1 / (1 + 1j * w * s), -lag)
            _, power, _ = self._solve(columns, np.zeros((*self.used.shape, 0)), np.zeros(len(lags)), None)
            if np.sum(np.log(power[lags > 0])) < np.sum(np.log(best[lags > 0])):
                best = power
        return best

    def _solve(
        self, columns: np.ndarray, extra: np.ndarray, delay: np.ndarray, power: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (n, na), their robust power (na,) and the weighted least-squares solution for shifted forces."""
        whole = np.concatenate([columns, extra], axis=2)
        force = self.excerpt.tau
        if delay.any():
            force = _passed(force, self.excerpt.dt, lambda omega: np.exp(1j * omega * delay), delay)
        weight = np.ones(len(delay)) if power is None else power**-0.5
        residual = np.zeros_like(force)
        solution = np.zeros(whole.shape[2])
        for _ in range(2 if power is None else 1):
            W, y = self._weighted(whole, weight), self._weighted(force, weight)
            gram = W.T @ W
            gram[np.diag_indices_from(gram)] *= 1 + 1e-12
            solution = np.linalg.lstsq(gram, W.T @ y, rcond=1e-13)[0]
            residual = np.where(self.used, force - whole @ solution, 0.0)
            power = np.array(
                [max(compute_clipped_power(residual[self.used[:, j], j], 4.0), 1e-30) for j in range(len(delay))]
            )
            weight = power**-0.5
        assert power is not None
        return residual, power, solution

    def _weighted(self, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the used rows of an array (n, na, ...), joint by joint, each times its weight."""
        return np.concatenate([weight[j] * x[self.used[:, j], j] for j in range(len(weight))])

    def _errors(self, extra: np.ndarray, residual: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Return standard errors of the delays (na,), robust to correlation within blocks."""
        na = extra.shape[2]
        D, r = self._freed(extra, residual, power)
        block = np.concatenate([self.blocks[self.used[:, j]] for j in range(na)])
        gram = D.T @ D
        scores = np.zeros((block.max() + 1, na))
        np.add.at(scores, block, D * r[:, None])
        inverse = np.linalg.pinv(gram)
        variance = np.diag(inverse @ (scores.T @ scores) @ inverse)
        return np.sqrt(np.maximum(0.0, np.maximum(variance, np.diag(inverse))))  # zero for a joint without information

    def _freed(self, extra: np.ndarray, residual: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted extra columns without their part in the model's columns, and the weighted residual."""
        W, D, r = (self._weighted(x, power**-0.5) for x in (self.columns, extra, residual))
        inside = np.linalg.lstsq(W.T @ W + 1e-12 * np.eye(W.shape[1]), W.T @ D, rcond=1e-13)[0]
        return D - W @ inside, r


def _passed(
    x: np.ndarray, dt: float, response: Callable[[np.ndarray], np.ndarray], lead_s: np.ndarray | float
) -> np.ndarray:
    """Return signals (n, p) through a frequency response of w (k, 1) [rad/s] that moves a straight line `lead_s` forward.

    The signals minus a line from end to end are continued as odd functions, so that they do not jump at their ends.
    """
    n = len(x)
    rise = x[-1:] - x[:1]
    trend = x[:1] + rise * np.linspace(0, 1, n)[:, None]
    odd = np.concatenate([x - trend, -(x - trend)[::-1]])
    omega = 2 * np.pi * np.fft.rfftfreq(2 * n, dt)[:, None]
    passed = np.fft.irfft(np.fft.rfft(odd, axis=0) * response(omega), 2 * n, axis=0)[:n]
    return passed + trend + rise / max((n - 1) * dt, 1e-300) * lead_s
