r"""A sampled linear model in innovation form, and what it says.

    x_{k+1} = A x_k + B u_{k-d} + K e_k,   y_k = C x_k + D u_{k-d} + e_k

`d` whole samples of delay act on every input before the model sees it. Matrix entries depend on the choice of states; poles,
Markov parameters and responses do not, and only they are to be compared. Reference: Ljung 1999, System Identification, 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.modes.record import Scales


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A sampled linear model.

    Attributes:
        A: (n, n).
        B: (n, m).
        C: (p, n).
        D: (p, m).
        K: Gain of the innovations (n, p); zeros for an output-error model.
        dt: Sampling step [s].
        delay: Whole samples by which the inputs act late.
        noise: Covariance of the innovations (p, p), or of the output noise; None where it is not known.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    K: np.ndarray
    dt: float
    delay: int = 0
    noise: np.ndarray | None = None

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane (n,)."""
        return np.linalg.eigvals(self.A)

    def spectral_radius(self) -> float:
        """Return the largest magnitude of a pole; below 1 the model is stable."""
        return float(np.abs(self.poles()).max(initial=0.0))

    def in_coordinates(self, T: np.ndarray) -> StateSpace:
        """Return the same model with states x' = T^-1 x, for a square T (n, n)."""
        solve = np.linalg.solve
        return replace(self, A=solve(T, self.A @ T), B=solve(T, self.B), C=self.C @ T, K=solve(T, self.K))

    def unscaled(self, scales: Scales) -> StateSpace:
        """Return the model in the records' own units, given that of records divided by their scales."""
        u, y = scales.u, scales.y
        noise = None if self.noise is None else self.noise * np.outer(y, y)
        D = y[:, None] * self.D / u
        return replace(self, B=self.B / u, C=y[:, None] * self.C, D=D, K=self.K / y, noise=noise)

    def scaled(self, scales: Scales) -> StateSpace:
        """Return the model of records divided by their scales."""
        return self.unscaled(Scales(1 / scales.u, 1 / scales.y))

    def markov(self, n: int) -> np.ndarray:
        """Return the first `n` samples of the impulse response (n, p, m), without the delay: D, C B, C A B, ..."""
        out = np.empty((n, *self.D.shape))
        out[0], state = self.D, self.B
        for k in range(1, n):
            out[k], state = self.C @ state, self.A @ state
        return out

    def frequency_response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F, p, m) from inputs to outputs at frequencies (F,) [Hz]."""
        z = np.exp(2j * np.pi * np.asarray(frequency) * self.dt)
        eye = np.eye(self.order)
        solved = np.linalg.solve(z[:, None, None] * eye - self.A, np.broadcast_to(self.B, (len(z), *self.B.shape)))
        return (self.C @ solved + self.D) * (z**-self.delay)[:, None, None]
