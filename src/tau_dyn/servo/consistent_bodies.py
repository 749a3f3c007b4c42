"""Physically consistent bodies, for a fit in the few directions that logs inform on.

A positive definite pseudo-inertia `J` belongs to some distribution of mass. The cost of a fit contains its divergence from the
file's,

    minimise over w  c |w|^2 + sum_bodies tr(J J0^-1) - log det(J J0^-1) - 4,   J at nominal + prior (V z + W w),

in addition to the cost of its unknowns z: zero at the file's values, and infinite where a body becomes inconsistent. The
directions w that the logs do not inform on are almost free: two moments of a thin rod are one quantity, whose prior counts
once. The cost is convex in z; gradient and curvature follow from those in (z, w).
Reference: Wensing, Kim & Slotine 2018 (J); Lee, Wensing & Park 2019 (divergence); Boyd & Vandenberghe 2004, 3.2.5 and 9.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.estimate import pseudo_inertia
from tau_dyn.robot import LinkInertia

INNER = 0.9
"""Part of the way to an inconsistent body that one step may go."""
NO_WAY = 1e-6
"""Part of a step below which it counts as zero: the bodies beyond are inconsistent."""
MAX_STEPS = 60
"""Newton steps for w, and steps towards z, at most; five and one are usual."""
GIVING_WAY = 0.01
"""Cost of w per square, in units of its prior's (c)."""
SETTLED = 1e-12
"""Newton decrement from which w is found."""
_LEAST = 1e-9  # eigenvalue of a file's pseudo-inertia, scaled to a diagonal of one, below which the body is degenerate


class Divergence(NamedTuple):
    """Cost of a fit at unknowns z (K,).

    Attributes:
        value: The divergence, with the cost of w.
        gradient: Its slope by z (K,).
        curvature: Its second derivatives (K, K).
        w: Values of w at the minimum (m,).
    """

    value: float
    gradient: np.ndarray
    curvature: np.ndarray
    w: np.ndarray


class ConsistentBodies:
    """Bodies along directions of their inertial numbers.

    Attributes:
        within: Directions W that the logs do not inform on (p, m), a standard deviation of prior knowledge each.
    """

    def __init__(
        self,
        links: Sequence[LinkInertia],
        names: Sequence[str],
        nominal: np.ndarray,
        prior: np.ndarray,
        directions: np.ndarray,
    ) -> None:
        """Prepare; see `InertialSpace`. Bodies that are inconsistent in the file are not constrained."""
        free = prior > 0
        scaled = directions[free] / prior[free, None]
        rest = np.linalg.svd(scaled, full_matrices=True)[0][:, scaled.shape[1] :]
        self.within = np.zeros((len(nominal), rest.shape[1]))
        self.within[free] = prior[free, None] * rest
        self._k, slopes = scaled.shape[1], np.column_stack([directions, self.within])
        place, bodies = {name: k for k, name in enumerate(names)}, []
        for link in links:
            rows = [place[name] for name in link.names]
            J = pseudo_inertia(link.map @ nominal[rows])
            size = np.sqrt(np.maximum(np.diag(J), 0.0))
            if not np.all(size > 0) or np.linalg.eigvalsh(J / np.outer(size, size))[0] < _LEAST:
                continue
            inverse = np.linalg.inv(np.linalg.cholesky(J))
            per_number = np.array([inverse @ pseudo_inertia(column) @ inverse.T for column in link.map.T])
            bodies.append(np.einsum("rk,rab->kab", slopes[rows], per_number))
        self._A = np.array(bodies).reshape(len(bodies), slopes.shape[1], 4, 4)
        self._at = (np.zeros(self._k), np.zeros(rest.shape[1]))  # where the last search ended

    def find(self, z: np.ndarray) -> Divergence | None:
        """Return the divergence at unknowns (K,), or None if a body is inconsistent for every w."""
        for start in (self._at, (np.zeros(self._k), np.zeros(self.within.shape[1]))):
            at, w = start
            for _ in range(MAX_STEPS):
                found = self._minimise(at, w)
                if np.array_equal(at, z):
                    self._at = (at, found[0])
                    return self._eliminate(*found)
                w, derivatives = found[0], found[2]
                step = z - at
                follow = np.linalg.solve(derivatives[self._k :, self._k :], -derivatives[self._k :, : self._k] @ step)
                part = min(1.0, INNER * self._reach(np.append(at, w), np.append(step, follow)))
                if part < NO_WAY:
                    break
                at, w = z if part == 1.0 else at + part * step, w + part * follow
        return None

    def limit(self, z: np.ndarray, step: np.ndarray) -> float:
        """Return the part of a step (K,) from unknowns z that keeps every body consistent, with w following; at most 1."""
        found = self.find(z)
        if found is None:
            return 1.0
        _, _, second = self._differentiate(np.append(z, found.w))
        follow = np.linalg.solve(second[self._k :, self._k :], -second[self._k :, : self._k] @ step)
        return min(1.0, INNER * self._reach(np.append(z, found.w), np.append(step, follow)))

    def _bodies(self, x: np.ndarray) -> np.ndarray:
        return np.eye(4) + np.einsum("bkij,k->bij", self._A, x)

    def _reach(self, x: np.ndarray, step: np.ndarray) -> float:
        """Return the multiple of a step (K + m,) at which the first body becomes inconsistent."""
        inverse = np.linalg.inv(np.linalg.cholesky(self._bodies(x)))
        change = np.einsum("bkij,k->bij", self._A, step)
        least = float(np.linalg.eigvalsh(inverse @ change @ inverse.swapaxes(1, 2)).min(initial=0.0))
        return np.inf if least >= 0 else -1.0 / least

    def _differentiate(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return value, gradient and second derivatives of divergence and |w|^2 by (z, w)."""
        J = self._bodies(x)
        inverse = np.linalg.inv(J)
        w = np.append(np.zeros(self._k), x[self._k :])
        trace = np.einsum("bii->b", J)
        value = float((trace - np.linalg.slogdet(J)[1] - 4).sum() + GIVING_WAY * w @ w)
        moved = np.einsum("bij,bkjl->bkil", inverse, self._A)
        gradient = np.einsum("bkii->k", self._A - moved) + 2 * GIVING_WAY * w
        flat = moved.reshape(len(moved), len(x), 16)
        turned = moved.swapaxes(2, 3).reshape(len(moved), len(x), 16)
        second = (flat @ turned.swapaxes(1, 2)).sum(axis=0)
        second[range(self._k, len(x)), range(self._k, len(x))] += 2.0 * GIVING_WAY
        return value, gradient, second

    def _minimise(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, tuple[float, np.ndarray], np.ndarray]:
        """Return w (m,) of the least divergence at z, from a consistent one; value, gradient, second derivatives."""
        k = self._k
        value, gradient, second = self._differentiate(np.append(z, w))
        for _ in range(MAX_STEPS):
            step = np.linalg.solve(second[k:, k:], -gradient[k:])
            if not -gradient[k:] @ step > SETTLED:
                break
            part = min(1.0, INNER * self._reach(np.append(z, w), np.append(np.zeros(k), step)))
            while True:
                after = self._differentiate(np.append(z, w + part * step))
                if after[0] <= value + 1e-4 * part * (gradient[k:] @ step) or part < 1e-6:
                    break
                part *= 0.5
            w, (value, gradient, second) = w + part * step, after
        return w, (value, gradient), second

    def _eliminate(self, w: np.ndarray, first: tuple[float, np.ndarray], second: np.ndarray) -> Divergence:
        k = self._k
        curvature = second[:k, :k] - second[:k, k:] @ np.linalg.solve(second[k:, k:], second[k:, :k])
        return Divergence(first[0], first[1][:k], curvature, w)
