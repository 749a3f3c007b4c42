r"""The noise of an equation of motion whose accelerations come from noisy positions, and its exact whitening.

With force noise `e` and position noise `n`, the equation `tau = M(q) a + h` at the log's own rate errs by

    r = e - D n,   D = M(q_k) S,   S the second difference over five samples (-1, 16, -30, 16, -1) / (12 dt^2),
    Sigma = sigma_f^2 I + D sigma_q^2 D',

a banded matrix, so that its Cholesky factor costs as much as a filter. `Sigma^-1` weighs each frequency by
`1 / (sigma_f^2 + sigma_q^2 M^2 w^4)`: forces count below the frequency at which encoder noise outweighs them, and nothing has to
be low-passed. Equations left out are rows without neighbours, so nothing leaks out of them.

The information about parameters with columns Y is `Y' Sigma^-1 Y`; true positions are nuisance parameters, and eliminating
them (Woodbury) gives exactly this matrix. Reference: Soderstrom 2018, Errors-in-Variables Methods in System Identification.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.linalg import lapack

STENCIL = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12.0
REACH = len(STENCIL) // 2
"""Samples on either side that an acceleration needs."""


def compute_accelerations(q: np.ndarray, dt: float) -> np.ndarray:
    """Return second derivatives (n, ...) of positions, fourth order in `dt`; zero at the outermost two samples."""
    out = np.zeros_like(q)
    for shift, c in enumerate(STENCIL):
        out[REACH:-REACH] += c * q[shift : len(q) - 2 * REACH + shift]
    return out / dt**2


@dataclass(frozen=True, eq=False)
class PositionNoise:
    """The covariance of one stretch's equations; `build_position_noise` factors it.

    Attributes:
        inertia: Mass matrices (n, m, m).
        keep: Which equations count (n, m); never the outermost two samples.
        dt: Time between samples [s].
        force: Standard deviation of the force noise, of each joint (m,) or of each equation (n, m).
        position: Standard deviation of the position noise of each joint (m,).
        factor: Lower banded Cholesky factor of `Sigma` (5 m, n m), rows ordered sample by sample.
    """

    inertia: np.ndarray
    keep: np.ndarray
    dt: float
    force: np.ndarray
    position: np.ndarray
    factor: np.ndarray

    def of_positions(self, n: np.ndarray) -> np.ndarray:
        """Return `D n` (n, m) for positions (n, m), zero where an equation is left out."""
        return self.keep * np.einsum("kij,kj->ki", self.inertia, compute_accelerations(n, self.dt))

    def to_positions(self, r: np.ndarray) -> np.ndarray:
        """Return `D' r` (n, m) for equations (n, m)."""
        pushed = np.einsum("kji,kj->ki", self.inertia, self.keep * r)
        out = np.zeros_like(pushed)
        for shift, c in enumerate(STENCIL):
            out[shift : len(r) - 2 * REACH + shift] += c * pushed[REACH:-REACH]
        return out / self.dt**2

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Return `L^-1 x` for equations (n, m, ...), `Sigma = L L'`; zero where an equation is left out."""
        return self._solved(x, "N")

    def solve(self, x: np.ndarray) -> np.ndarray:
        """Return `Sigma^-1 x` for equations (n, m, ...); zero where an equation is left out."""
        return self._solved(self.whiten(x), "T")

    def _solved(self, x: np.ndarray, trans: str) -> np.ndarray:
        n, m = self.keep.shape
        kept = self.keep.reshape(n, m, *(1,) * (x.ndim - 2))
        rhs = np.asfortranarray((kept * x).reshape(n * m, -1))
        solution, _ = lapack.dtbtrs(self.factor, rhs, uplo="L", trans=trans)
        return np.ascontiguousarray(kept * solution.reshape(x.shape))  # sums of products are ten times slower otherwise


def build_position_noise(
    inertia: np.ndarray, keep: np.ndarray, dt: float, force: np.ndarray, position: np.ndarray
) -> PositionNoise:
    """Return the covariance of one stretch's equations, factored; arguments as in `PositionNoise`."""
    n, m = keep.shape
    lags = 2 * REACH
    autocorrelation = np.correlate(STENCIL, STENCIL, "full")[lags:] / dt**4
    counted = np.ascontiguousarray((inertia * keep[:, :, None]).transpose(1, 2, 0))  # samples last: sums run along them
    noisy = counted * np.square(position)[:, None]
    band = np.zeros(((lags + 1) * m, n * m))
    for lag in range(lags + 1):
        for i in range(m):  # row (k + lag, i), column (k, l)
            for column in range(m):
                below = lag * m + i - column
                if below >= 0:
                    block = (counted[i, :, lag:] * noisy[column, :, : n - lag]).sum(axis=0)
                    band[below, column : (n - lag) * m : m] = autocorrelation[lag] * block
    variance = np.broadcast_to(np.asarray(force) ** 2, keep.shape)
    band[0] += np.where(keep, variance, 1.0).ravel()
    factor = np.asarray(linalg.cholesky_banded(band, lower=True))
    return PositionNoise(inertia, keep, dt, force, position, factor)
