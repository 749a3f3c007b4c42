r"""A mass-damper-spring structure, `M q'' + D q' + K q = f`, in continuous time and sampled under held inputs.

Reference: thesis (6.14), which is printed uninverted: the response is `X(s) = (M s^2 + D s + K)^{-1} B U(s)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from tau_dyn.exceptions import InputError
from tau_dyn.modes.state_space import StateSpace

OUTPUTS = ("displacement", "velocity", "acceleration")
"""What a sensor may measure; the place in the list is the order of its time derivative."""


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """A structure of n degrees of freedom, in units of force and displacement.

    Attributes:
        M: Inertia (n, n).
        D: Damping (n, n).
        K: Stiffness (n, n).
    """

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray

    def compliance(self, s: np.ndarray) -> np.ndarray:
        """Return `(M s^2 + D s + K)^{-1}` (F, n, n) at complex frequencies s (F,) [rad/s]."""
        s = np.asarray(s)[:, None, None]
        return np.linalg.inv(self.M * s**2 + self.D * s + self.K)

    def system_matrix(self) -> np.ndarray:
        """Return the matrix (2n, 2n) of the states (q, q')."""
        n = len(self.M)
        below = -np.linalg.solve(self.M, np.hstack([self.K, self.D]))
        return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), below])

    def poles(self) -> np.ndarray:
        """Return the 2n poles [rad/s], slowest first."""
        poles = np.linalg.eigvals(self.system_matrix())
        return poles[np.argsort(np.abs(poles), kind="stable")]

    def sampled(
        self, dt: float, driven: Sequence[int], sensed: Sequence[int], output: str = "displacement"
    ) -> StateSpace:
        """Return the structure as a sampled model whose inputs are held over each step; exact.

        Args:
            dt: Sampling step [s].
            driven: Degree of freedom that each input pushes.
            sensed: Degree of freedom that each output watches.
            output: One of `OUTPUTS`.
        """
        n, m = len(self.M), len(driven)
        A, force = self.system_matrix(), np.linalg.solve(self.M, np.eye(n)[:, list(driven)])
        step = expm(dt * np.block([[A, np.vstack([np.zeros((n, m)), force])], [np.zeros((m, 2 * n + m))]]))
        rows = np.vstack([np.eye(2 * n), A[n:]])[count_derivatives(output) * n :][list(sensed)]
        through = force[list(sensed)] if output == "acceleration" else np.zeros((len(sensed), m))
        gain = np.zeros((2 * n, len(sensed)))
        return StateSpace(step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :], rows, through, gain, dt)


def count_derivatives(output: str) -> int:
    """Return how often an output is differentiated: 0, 1 or 2.

    Raises:
        InputError: It is not one of `OUTPUTS`.
    """
    if output not in OUTPUTS:
        raise InputError("invalid_value", f"output '{output}' is not known; it is one of {', '.join(OUTPUTS)}")
    return OUTPUTS.index(output)


def build_symmetric_basis(n: int) -> np.ndarray:
    """Return the symmetric matrices (n(n+1)/2, n, n) with ones at one place of the upper triangle and its mirror."""
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[range(len(rows)), rows, columns] = 1.0
    basis[range(len(rows)), columns, rows] = 1.0
    return basis


def pack(structure: SecondOrder) -> np.ndarray:
    """Return the upper triangles of M, D and K as one vector (3n(n+1)/2,)."""
    upper = np.triu_indices(len(structure.M))
    return np.concatenate([structure.M[upper], structure.D[upper], structure.K[upper]])


def unpack(x: np.ndarray, n: int) -> SecondOrder:
    """Return the structure whose upper triangles are `x`."""
    M, D, K = np.tensordot(x.reshape(3, -1), build_symmetric_basis(n), axes=1)
    return SecondOrder(M, D, K)
