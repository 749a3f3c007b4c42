r"""A free plate on its rods, for many samples at once; arrays have components first and samples last.

With `r_k = R b_k`, `d_k = A_k - T - r_k` the rods close where `f_k = (|d_k|^2 - L_k^2) / 2 = 0`. A small displacement
`(x, w)` of the plate, linear and angular in world axes, changes `f` by `-(d_k . x + (r_k x d_k) . w)`, so a Newton step
on SE(3) solves

    [d_k, r_k x d_k] (x, w) = f,   T <- T + x,   R <- Exp(w) R.

No angles are involved, hence no singular orientations. Six rods are solved by an elimination planned once
(`elimination.py`), others and those it is not good enough for by LAPACK. Reference: thesis (4.14), (4.33); Merlet 2006,
ch. 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.elimination import Elimination, Factor
from tau_dyn.mechanism.pseudo_inverse import solve_with_lapack
from tau_dyn.mechanism.rotations import rotate_by_vector
from tau_dyn.mechanism.tree_arrays import combine_rotated, compute_cross_product

_TRUSTED = 1e-10  # relative residual of a solution by LU; worse ones are solved again by SVD


class Plate(NamedTuple):
    """Poses of the plate: positions (3, N) [m] and rotations (3, 3, N)."""

    position: np.ndarray
    rotation: np.ndarray

    def take(self, index: np.ndarray | slice) -> Plate:
        """Return some of the samples."""
        return Plate(self.position[:, index], self.rotation[:, :, index])

    def moved(self, twist: np.ndarray) -> Plate:
        """Return the poses after small displacements (6, N)."""
        return Plate(self.position + twist[:3], rotate_by_vector(twist[3:], self.rotation))


class Rows(NamedTuple):
    """The rods at a pose: `d` and `r x d`, each n times (3, N), and `f`, n times (N,)."""

    d: list[np.ndarray]
    moment: list[np.ndarray]
    f: list[np.ndarray]


def compute_equation_rows(points: np.ndarray, on_plate: np.ndarray, squares: np.ndarray, plate: Plate) -> Rows:
    """Return the rods' equations.

    Args:
        points: A (n, 3, N) [m].
        on_plate: B in the plate's frame (n, 3) [m].
        squares: Squared lengths (n, N or 1) [m^2].
        plate: Poses.
    """
    d, moment, f = [], [], []
    for k in range(len(on_plate)):
        r = combine_rotated(plate.rotation, on_plate[k])
        rod = points[k] - plate.position
        rod -= r
        d.append(rod)
        moment.append(compute_cross_product(r, rod))
        f.append(_half_square(rod, squares[k]))
    return Rows(d, moment, f)


def compute_residual(points: np.ndarray, on_plate: np.ndarray, squares: np.ndarray, plate: Plate) -> np.ndarray:
    """Return `f` (n, N) [m^2] alone."""
    out = np.empty((len(on_plate), plate.position.shape[1]))
    for k in range(len(on_plate)):
        rod = points[k] - plate.position
        rod -= combine_rotated(plate.rotation, on_plate[k])
        out[k] = _half_square(rod, squares[k])
    return out


def _half_square(rod: np.ndarray, square: np.ndarray) -> np.ndarray:
    total = rod[0] * rod[0]
    total += rod[1] * rod[1]
    total += rod[2] * rod[2]
    total -= square
    total *= 0.5
    return total


def build_dense(at: Rows) -> np.ndarray:
    """Return the matrices `[d, r x d]` (N, n, 6)."""
    return np.concatenate([np.stack(at.d), np.stack(at.moment)], axis=1).transpose(2, 0, 1)


class SixRods:
    """Solves `[d, r x d] x = b` of six rods by an elimination that suits the home pose."""

    def __init__(self, reference: np.ndarray) -> None:
        """Plan at a reference matrix (6, 6)."""
        pattern = {(k, c) for k in range(6) for c in range(6)}
        self._plan = Elimination.plan(pattern, reference) if np.linalg.cond(reference) < 1e8 else None

    def factor(self, at: Rows) -> Factor | None:
        """Return the factors, or None where there is no plan."""
        if self._plan is None:
            return None
        entries = {(k, c): (at.d[k][c] if c < 3 else at.moment[k][c - 3]) for k in range(6) for c in range(6)}
        return self._plan.factor(entries)

    def solve(self, at: Rows, b: np.ndarray, factor: Factor | None = None) -> np.ndarray:
        """Return the twists (6, N) for right sides (6, N); a sample that elimination spoils goes to LAPACK."""
        factor = self.factor(at) if factor is None else factor
        if factor is None:
            return solve_with_lapack(build_dense(at), b)
        x = factor.solve(b)
        bad = ~(np.abs(x).max(axis=0) < np.inf)
        if bad.any():
            part = np.flatnonzero(bad)
            x[:, part] = solve_with_lapack(build_dense(take_samples(at, part)), b[:, part])
        return x

    def accurate(self, at: Rows, b: np.ndarray) -> np.ndarray:
        """Return the twists (6, ..., N), each sample checked for what elimination left."""
        factor = self.factor(at)
        if factor is None:
            return solve_with_lapack(build_dense(at), b)
        x = factor.solve(b)
        bad = np.flatnonzero(~(factor.residual(x, b) < _TRUSTED))
        if bad.size:
            x[..., bad] = solve_with_lapack(build_dense(take_samples(at, bad)), b[..., bad])
        return x


def take_samples(at: Rows, index: np.ndarray) -> Rows:
    """Return some of the samples."""
    return Rows([x[:, index] for x in at.d], [x[:, index] for x in at.moment], [x[index] for x in at.f])
