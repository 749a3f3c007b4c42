r"""Norm-optimal learning, for comparison: each correction minimises what the model expects of the next trial.

    |W e_{k+1}|^2 + effort |u_{k+1}|^2 + change |u_{k+1} - u_k|^2,   e_{k+1} = e_k - T (u_{k+1} - u_k),   T = F_u + F_y T_uy

with the weights W of (7.14) on the errors, and corrections only where these are not zero. This is again `Q (u + L e)`, with
matrices in place of filters: with `S = T'W^2 T`, `N = S + effort + change`,

    Q = N^-1 (S + change),    Q L = N^-1 T'W^2,    H = Q - Q L T = change N^-1,

so the model's H never has a singular value above `change / (effort + change)`: monotone for every choice. The whole model is
used, its coupling and its resonances too; the price is a model that errs. Reference: Amann, Owens, Rogers 1996, IEE Proc.;
Bristow, Tharayil, Alleyne 2006, IEEE Control Systems 26.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import aslinearoperator

from tau_dyn.control.iterative.learned_outputs import LearnedOutput
from tau_dyn.control.iterative.lifted_system import Operator, stack_channels, unstack_channels
from tau_dyn.control.iterative.reference import Reference
from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class NormOptimalLaw:
    """Norm-optimal learning.

    Attributes:
        side: What is learnt.
        effort: Cost of the correction's size over that of the error.
        change: Cost of the correction's change; a large one learns slowly and averages noise.
    """

    side: LearnedOutput
    effort: float = 1e-3
    change: float = 0.1
    _kept: list[tuple[Reference, tuple[np.ndarray, np.ndarray]]] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse costs that leave nothing to minimise."""
        if min(self.effort, self.change) < 0 or not self.effort + self.change > 0:
            raise InputError("invalid_value", "norm-optimal learning takes costs not below zero, and not both zero")

    @property
    def bound(self) -> float:
        """Largest singular value that H can have; its many values close together are costly to compute."""
        return self.change / (self.effort + self.change)

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        Q, G = self._solved(motion)
        return unstack_channels(Q @ stack_channels(correction) + G @ stack_channels(error), correction.shape[1])

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        Q, G = self._solved(motion)
        return aslinearoperator(Q), aslinearoperator(G)

    def responses(self, frequency: np.ndarray) -> None:
        """Return None: the law varies along the trial."""

    def _solved(self, motion: Reference) -> tuple[np.ndarray, np.ndarray]:
        if not self._kept or self._kept[0][0] is not motion:
            self._kept[:] = [(motion, self._solve(motion))]
        return self._kept[0][1]

    def _solve(self, motion: Reference) -> tuple[np.ndarray, np.ndarray]:
        T = self.side.operator(motion.n) @ np.eye(motion.n * self.side.reference(motion).shape[1])
        w = np.tile(motion.weights(), len(T) // motion.n)
        on = np.flatnonzero(w > 0)
        seen = (w**2)[:, None] * T[:, on]
        S = T[:, on].T @ seen + self.change * np.eye(len(on))
        factor = cho_factor(S + self.effort * np.eye(len(on)))
        Q, G = np.zeros_like(T), np.zeros_like(T)
        Q[np.ix_(on, on)] = cho_solve(factor, S)
        G[on] = cho_solve(factor, seen.T)
        return Q, G
