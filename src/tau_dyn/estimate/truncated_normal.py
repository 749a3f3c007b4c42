r"""Draws from a normal distribution restricted to a convex set: bounds, and matrices that must be positive definite.

    z ~ N(0, 1)   subject to   a_i + b_i' z >= 0   and   J_k(z) = J_k0 + sum_j z_j J_kj > 0

Exact Hamiltonian Monte Carlo: between walls a path is `z cos s + w sin s`, on which `|z|^2 + |w|^2` is constant; at a wall the
velocity is reflected, so every path is accepted. The wall of a matrix is the set with a smallest eigenvalue of zero; with the
eigenvector `u` its normal is `u' J_kj u`. Many chains run in parallel and each gives one draw, so that draws are independent;
their correlation with their start is measured over the chains. Reference: Pakman & Paninski 2014.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.results import Brief

_STEP = 0.15
"""Angle between checks of the walls [rad]; a path that leaves the set and returns between two checks was outside by 0.003 of its
length."""
_PATH = (0.8, 2.4)  # length of a path [rad], around the quarter turn that makes a free one independent
_MAX_LOOKS = 400
"""Largest number of checks and reflections of a path; a longer path is rejected and its chain stays (detailed balance)."""
_BISECTIONS = 22  # of the angle of a hit, to 4e-8 rad
_MIN_CHAINS = 200
"""Least number of chains, to measure their autocorrelation."""
_MAX_CHAINS = 1000  # in parallel; more draws are later states of the same chains
_FIRST_PATHS = 4  # paths before the chains' autocorrelation is measured over as many more
_MAX_PATHS = 128  # 32 times as many as the first check takes; chains still correlated with their start are reported
_MAX_MEMORY = 0.2
"""Correlation of any coordinate over the chains, between half of their paths and all of them; by chance it reaches 0.12."""
_MAX_DRIFT = 4.5
"""Difference of a coordinate's mean between the same two times in standard errors: one in 10^5 by chance."""


_UPPER = np.triu_indices(4)  # entries that make a symmetric matrix
_EACH = len(_UPPER[0])


@dataclass(frozen=True, eq=False)
class ConvexSet(Brief):
    """Set in which `a + B z >= 0` and every matrix `J0_k + sum_j z_j J_kj` is positive definite.

    Attributes:
        a: Constants of the bounds (n,).
        B: Their gradients (n, d).
        J0: Matrices at zero (m, 4, 4).
        J: Their derivatives (d, m, 4, 4).
    """

    a: np.ndarray
    B: np.ndarray
    J0: np.ndarray
    J: np.ndarray

    @property
    def constants(self) -> np.ndarray:
        """Values at zero (w,): the bounds, then entry by entry the matrices' upper triangles."""
        return np.concatenate([self.a, self.J0[:, *_UPPER].T.ravel()])

    @property
    def gradients(self) -> np.ndarray:
        """Their derivatives (d, w)."""
        d = self.B.shape[1]
        return np.concatenate([self.B.T, np.moveaxis(self.J[:, :, *_UPPER], 2, 1).reshape(d, -1)], axis=1)

    def contains(self, z: np.ndarray) -> np.ndarray:
        """Return which of the points (N, d) are inside (N,)."""
        return np.asarray(~self.find_crossed(self.constants + z @ self.gradients).any(axis=1))

    def find_crossed(self, values: np.ndarray) -> np.ndarray:
        """Return which bounds and matrices fail (N, n + m) at values (N, w)."""
        n = len(self.a)
        entries = values[:, n:].reshape(len(values), _EACH, -1)
        return np.concatenate([values[:, :n] < 0, _is_indefinite(np.moveaxis(entries, 1, 0))], axis=1)

    def compute_normals(self, walls: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the inward normals (N, d) of matrices' walls (N,) at their entries (N, 10) just beyond them."""
        matrices = np.zeros((len(values), 4, 4))
        matrices[:, _UPPER[1], _UPPER[0]] = values  # the lower triangle, which is what `eigh` reads
        u = np.linalg.eigh(matrices)[1][:, :, 0]
        outer = u[:, _UPPER[0]] * u[:, _UPPER[1]] * np.where(_UPPER[0] == _UPPER[1], 1.0, 2.0)
        found = np.zeros((len(values), self.B.shape[1]))
        for k in np.unique(walls):
            found[walls == k] = outer[walls == k] @ self.J[:, k, *_UPPER].T
        return found


def _is_indefinite(entries: np.ndarray) -> np.ndarray:
    """Return where symmetric matrices of ten entries (10, ..) have a pivot that is not positive (Sylvester)."""
    a, b, c, d, e, f, g, h, i, j = entries
    with np.errstate(all="ignore"):  # values after a pivot of zero do not count
        x, y, z = b / a, c / a, d / a
        e, f, g, h, i, j = e - x * b, f - x * c, g - x * d, h - y * c, i - y * d, j - z * d
        x, y = f / e, g / e
        h, i, j = h - x * f, i - x * g, j - y * g
        return ~((a > 0) & (e > 0) & (h > 0) & (j - i / h * i > 0))


class TruncatedDraws(NamedTuple):
    """Draws (N, d), the largest autocorrelation of a coordinate, and whether the chains have converged."""

    z: np.ndarray
    memory: float
    converged: bool


def sample_truncated_normal(inside: ConvexSet, start: np.ndarray, n: int, rng: np.random.Generator) -> TruncatedDraws:
    """Draw from the standard normal distribution in a convex set.

    Args:
        inside: The set.
        start: A point inside (d,).
        n: Number of draws.
        rng: Random numbers.
    """
    if inside.contains(np.zeros((1, len(start))))[0]:  # if nearly all plain draws are inside, they are the result
        z = rng.standard_normal((max(n, _MIN_CHAINS), len(start)))
        kept = z[inside.contains(z)]
        while len(kept) > 0.2 * len(z) and len(kept) < n:
            z = rng.standard_normal((max(n, _MIN_CHAINS), len(start)))
            kept = np.concatenate([kept, z[inside.contains(z)]])
        if len(kept) >= n:
            return TruncatedDraws(kept[:n], 0.0, True)
    chains = min(max(n, _MIN_CHAINS), _MAX_CHAINS)
    z = np.tile(start, (chains, 1))
    paths, memory, drift = _FIRST_PATHS, 1.0, np.inf
    z = _follow_paths(inside, z, rng, paths)
    while (memory >= _MAX_MEMORY or drift >= _MAX_DRIFT) and paths < _MAX_PATHS:
        half, z = z, _follow_paths(inside, z, rng, paths)
        (memory, drift), paths = _compare(half, z), 2 * paths
    found = [z]
    while len(found) * chains < n:
        found.append(_follow_paths(inside, found[-1], rng, paths // 2))
    return TruncatedDraws(np.concatenate(found)[:n], memory, memory < _MAX_MEMORY and drift < _MAX_DRIFT)


def _compare(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return the largest correlation of a coordinate over the chains, and the largest drift of a mean in standard errors."""
    scale = after.std(axis=0)
    x, y = before - before.mean(axis=0), after - after.mean(axis=0)
    spread = np.maximum(before.std(axis=0) * scale, 1e-300)
    memory = float(np.max(np.abs((x * y).mean(axis=0)) / spread)) if before.std() > 0 else 1.0
    stderr = np.sqrt((before.var(axis=0) + scale**2) / len(after))
    drift = float(np.max(np.abs(after.mean(axis=0) - before.mean(axis=0)) / np.maximum(stderr, 1e-300)))
    return memory, drift


def _follow_paths(inside: ConvexSet, z: np.ndarray, rng: np.random.Generator, n: int) -> np.ndarray:
    """Return the position of each chain (N, d) after n paths."""
    for _ in range(n):
        z = _follow(inside, z, rng)
    return z


def _follow(inside: ConvexSet, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the position of each chain (N, d) after one path of a random length."""
    constants, gradients = inside.constants, inside.gradients
    begun, z, w = z, z.copy(), rng.standard_normal(z.shape)
    at, speed = z @ gradients, w @ gradients
    left = np.full(len(z), rng.uniform(*_PATH))
    for _ in range(_MAX_LOOKS):
        todo = np.flatnonzero(left > 0)
        if not len(todo):
            break
        step = np.minimum(left[todo], _STEP)
        crossed = inside.find_crossed(_turn(at[todo], speed[todo], step[:, None], constants))
        hit = crossed.any(axis=1)
        rows = todo[hit]
        step[hit], normal = _find_hits(inside, crossed[hit], at[rows], speed[rows], step[hit])
        for x, y in ((z, w), (at, speed)):
            c, s = np.cos(step)[:, None], np.sin(step)[:, None]
            x[todo], y[todo] = c * x[todo] + s * y[todo], c * y[todo] - s * x[todo]
        left[todo] -= step
        into = np.sum(w[rows] * normal, axis=1)
        size = np.maximum(np.sum(normal**2, axis=1), 1e-300)
        w[rows] -= np.where(into < 0, 2 * into / size, 0.0)[:, None] * normal
        speed[rows] = w[rows] @ gradients
    back = (left > 0) | ~inside.contains(z)  # too many reflections, or rounding on a wall
    z[back] = begun[back]
    return z


def _turn(at: np.ndarray, speed: np.ndarray, angle: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Return the walls' values (N, w) at angles (N, 1) of the paths."""
    return constants + np.cos(angle) * at + np.sin(angle) * speed


def _find_hits(
    inside: ConvexSet, crossed: np.ndarray, at: np.ndarray, speed: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the angle (N,) just before each path's first wall, and the wall's normal there (N, d), by bisection."""
    n, m, constants = len(inside.a), len(inside.J0), inside.constants
    first, normals = np.full(len(step), np.inf), np.zeros((len(step), inside.B.shape[1]))
    for matrices in (False, True):
        rows, wall = np.nonzero(crossed[:, n:] if matrices else crossed[:, :n])
        if not len(rows):
            continue
        place = n + wall[:, None] + m * np.arange(_EACH) if matrices else wall[:, None]
        x, y, zero = at[rows[:, None], place].T, speed[rows[:, None], place].T, constants[place].T
        low, high = np.zeros(len(rows)), step[rows].copy()
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            values = _turn(x, y, middle, zero)
            outside = _is_indefinite(values) if matrices else values[0] < 0
            low, high = np.where(outside, low, middle), np.where(outside, middle, high)
        order = np.argsort(-low, kind="stable")  # of several walls of a path the first one is written last
        order = order[low[order] < first[rows[order]]]
        first[rows[order]] = low[order]
        beyond = _turn(x, y, high, zero).T[order]
        normals[rows[order]] = inside.compute_normals(wall[order], beyond) if matrices else inside.B[wall[order]]
    return first, normals
