r"""Proof, not only belief, that numbers are solutions: a Newton-Kantorovich ball with all rounding errors counted.

In the chart where the largest homogeneous coordinate is 1, seven quadrics `F` in seven unknowns are left, and with an
approximate inverse `Y` of the Jacobian

    |Y F(z)| <= a,   |1 - Y F'(z)| <= b,   |Y (F'(z + u) - F'(z))| <= c |u|   (largest entries),

`z -> z - Y F(z)` maps the ball of radius `r` into itself and contracts it if `a + b r + c r^2 / 2 <= r` and `b + c r <
1`. Exactly one solution then lies in it, and it is regular. Balls are complex, so the solution in a real centre's ball
is real: its conjugate would be a second one. Floating-point sums are bounded by the usual `gamma_n` (Higham 2002, ch.
3), several times over. Reference: Rump 2010, Acta Numerica 19, section 13; Breiding, Rose & Timme 2023, ACM TOMS
49(1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_GAMMA = 200 * np.finfo(float).eps
"""Relative rounding error of any sum of ours with fewer than 70 complex products, coefficients included."""


class Certificate(NamedTuple):
    """What is proven about points (n, 8).

    Attributes:
        z: Points with their largest coordinate 1.
        radius: One solution lies within this distance in each coordinate (n, 8); inf where nothing is proven.
        relative: The same relative to the larger of `e` and that of `h` (n,).
        pose: The quaternion is not null, so the solution is a pose (n,).
        real: The solution is real (n,).
        complex: The solution is not real (n,).
    """

    z: np.ndarray
    radius: np.ndarray
    relative: np.ndarray
    pose: np.ndarray
    real: np.ndarray
    complex: np.ndarray

    def take(self, index: np.ndarray) -> Certificate:
        """Return those of some points."""
        return Certificate(*(values[index] for values in self))


def certify(Q: np.ndarray, size: np.ndarray, x: np.ndarray) -> Certificate:
    """Try to prove that each of the points is near one true solution.

    Args:
        Q: Seven real quadrics (7, 8, 8).
        size: Bounds on the terms summed up in them (7, 8, 8), `magnitudes`.
        x: Polished points (n, 8).
    """
    chart = np.argmax(np.abs(x), axis=1)
    z = x / np.take_along_axis(x, chart[:, None], 1)
    z[np.arange(len(z)), chart] = 1.0  # exactly
    scale = _scales(z)
    relative, _ = _balls(Q, size, z / scale, chart, scale)
    _, reach = _balls(Q, size, z.real / scale + 0j, chart, scale)
    proven, imaginary = np.isfinite(relative), np.abs(z.imag / scale).max(axis=1)
    radius = relative[:, None] * scale
    with np.errstate(invalid="ignore"):
        real = proven & (imaginary + relative <= reach)
        e, r = z[:, :4], radius[:, :4]
        open_ = (2 * r * np.abs(e) + r**2 + _GAMMA * np.abs(e) ** 2).sum(axis=1)
        pose = proven & (np.abs((e * e).sum(axis=1)) > open_)
    return Certificate(z, radius, relative, pose, real, proven & (imaginary > relative))


def select_distinct_balls(z: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return which balls (n, 8), (n, 8) hold a solution that no earlier ball holds, as homogeneous points.

    `z_i w_j - z_j w_i` vanishes where `z` and `w` are one point; it is compared with what the balls leave open.
    """
    i, j = np.triu_indices(8, 1)
    size = np.abs(z) + radius
    out = np.ones(len(z), dtype=bool)
    for k in range(1, len(z)):
        minors = np.abs(z[k, i] * z[:k, j] - z[k, j] * z[:k, i])
        open_ = (
            radius[k, i] * size[:k, j]
            + radius[k, j] * size[:k, i]
            + radius[:k, j] * size[k, i]
            + radius[:k, i] * size[k, j]
        )
        rounding = _GAMMA * (size[k, i] * size[:k, j] + size[k, j] * size[:k, i])
        out[k] = (minors > open_ + rounding).any(axis=1).all()
    return out


def _scales(z: np.ndarray) -> np.ndarray:
    """Return units (n, 8) for `e` and for `h`: powers of two, so that scaling by them rounds nothing."""
    largest = [np.abs(part).max(axis=1, keepdims=True) for part in (z[:, :4], z[:, 4:])]
    units = [2.0 ** np.ceil(np.log2(np.maximum(part, 1e-12))) for part in largest]
    return np.repeat(np.concatenate(units, axis=1), 4, axis=1)


def _balls(
    Q: np.ndarray, size: np.ndarray, z: np.ndarray, chart: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest proven radius (n,) about points in units `scale`; inf and 0 where there is none."""
    free = np.array([[j for j in range(8) if j != k] for k in range(8)])[chart]  # unknowns of each chart
    units = scale[:, None, :, None] * scale[:, None, None, :]
    Q, size = Q * units, size * units
    V, bound = np.einsum("nkij,nj->nki", Q, z), np.einsum("nkij,nj->nki", size, np.abs(z))
    F, F_error = np.einsum("nki,ni->nk", V, z), _GAMMA * np.einsum("nki,ni->nk", bound, np.abs(z))
    J, J_error = 2 * _columns(V, free), 2 * _GAMMA * _columns(bound, free)
    curved = 2 * _columns((np.abs(Q) + _GAMMA * size).sum(axis=3), free).sum(axis=2)
    with np.errstate(all="ignore"):
        Y = _inverses(J)
        Y_size = np.abs(Y)
        a = _largest(Y_size @ (np.abs(F) + F_error)[..., None])
        b = _largest(np.abs(np.eye(7) - Y @ J) + _GAMMA * Y_size @ np.abs(J) + Y_size @ J_error)
        c = _largest(Y_size @ curved[..., None])
        root = np.sqrt((1 - b) ** 2 - 2 * a * c)
        smallest, largest = 2 * a / (1 - b + root), 0.999 * (1 - b) / c
        smallest = 1.001 * smallest + 1e-300
        good = (b < 0.5) & (root > 0) & (smallest < largest)
        good &= (a + b * smallest + 0.5 * c * smallest**2 <= smallest) & (
            a + b * largest + 0.5 * c * largest**2 <= largest
        )
    return np.where(good, smallest, np.inf), np.where(good, largest, 0.0)


def _columns(matrices: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the columns (n, 7, 7) of the unknowns of matrices (n, 7, 8)."""
    return np.take_along_axis(matrices, free[:, None], 2)


def _largest(matrices: np.ndarray) -> np.ndarray:
    """Return the largest sum of a row (n,), rounded up."""
    return (1 + _GAMMA) * matrices.sum(axis=2).max(axis=1)


def _inverses(J: np.ndarray) -> np.ndarray:
    """Return approximate inverses; zero where there is none, which proves nothing."""
    Y = np.zeros_like(J)
    for k, matrix in enumerate(J):
        try:
            Y[k] = np.linalg.inv(matrix)
        except np.linalg.LinAlgError:
            continue
    return Y
