r"""Fewer states: balanced truncation of a stable model, realisation of the impulse response otherwise.

Reference: Moore 1981; Laub, Heath, Paige, Ward 1987 (square-root algorithm); error bound 2 sum of the dropped Hankel
singular values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from tau_dyn.exceptions import InputError
from tau_dyn.modes.era import era
from tau_dyn.modes.state_space import StateSpace

MARKOV = 400  # samples of the impulse response of an unstable model


def hankel_values(model: StateSpace) -> np.ndarray:
    """Return the Hankel singular values (n,) of a stable model, largest first."""
    controllable, observable = _roots(model)
    return np.linalg.svd(observable.T @ controllable, compute_uv=False)


def reduce_order(model: StateSpace, order: int) -> StateSpace:
    """Return a model with fewer states and nearly the same response from inputs to outputs.

    Args:
        model: The model; inputs and outputs of unlike size should be scaled first.
        order: States to keep. The innovations' gain is carried along, not approximated on its own.

    Raises:
        InputError: The order is not between 1 and the model's.
    """
    if not 1 <= order <= model.order:
        raise InputError(f"cannot reduce a model of order {model.order} to {order}")
    if model.spectral_radius() >= 1:
        small = era(model.markov(MARKOV), model.dt, order)
        return replace(small, delay=model.delay, noise=model.noise)
    controllable, observable = _roots(model)
    U, values, Vt = np.linalg.svd(observable.T @ controllable)
    root = np.sqrt(np.maximum(values[:order], 1e-300))
    left, right = (observable @ U[:, :order]) / root, (controllable @ Vt[:order].T) / root
    return replace(model, A=left.T @ model.A @ right, B=left.T @ model.B, C=model.C @ right, K=left.T @ model.K)


def _roots(model: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Square roots S S' of the controllability and the observability Gramian."""
    return _root(solve_discrete_lyapunov(model.A, model.B @ model.B.T)), _root(
        solve_discrete_lyapunov(model.A.T, model.C.T @ model.C)
    )


def _root(gramian: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
