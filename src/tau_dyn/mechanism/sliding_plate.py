r"""Forward kinematics of a plate that only translates: trilateration, with Gauss-Newton where there are more than three rods.

Of the two points in which three spheres meet the one on home's side of the centres' plane is taken, always: the sides are
apart, and the way from one to the other leads through the plane, where the plate is singular. Blocks of samples stay in
the processor's cache.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from tau_dyn.mechanism import chains, rod_dimensions
from tau_dyn.mechanism.kinematics_result import NOT_A_NUMBER, OK, OUT_OF_REACH, SINGULAR
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.plate_arrays import solve_with_lapack
from tau_dyn.mechanism.poses import Poses
from tau_dyn.mechanism.trilateration import find_side, intersect_spheres

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
            position[part], code[part] = self._block(np.ascontiguousarray(q[part].T), _part(start, part))
        return Poses(position, np.broadcast_to(self.rods.rotation, (len(q), 3, 3))), code

    def both(self, q: np.ndarray) -> np.ndarray:
        """Return both solutions (N, 2, 3) [m], home's side first; nan where the spheres do not meet."""
        centres = self._centres(np.ascontiguousarray(q.T))[self.three]
        lengths = self._lengths(q.T)[self.three]
        return np.stack(
            [intersect_spheres(centres, lengths, side).position.T for side in (self.side, -self.side)], axis=1
        )

    def _block(self, q: np.ndarray, start: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        centres, lengths = self._centres(q), self._lengths(q)
        chosen, radii = (centres, lengths) if self.rods.n == 3 else (centres[self.three], lengths[self.three])
        side = self.side if start is None else find_side(chosen, start)
        found = intersect_spheres(chosen, radii, side)
        position, height = found.position, found.height
        code = np.zeros(q.shape[1], np.int8)
        if not np.all(height > _FLAT):
            with np.errstate(invalid="ignore"):
                code = np.where(height >= 0, SINGULAR, OUT_OF_REACH)
                code = np.where(height > _FLAT, OK, code)
                code = np.where(np.isfinite(q).all(axis=0), code, NOT_A_NUMBER)
            position[:, code != OK] = np.nan
        if self.rods.n > 3:
            position = self._refined(centres, lengths, position)
            gap = np.linalg.norm(centres - position, axis=1) - lengths
            code = np.where((code == OK) & ~(np.abs(gap).max(axis=0) < _AGREE), OUT_OF_REACH, code)
        return position.T, code

    def _refined(self, centres: np.ndarray, lengths: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the positions (3, N) that suit all rods best."""
        for _ in range(3):
            d = centres - position
            f = 0.5 * (np.einsum("kin,kin->kn", d, d) - lengths**2)
            position = position + solve_with_lapack(d.transpose(2, 0, 1), f)
        return position

    def _centres(self, q: np.ndarray) -> np.ndarray:
        """Return the spheres' centres `A - R b` (n, 3, N) [m]."""
        points = chains.compute_points(self.numbers.joints, self.numbers.carried, q)
        return points - self._shift[:, :, None] if self._shift.any() else points

    def _lengths(self, q: np.ndarray) -> np.ndarray:
        return rod_dimensions.compute_leg_lengths(self.numbers, q)

    def _best_three(self, centres: np.ndarray, position: np.ndarray) -> list[int]:
        d = (centres - position)[:, :, 0]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        return list(max(combinations(range(len(d)), 3), key=lambda three: abs(np.linalg.det(d[list(three)]))))


def _part(start: Poses | None, part: slice) -> np.ndarray | None:
    if start is None:
        return None
    position = start.position
    return (position if len(position) == 1 else position[part]).T
