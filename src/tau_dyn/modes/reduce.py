r"""Fewer states: balanced truncation of a stable model, realisation of the impulse response otherwise.

Reference: Moore 1981; Laub, Heath, Paige, Ward 1987 (square-root algorithm); error bound 2 sum of the dropped Hankel
singular values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.modes.era import era
from tau_dyn.modes.gramians import compute_gramians, compute_root
from tau_dyn.modes.state_space import StateSpace

MARKOV = 400  # samples of the impulse response of an unstable model


def compute_hankel_values(model: StateSpace) -> np.ndarray:
    """Return the Hankel singular values (n,) of a stable model, largest first."""
    controllable, observable = (compute_root(gramian) for gramian in compute_gramians(model))
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
        raise InputError("invalid_value", f"cannot reduce a model of order {model.order} to {order}")
    if model.spectral_radius() >= 1:
        small = era(model.markov(MARKOV), model.dt, order)
        return replace(small, delay=model.delay, noise=model.noise)
    controllable, observable = (compute_root(gramian) for gramian in compute_gramians(model))
    U, values, Vt = np.linalg.svd(observable.T @ controllable)
    size = np.sqrt(np.maximum(values[:order], 1e-300))
    left, right = (observable @ U[:, :order]) / size, (controllable @ Vt[:order].T) / size
    return replace(model, A=left.T @ model.A @ right, B=left.T @ model.B, C=model.C @ right, K=left.T @ model.K)
