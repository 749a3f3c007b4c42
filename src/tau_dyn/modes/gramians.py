"""Gramians of a stable sampled model, and their square roots: what balancing and truncation start from (Moore 1981)."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from tau_dyn.modes.state_space import StateSpace


def compute_gramians(model: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Return the controllability and the observability Gramian, each (n, n)."""
    controllable = solve_discrete_lyapunov(model.A, model.B @ model.B.T)
    return controllable, solve_discrete_lyapunov(model.A.T, model.C.T @ model.C)


def compute_root(gramian: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Return `S` (n, n) with `S S'` a Gramian, eigenvalues raised to `least` of the largest."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, least * values[-1]))
