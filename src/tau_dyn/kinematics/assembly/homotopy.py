"""Homotopy continuation of the solutions of seven quadrics: Taylor series as predictor, Newton's method as corrector.

The path `x(t)` of `x' Q(t) x = 0` has a power series whose terms are all computed with one inverse Jacobian, since `Q` is
quadratic in `t`. The last terms give the distance to the next branch point, so the step is known in advance and a jump to a
neighbouring path is rare (Telen, Van Barel & Verschelde 2020, SIAM J. Sci. Comput. 42, A3610). All paths are followed together,
each with its own step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.kinematics.assembly.equations import Hexapod, build_quadrics

_ORDER = 12  # of the power series of a path step (Telen, Van Barel & Verschelde 2020)
_MIN_REMAINING_PATH = 1e-13
"""A path that is not finished this near to the end, ends in a singular point."""
_NULL, _SMALLEST_NULL = 1e-2, 1e-11
"""The same if the quaternion is nearly null, `|e . e| < _NULL |e|^2`: such an end is no pose, and slow to reach."""
_NEWTON = 1e-3
"""A first correction above this share of the point means that the prediction is unreliable."""
_NOISE = 1e-9
"""Corrections below this count as converged."""


class HomotopyPaths(NamedTuple):
    """Ends of the paths.

    Attributes:
        x: Points (n, 8) of norm one.
        t: Parameter that each path reached (n,); 1 if the end is regular.
    """

    x: np.ndarray
    t: np.ndarray

    @property
    def regular(self) -> np.ndarray:
        """Which paths came to an end with a regular Jacobian (n,)."""
        return self.t == 1.0


def track_homotopy(
    start: Hexapod, end: Hexapod, x: np.ndarray, *, tolerance: float = 1e-5, max_steps: int = 600
) -> HomotopyPaths:
    """Follow solutions (n, 8) of one hexapod to those of another along the straight line between their numbers.

    Args:
        start: Hexapod with the solutions `x`.
        end: Hexapod at the end of the paths.
        x: Solutions at `start`.
        tolerance: Largest error predicted by the last terms of the series, as a share of the point.
        max_steps: Steps after which unfinished paths are abandoned.
    """
    moving = _Moving.between(start, end)
    x, t, shrink = x / np.linalg.norm(x, axis=1, keepdims=True), np.zeros(len(x)), np.ones(len(x))
    active = np.arange(len(x))
    for _ in range(max_steps):
        if not len(active):
            break
        terms = moving.series(x[active], t[active])
        h = shrink[active] * _step(terms, tolerance)
        last = h >= 1 - t[active]
        h = np.where(last, 1 - t[active], h)
        there = np.where(last, 1.0, t[active] + h)
        ahead, good = moving.correct(_sum(terms, h), there)
        moved = active[good]
        x[moved], t[moved] = ahead[good], there[good]
        shrink[active] = np.where(good, np.minimum(1.0, 2 * shrink[active]), 0.5 * shrink[active])
        stuck = ~good & (h < _MIN_REMAINING_PATH)
        active = active[
            (1 - t[active] > np.where(is_nearly_null(x[active]), _SMALLEST_NULL, _MIN_REMAINING_PATH)) & ~stuck
        ]
    return HomotopyPaths(x, t)


def is_nearly_null(x: np.ndarray) -> np.ndarray:
    """Return at which points (n, 8) of norm one the quaternion is close to null or zero, its pose close to infinity (n,)."""
    e = x[:, :4]
    size = (np.abs(e) ** 2).sum(axis=1)
    return (np.abs((e * e).sum(axis=1)) < _NULL * size) | (size < _NULL**2)


class _Moving(NamedTuple):
    """Coefficients of `Q(t) = c0 + c1 t + c2 t^2` as one matrix (8, 7 * 24); a point times it is `c0 x, c1 x, c2 x`."""

    stacked: np.ndarray

    @classmethod
    def between(cls, start: Hexapod, end: Hexapod) -> _Moving:
        """Interpolate the quadratic polynomial in `t` at three places."""
        q0, q1, half = build_quadrics(start), build_quadrics(end), build_quadrics(start.towards(end, 0.5))
        c2 = 2 * (q0 + q1) - 4 * half
        coefficients = np.stack([q0, q1 - q0 - c2, c2], axis=1).astype(complex)  # (7, 3, 8, 8)
        return cls(np.ascontiguousarray(np.moveaxis(coefficients, -1, 0).reshape(8, -1)))

    def products(self, x: np.ndarray) -> np.ndarray:
        """Return `c0 x, c1 x, c2 x` (n, 7, 24) for points (n, 8)."""
        return (x @ self.stacked).reshape(-1, 7, 24)

    def inverse(self, products: np.ndarray, x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `Q x` (n, 7, 8) and the inverse Jacobian's columns (n, 8, 7), on the plane through `x` normal to it."""
        c0, c1, c2 = (products[:, :, k : k + 8] for k in (0, 8, 16))
        t = t[:, None, None]
        Qx = c0 + t * (c1 + t * c2)
        return Qx, _inverse(np.concatenate([2 * Qx, x.conj()[:, None]], axis=1))[:, :, :7]

    def series(self, x: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the path's power series (order + 1, n, 8) about `t`.

        Order k of `x' Q(t + s) x` in `s` is the sum over a of `c0 x_a, c1 x_a, c2 x_a` times the terms k - a of `x`,
        `(t + s) x` and `(t + s)^2 x`. The former are kept in order, the latter in reverse, so each sum is one product.
        """
        n, last = len(x), 24 * _ORDER
        X = np.zeros((_ORDER + 1, n, 8), complex)
        products, factors = np.zeros((n, 7, last + 24), complex), np.zeros((n, last + 24), complex)
        X[0], products[:, :, :24] = x, self.products(x)
        _, inverse = self.inverse(products[:, :, :24], x, t)
        t = t[:, None]
        for k in range(_ORDER + 1):
            block = factors[:, last - 24 * k : last - 24 * k + 24]
            if k > 0:  # terms that do not depend on the new one
                block[:, 8:16] = X[k - 1]
                block[:, 16:] = 2 * t * X[k - 1] + (X[k - 2] if k > 1 else 0)
                known = products[:, :, : 24 * (k + 1)] @ factors[:, last - 24 * k :, None]
                X[k] = -(inverse @ known)[..., 0]
                products[:, :, 24 * k : 24 * k + 24] = self.products(X[k])
            block[:, :8] = X[k]
            block[:, 8:16] += t * X[k]
            block[:, 16:] += t**2 * X[k]
        return X

    def correct(self, x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points after three Newton steps, and which of them converged at the rate of Newton's method."""
        sizes, inverse = [], np.zeros(0)
        for _ in range(3):
            x = x / np.linalg.norm(x, axis=1, keepdims=True)
            Qx, inverse = self.inverse(self.products(x), x, t)
            change = (inverse @ (Qx @ x[..., None]))[..., 0]
            x = x - change
            sizes.append(np.linalg.norm(change, axis=1))
        first, second, third = sizes
        with np.errstate(invalid="ignore"):
            noise = _NOISE + 1e-15 * np.linalg.norm(inverse, axis=(1, 2))  # rounding errors near a singular point
            good = (first < _NEWTON) & (second < np.maximum(0.1 * first, noise)) & (third < noise)
        return x / np.linalg.norm(x, axis=1, keepdims=True), good


def _inverse(J: np.ndarray) -> np.ndarray:
    """Return inverses; those of singular matrices are nan, which stops their paths."""
    try:
        return np.linalg.inv(J)
    except np.linalg.LinAlgError:
        inverse = np.full_like(J, np.nan)
        for k, matrix in enumerate(J):
            if np.isfinite(matrix).all() and np.linalg.cond(matrix) < 1e16:
                inverse[k] = np.linalg.inv(matrix)
        return inverse


def _step(terms: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the step (n,) at which the last two terms of the series stay below the tolerance."""
    sizes = np.linalg.norm(terms[-2:], axis=2) + 1e-300
    orders = np.array([_ORDER - 1, _ORDER])[:, None]
    return np.nan_to_num(((tolerance / sizes) ** (1 / orders)).min(axis=0))


def _sum(terms: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the series' value (n, 8) at steps (n,)."""
    x = terms[-1]
    for term in terms[-2::-1]:
        x = term + h[:, None] * x
    return x
