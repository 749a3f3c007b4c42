"""Rotations of many samples by rotation vectors, and back; arrays have samples last."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism.tree_arrays import compute_cross_product


def rotate_by_vector(w: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return `Exp(w) R` (3, 3, N) for rotation vectors (3, N), by Rodrigues' formula."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    s, c = _sine_and_cosine(square)
    out = np.empty(rotation.shape)
    for k in range(3):
        column = rotation[:, k]
        first = compute_cross_product(w, column)
        out[:, k] = compute_cross_product(w, first)
        out[:, k] *= c
        first *= s
        out[:, k] += first
        out[:, k] += column
    return out


def _sine_and_cosine(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `sin(x) / x` and `(1 - cos(x)) / x^2` (N,) of squared angles, by series where all are small."""
    if np.all(square < 0.01):  # the first terms left out are below 1e-13
        s = 1.0 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040)))
        return s, 0.5 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320)))
    small = square < 1e-6
    angle = np.sqrt(square)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.where(small, 1.0 - square / 6.0, np.sin(angle) / angle)
        c = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(angle)) / square)
    return s, c


def log_of(rotation: np.ndarray) -> np.ndarray:
    """Return rotation vectors (3, N) of rotations (3, 3, N)."""
    out = np.full((3, rotation.shape[2]), np.nan)
    sound = np.isfinite(rotation).all(axis=(0, 1))
    if sound.any():
        out[:, sound] = Rotation.from_matrix(np.moveaxis(rotation[:, :, sound], 2, 0)).as_rotvec().T
    return out
