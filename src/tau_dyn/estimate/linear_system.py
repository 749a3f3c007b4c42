"""Linear least squares about one state, factored once for every damping, with blind directions left alone and bounds kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

RANK_TOLERANCE = 1e-12  # of the largest singular value: directions below it are blind
MIN_SHARE = 1e-6  # of a blind direction that makes a parameter undetermined


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """`columns @ step = residuals` in least squares, factored once for every damping.

    Attributes:
        scales: Unit of each unknown (p,); damping weighs steps in these units.
        q: Orthonormal basis (rows, p) of the columns, None where nobody asked for it.
        u: Its turn to singular vectors (p, p).
        values: Singular values of the scaled columns (p,), largest first.
        v: Directions of the scaled unknowns (p, p), in columns.
        target: The residuals along each (p,).
        tolerance: Of the largest singular value, below which a direction is blind.
    """

    scales: np.ndarray
    q: np.ndarray
    u: np.ndarray
    values: np.ndarray
    v: np.ndarray
    target: np.ndarray
    tolerance: float

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step (p,) and the rms change of the residuals that it predicts."""
        s = self.values[: self.rank]
        along = s / (s**2 + damping) * self.target[: self.rank]
        size = float(np.linalg.norm(s * along)) / max(len(self.q), 1) ** 0.5
        return self.scales * (self.v[:, : self.rank] @ along), size

    @property
    def rank(self) -> int:
        """Number of directions that the columns tell."""
        return int(np.sum(self.values > self.tolerance * self.values.max(initial=0.0)))

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the step (p, p) for residuals of unit noise; nothing along blind directions."""
        root = self.scales[:, None] * self.v[:, : self.rank] / self.values[: self.rank]
        return root @ root.T

    @property
    def leverage(self) -> np.ndarray:
        """Diagonal of the hat matrix (rows,)."""
        return np.sum((self.q @ self.u[:, : self.rank]) ** 2, axis=1)

    @property
    def undetermined(self) -> np.ndarray:
        """Which unknowns have a part in a blind direction (p,)."""
        return np.any(np.abs(self.v[:, self.rank :]) > MIN_SHARE, axis=1)


def factor_system(
    columns: np.ndarray, residuals: np.ndarray, scales: np.ndarray, tolerance: float = RANK_TOLERANCE
) -> LinearSystem:
    """Factor a linear least-squares problem.

    Args:
        columns: What a unit of each unknown explains (rows, p).
        residuals: What is to be explained (rows,).
        scales: Unit of each unknown (p,).
        tolerance: Of the largest singular value, below which a direction is blind.
    """
    q, triangle = np.linalg.qr(columns * scales)
    u, values, vt = np.linalg.svd(triangle, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(vt) - len(values))])
    target = np.concatenate([u.T @ (q.T @ residuals), np.zeros(len(vt) - u.shape[1])])
    return LinearSystem(scales, q, u, values, vt.T, target, tolerance)


@dataclass(frozen=True, eq=False)
class BoundedSystem:
    """A linear system whose unknowns may not leave their bounds: those that press against one are held."""

    rows: np.ndarray
    target: np.ndarray
    scales: np.ndarray
    at_lower: np.ndarray
    at_upper: np.ndarray
    tolerance: float

    def held(self) -> np.ndarray:
        """Return which unknowns (f,) stand at a bound and press outwards."""
        slope = self.rows.T @ self.target
        return (self.at_lower & (slope <= 0)) | (self.at_upper & (slope >= 0))

    @cached_property
    def free(self) -> LinearSystem:
        """The system of the others."""
        return self._without(self.held())

    def _without(self, held: np.ndarray) -> LinearSystem:
        return factor_system(self.rows[:, ~held], self.target, self.scales[~held], self.tolerance)

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return a step (f,) and the change that it predicts relative to the residuals."""
        held, system, step = self.held(), self.free, np.zeros(len(self.scales))
        while True:
            step[~held], size = system.step(damping)
            outwards = ~held & ((self.at_lower & (step < 0)) | (self.at_upper & (step > 0)))
            if not outwards.any():
                return step, size / max(float(np.sqrt(np.mean(self.target**2))), 1e-300)
            held, step = held | outwards, np.zeros(len(self.scales))
            system = self._without(held)
