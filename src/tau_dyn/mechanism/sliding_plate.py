"""The closed form of a plate that only translates: three spheres. Samples last.

A plate that keeps its rotation ends each rod at `T + r_k` with constant `r_k`, and `|A_k - r_k - T| = L_k`: three spheres
(thesis (4.9); Coope 2000), with Gauss-Newton if there are more rods. They meet in two points, mirrored in the plane of the
centres; `side` gives the side of it on which the plate is, seen along `(C_2 - C_1) x (C_3 - C_1)`: the thesis' configuration
`c`. Home's side is taken, since the way from one to the other leads through a singularity.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.frames import compute_cross_product
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import NOT_A_NUMBER, OK, OUT_OF_REACH, SINGULAR, Poses
from tau_dyn.mechanism.small_systems import solve_with_lapack


class SphereIntersection(NamedTuple):
    """Where three spheres meet.

    Attributes:
        position: (3, N) [m]; nan where they do not.
        height: Squared height of that point over the centres' plane, by the squared longest radius (N,); below zero where
            the spheres do not meet.
    """

    position: np.ndarray
    height: np.ndarray


def intersect_spheres(centres: np.ndarray, square: np.ndarray, side: float | np.ndarray) -> SphereIntersection:
    """Intersect spheres around centres (3, 3, N) [m] with squared radii (3, N or 1) [m^2], on one side of their plane."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    with np.errstate(all="ignore"):
        inverse = 1.0 / compute_dot_products(normal, normal)
        p = (0.5 * inverse) * (compute_dot_products(u, u) + (square[0] - square[1]))
        r = (0.5 * inverse) * (compute_dot_products(w, w) + (square[0] - square[2]))
        foot = compute_cross_product(w, normal)
        foot *= p
        other = compute_cross_product(normal, u)
        other *= r
        foot += other
        height = square[0] - compute_dot_products(foot, foot)
        normal *= side * np.sqrt(height * inverse)
    foot += normal
    foot += centres[0]
    return SphereIntersection(foot, height / square.max(axis=0))


def find_side(centres: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return on which side (N,) of the plane of three centres (3, 3, N) a point (3, N) is: 1, -1 or 0."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    return np.sign(compute_dot_products(normal, position - centres[0]))


def compute_dot_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of vectors (3, N)."""
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out


BLOCK = 8192  # samples at a time; arrays stay in the processor's cache
_FLAT = 1e-12
"""Squared height over the centres' plane, by the squared longest rod, below which a pose counts as singular."""
_AGREE = 1e-9  # [m] by how much more than three rods may contradict each other


class SlidingPlate:
    """Solves one robot."""

    def __init__(self, rods: Legs) -> None:
        """Choose the three rods that meet best at home, and home's side."""
        self.rods, self.numbers = rods, rods.numbers
        self._shift = rods.on_plate @ rods.rotation.T
        home = self._centres(rods.robot.home[:, None])
        self.three = self._best_three(home, rods.home.position.T)
        self.side = float(find_side(home[self.three], rods.home.position.T)[0])

    def forward(self, q: np.ndarray, start: Poses | None = None) -> tuple[Poses, np.ndarray]:
        """Return the plate's poses and codes at `q` (N, na); a start chooses the side of its own position."""
        position = np.empty((len(q), 3))
        code = np.zeros(len(q), np.int8)
        for first in range(0, len(q), BLOCK):
            part = slice(first, first + BLOCK)
            found, code[part] = self.solve(np.ascontiguousarray(q[part].T), _part(start, part))
            position[part] = found.T
        return Poses(position, np.broadcast_to(self.rods.rotation, (len(q), 3, 3))), code

    def both(self, q: np.ndarray) -> np.ndarray:
        """Return both solutions (N, 2, 3) [m], home's side first; nan where the spheres do not meet."""
        centres = self._centres(np.ascontiguousarray(q.T))[self.three]
        squares = rod_dimensions.compute_squared_lengths(self.numbers, q.T)[self.three]
        return np.stack(
            [intersect_spheres(centres, squares, side).position.T for side in (self.side, -self.side)], axis=1
        )

    def solve(self, q: np.ndarray, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the plate's positions (3, N) [m] and codes at `q` (na, N), on the side of a start (3, N), or home's."""
        centres, squares = self._centres(q), rod_dimensions.compute_squared_lengths(self.numbers, q)
        chosen, three = (centres, squares) if self.rods.n == 3 else (centres[self.three], squares[self.three])
        side = self.side if start is None else find_side(chosen, start)
        found = intersect_spheres(chosen, three, side)
        position, height = found.position, found.height
        code = np.zeros(q.shape[1], np.int8)
        if not np.all(height > _FLAT):
            with np.errstate(invalid="ignore"):
                code = np.where(height >= 0, SINGULAR, OUT_OF_REACH)
                code = np.where(height > _FLAT, OK, code)
                code = np.where(np.isfinite(q).all(axis=0), code, NOT_A_NUMBER)
            position[:, code != OK] = np.nan
        if self.rods.n > 3:
            position = self._refined(centres, squares, position)
            gap = np.linalg.norm(centres - position, axis=1) - np.sqrt(squares)
            code = np.where((code == OK) & ~(np.abs(gap).max(axis=0) < _AGREE), OUT_OF_REACH, code)
        return position, code

    def _refined(self, centres: np.ndarray, squares: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the positions (3, N) that suit all rods best."""
        for _ in range(3):
            d = centres - position
            f = 0.5 * (np.einsum("kin,kin->kn", d, d) - squares)
            position = position + solve_with_lapack(d.transpose(2, 0, 1), f)
        return position

    def _centres(self, q: np.ndarray) -> np.ndarray:
        """Return the spheres' centres `A - R b` (n, 3, N) [m]."""
        points = frames.compute_points(self.numbers.joints, self.numbers.carried, q)
        return points - self._shift[:, :, None] if self._shift.any() else points

    def _best_three(self, centres: np.ndarray, position: np.ndarray) -> list[int]:
        d = (centres - position)[:, :, 0]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        return list(max(combinations(range(len(d)), 3), key=lambda three: abs(np.linalg.det(d[list(three)]))))


def _part(start: Poses | None, part: slice) -> np.ndarray | None:
    if start is None:
        return None
    position = start.position
    return (position if len(position) == 1 else position[part]).T
