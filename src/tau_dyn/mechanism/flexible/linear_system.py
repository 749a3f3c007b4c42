"""Linear systems with named inputs and outputs, in continuous time and sampled exactly, and position-controlled drives as such.

    x' = A x + B u(t - T),   y = C x + D u(t - T)

Inputs are held between samples (zero-order hold), each late by its own delay; then sampling is exact, by the matrix exponential.
Sample k of a log is the output at `k dt`, before the input of that instant has acted, unless `D` passes it on at once.
Reference: Astrom & Wittenmark 1997, Computer-Controlled Systems, ch. 2.

The thesis' closed drives, (6.11), are `G_a(q) = q^-d b / (1 - a q^-1)` at 4 ms. Sampling `1 / (T s + 1)` with a held input
gives one step of that `q^-d` by itself, so the pure delay is `d - 1` steps and `T = -dt / ln a`. The robot's motion has no
effect on the drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from tau_dyn.exceptions import InputError, UnknownName


@dataclass(frozen=True)
class PositionDrives:
    """One first-order lag a joint, and a delay.

    Attributes:
        time_constants: Time constant of each joint [s].
        delay: Delay, the same for all joints [s].
    """

    time_constants: tuple[float, ...]
    delay: float = 0.0

    def __post_init__(self) -> None:
        """Refuse lags and delays that no drive has."""
        if not all(0 < t < np.inf for t in self.time_constants) or not 0 <= self.delay < np.inf:
            raise InputError("invalid_value", "a drive's time constant must be positive, its delay not below zero")

    @classmethod
    def from_sampled(cls, poles: Sequence[float], dt: float, samples: int) -> PositionDrives:
        """Return the drives `q^-samples (1 - a) / (1 - a q^-1)` with poles `a` (na,) at a step `dt` [s]."""
        if not all(0 < a < 1 for a in poles) or samples < 1:
            raise InputError(
                "invalid_value", "a sampled lag has its pole between 0 and 1 and at least one sample of delay"
            )
        return cls(tuple(float(-dt / np.log(a)) for a in poles), (samples - 1) * dt)


L1_DRIVES = PositionDrives.from_sampled((0.9647, 0.9656, 0.9728), 0.004, 5)
"""The L1 prototype's, Dressler 2012, (6.11); the printed numerators differ from `1 - a` by up to 1.03 %."""


@dataclass(frozen=True, eq=False)
class ContinuousModel:
    """A linear system in continuous time.

    Attributes:
        A: (n, n) [1/s].
        B: (n, m).
        C: (p, n).
        D: (p, m).
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        delay: Delay of each input (m,) [s].
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    delay: np.ndarray

    @property
    def order(self) -> int:
        """Number of states, delays not counted."""
        return len(self.A)

    def poles(self) -> np.ndarray:
        """Return the poles in the s plane (n,) [rad/s]."""
        return np.linalg.eigvals(self.A)

    def frequency_response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F, p, m) from inputs to outputs at frequencies (F,) [Hz]."""
        s = 2j * np.pi * np.atleast_1d(np.asarray(frequency, float))[:, None, None]
        right = np.broadcast_to(self.B, (len(s), *self.B.shape))
        response = self.C @ np.linalg.solve(s * np.eye(self.order) - self.A, right) + self.D
        return response * np.exp(-s * self.delay)

    def select(self, inputs: Sequence[str], outputs: Sequence[str]) -> ContinuousModel:
        """Return the part between some inputs and some outputs, in this order.

        Raises:
            UnknownName: There is no such input or output.
        """
        cols, rows = _places("input", inputs, self.inputs), _places("output", outputs, self.outputs)
        return ContinuousModel(
            self.A,
            self.B[:, cols],
            self.C[rows],
            self.D[np.ix_(rows, cols)],
            tuple(inputs),
            tuple(outputs),
            self.delay[cols],
        )

    def sampled(self, dt: float) -> SampledModel:
        """Return the system seen at multiples of `dt` [s], inputs held in between; exact.

        Raises:
            InputError: `dt` is not positive, or a delay is not a whole number of steps.
        """
        if not (np.isfinite(dt) and dt > 0):
            raise InputError("invalid_value", f"a sampling step must be positive, not {dt:g} s")
        steps = np.round(self.delay / dt).astype(int)
        if np.any(np.abs(steps * dt - self.delay) > 1e-6 * dt):
            worst = float(self.delay[np.argmax(np.abs(steps * dt - self.delay))])
            raise InputError(
                "invalid_value", f"a delay of {1000 * worst:g} ms is not a whole number of steps of {1000 * dt:g} ms"
            )
        n, m = self.B.shape
        both = expm(np.block([[self.A, self.B], [np.zeros((m, n + m))]]) * dt)
        return SampledModel(both[:n, :n], both[:n, n:], self.C, self.D, dt, self.inputs, self.outputs, steps)


@dataclass(frozen=True, eq=False)
class SampledModel:
    """A linear system at multiples of `dt`: `x_{k+1} = A x_k + B u_{k-d}`, `y_k = C x_k + D u_{k-d}`.

    Attributes:
        A: (n, n).
        B: (n, m).
        C: (p, n).
        D: (p, m).
        dt: Step [s].
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        delay: Delay of each input in whole steps (m,).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    delay: np.ndarray

    def simulate(self, u: np.ndarray) -> np.ndarray:
        """Return the outputs (N, p) of inputs (N, m), from rest."""
        u = np.asarray(u, float)
        if u.ndim != 2 or u.shape[1] != len(self.inputs):
            raise InputError("wrong_shape", f"expected inputs of shape (N, {len(self.inputs)}), not {u.shape}")
        late = np.zeros_like(u)
        for k, steps in enumerate(self.delay):
            late[steps:, k] = u[: max(0, len(u) - steps), k]
        x = np.zeros((len(u), len(self.A)))
        driven = late @ self.B.T
        for k in range(len(u) - 1):
            x[k + 1] = self.A @ x[k] + driven[k]
        return x @ self.C.T + late @ self.D.T


def _places(kind: str, wanted: Sequence[str], known: Sequence[str]) -> list[int]:
    for name in wanted:
        if name not in known:
            raise UnknownName(kind, name, known)
    return [list(known).index(name) for name in wanted]
