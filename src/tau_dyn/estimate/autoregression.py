r"""Coloured noise as an autoregressive process, fitted to a residual that comes in stretches and pieces.

    e_t = sum_k phi_k e_{t-k} + u_t

by least squares on each sample and its own past (for early samples of a stretch, the available past), the order by Akaike's
criterion. Rows are kept as triangular factors, so that the number of samples is not limited. Reference: Ljung 1999, 10.1 and
16.4.

`PositionNoise` is the noise of an equation of motion with accelerations from noisy positions, and its exact whitening.

With force noise `e` and position noise `n`, the equation `tau = M(q) a + h` at the log's own rate errs by

    r = e - D n,   D = M(q_k) S,   S the second difference over five samples (-1, 16, -30, 16, -1) / (12 dt^2),
    Sigma = sigma_f^2 I + D sigma_q^2 D',

a banded matrix, so that its Cholesky factor takes the time of a filter. `Sigma^-1` weighs each frequency by
`1 / (sigma_f^2 + sigma_q^2 M^2 w^4)`: forces count below the frequency at which encoder noise outweighs them, and no signal has
to be low-passed. Equations left out are rows without neighbours, so they do not affect other rows.

The information about parameters with columns Y is `Y' Sigma^-1 Y`; true positions are nuisance parameters, and eliminating
them (Woodbury) gives exactly this matrix. Reference: Soderstrom 2018, Errors-in-Variables Methods in System Identification.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, signal
from scipy.linalg import lapack

MAX_ORDER = 12  # from which the order is selected by an information criterion


@dataclass(frozen=True, eq=False)
class Autoregression:
    """`e_t = sum_k phi_k e_{t-k} + u_t`; `phi` (order,), `variance` that of the process itself."""

    phi: np.ndarray
    variance: float

    @property
    def denominator(self) -> np.ndarray:
        """Coefficients `1, -phi_1, ..` (order + 1,) of the filter whose reciprocal makes it of white noise."""
        return np.concatenate([[1.0], -self.phi])

    def response_power(self) -> float:
        """Return the sum of squares of its impulse response."""
        state = -self.denominator[1:]  # after an impulse, whose first output is 1
        return float(1.0 + state @ self.fading_gramian() @ state)

    def fading_gramian(self) -> np.ndarray:
        """Return `P` (p, p): `z' P z` is the remaining sum of squares of `1 / denominator` from its state z (p,).

        The state is that of the transposed direct form II, as `scipy.signal.lfilter` returns it; `P = A' P A + c c'`.
        """
        p = len(self.phi)
        if not p:
            return np.zeros((0, 0))
        step = np.eye(p, k=1)
        step[:, 0] -= self.denominator[1:]
        first = np.zeros((p, p))
        first[0, 0] = 1.0
        return np.asarray(linalg.solve_discrete_lyapunov(step.T, first))

    def autocovariance(self, n: int) -> np.ndarray:
        """Return the autocovariance at lags 0 .. n - 1 (n,)."""
        p = len(self.phi)
        if p == 0:
            return np.concatenate([[self.variance], np.zeros(n - 1)])
        h = self._impulse_response(max(n, 4096))  # long enough for its slowest pole (roots are within 0.999)
        covariance = signal.fftconvolve(h, h[::-1])[len(h) - 1 :][:n]
        return covariance * (self.variance / covariance[0])

    def _impulse_response(self, n: int) -> np.ndarray:
        impulse = np.zeros(n)
        impulse[0] = 1.0
        return np.asarray(signal.lfilter([1.0], self.denominator, impulse))


def fit_autoregression(stretches: list[np.ndarray], max_order: int = MAX_ORDER) -> Autoregression:
    """Fit an autoregressive model to unbroken stretches (n_i,) of a residual by least squares, its order by AIC."""
    lags = Lags(max_order)
    for stretch in stretches:
        lags.begin()
        lags.add(stretch)
    return lags.model()


class Lags:
    """Products of a residual with its own past, summed for every order, while stretches come in pieces."""

    def __init__(self, max_order: int = MAX_ORDER) -> None:
        """Start with no samples."""
        self.max_order = max_order
        self._whole = _Triangle(max_order + 1)  # samples with all of their past
        self._early = [_Triangle(k + 1) for k in range(max_order)]  # the k-th sample of a stretch
        self._squares, self._count = 0.0, 0
        self._before = np.zeros(0)

    @property
    def seen(self) -> bool:
        """Whether there were any samples."""
        return self._count > 0

    def begin(self) -> None:
        """Begin a new stretch, which does not continue the last one."""
        self._before = np.zeros(0)

    def add(self, piece: np.ndarray) -> None:
        """Add the next samples (n,) of the stretch."""
        self._squares += float(np.sum(piece**2))
        self._count += len(piece)
        x, width = np.concatenate([self._before, piece]), self.max_order + 1
        for k in range(len(self._before), min(self.max_order, len(x))):
            self._early[k].add(x[k::-1][None] if k else x[:1][None])
        if len(x) >= width:
            first = max(0, len(self._before) - self.max_order)
            self._whole.add(np.lib.stride_tricks.sliding_window_view(x, width)[first:, ::-1])
        self._before = x[-self.max_order :]

    def model(self) -> Autoregression:
        """Return the model of all added samples."""
        variance = self._squares / self._count
        best, best_aic = np.zeros(0), self._count * np.log(max(variance, 1e-300))
        factors = {part: part.R for part in (self._whole, *self._early[1:])}
        for order in range(1, self.max_order + 1):
            parts = [self._whole, *self._early[order:]]
            n = sum(part.count for part in parts)
            if n < 10 * self.max_order:
                break
            rows = np.concatenate([factors[part][:, : order + 1] for part in parts])
            phi = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
            innovation = float(np.sum((rows[:, 0] - rows[:, 1:] @ phi) ** 2)) / n
            aic = self._count * np.log(max(innovation, 1e-300)) + 2 * order
            if aic < best_aic:
                best, best_aic = phi, aic
        return Autoregression(_stable(best), variance)


class _Triangle:
    """Rows of k numbers, kept as their triangular factor once there are many."""

    def __init__(self, k: int) -> None:
        self.count, self._size, self._rows = 0, 0, [np.zeros((0, k))]

    def add(self, rows: np.ndarray) -> None:
        """Add rows (n, k)."""
        self.count += len(rows)
        self._size += len(rows)
        self._rows.append(rows)
        if self._size > 8192:
            self._rows, self._size = [self.R], 0

    @property
    def R(self) -> np.ndarray:
        """The rows' triangular factor."""
        return np.asarray(np.linalg.qr(np.concatenate(self._rows), mode="r"))


def _stable(phi: np.ndarray) -> np.ndarray:
    """Pull poles outside 0.999 back onto that circle."""
    if phi.size == 0:
        return phi
    poles = np.roots(np.concatenate([[1.0], -phi]))
    size = np.abs(poles)
    if np.all(size < 0.999):
        return phi
    return -np.real(np.poly(np.where(size < 0.999, poles, poles / np.maximum(size, 1e-12) * 0.999)))[1:]


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
