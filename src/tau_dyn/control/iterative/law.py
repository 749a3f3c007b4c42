r"""The learning law `u_{k+1} = Q (u_k + L e_k)` (thesis 7.2, 7.6), `Q = Q_w Q_z` (7.13): weights after a zero-phase filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tau_dyn.control.iterative.learned_outputs import LearnedOutput
from tau_dyn.control.iterative.lifted_system import Operator, build_signal_operator
from tau_dyn.control.iterative.reference import Reference
from tau_dyn.control.iterative.shift import TimeShift
from tau_dyn.control.iterative.zero_phase import ZeroPhase
from tau_dyn.exceptions import InputError


class UpdateLaw(Protocol):
    """How one trial's error changes the next trial's correction."""

    @property
    def side(self) -> LearnedOutput:
        """What is learnt."""
        ...

    @property
    def bound(self) -> float | None:
        """A bound on H's singular values that holds by construction; None where they have to be computed."""
        ...

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        ...

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        ...

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return Q and L as responses (F, m, m), weights left aside; None where they vary along the trial."""
        ...


@dataclass(frozen=True, eq=False)
class LearningLaw:
    """Filters Q and L.

    Attributes:
        side: What is learnt.
        forgetting: Q without its weights, one a channel.
        learning: L, the same for all channels.
        bound: None: singular values have to be computed.
    """

    side: LearnedOutput
    forgetting: tuple[ZeroPhase, ...]
    learning: TimeShift
    bound: None = None

    def __post_init__(self) -> None:
        """Refuse filters made for another step than the models."""
        for what, dt in [("L", self.learning.dt), *(("Q", q.dt) for q in self.forgetting)]:
            if abs(dt - self.side.dt) > 1e-9 * self.side.dt:
                raise InputError(
                    "mismatch",
                    f"filter {what} is made for {1000 * dt:g} ms, the model for {1000 * self.side.dt:g} ms; "
                    "a law, its models and the robot need the same sampling step",
                )

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        if error.shape != (motion.n, len(self.forgetting)):
            raise InputError(
                "mismatch", f"{len(self.forgetting)} filter(s) Q for errors {error.shape}; one a channel is needed"
            )
        asked = correction + self.learning.apply(error)
        kept = [q.apply(asked[:, k]) for k, q in enumerate(self.forgetting)]
        return motion.weights()[:, None] * np.column_stack(kept)

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        n, m, w = motion.n, len(self.forgetting), motion.weights()[:, None]

        def filtered(x: np.ndarray) -> np.ndarray:  # its own transpose
            return np.column_stack([q.apply(x[:, k]) for k, q in enumerate(self.forgetting)])

        Q = build_signal_operator(lambda x: w * filtered(x), lambda x: filtered(w * x), n, m, m)
        L = build_signal_operator(self.learning.apply, self.learning.transposed, n, m, m)
        return Q, Q @ L

    def matrices(self, motion: Reference, channel: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return Q and L of one channel (N, N), thesis (7.10) to (7.14)."""
        w = motion.weights()[:, None]
        return w * self.forgetting[channel].matrix(motion.n), self.learning.matrix(motion.n)

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Q and L as responses (F, m, m), weights left aside."""
        eye = np.eye(len(self.forgetting))
        Q = np.column_stack([q.response(frequency) for q in self.forgetting])
        return Q[:, :, None] * eye, self.learning.response(frequency)[:, None, None] * eye
