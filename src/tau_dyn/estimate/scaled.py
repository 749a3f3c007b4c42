"""Least squares on columns of unit norm, so that a tolerance means the same for a mass in kg and an inertia in kg m^2.

    W theta = (W / norm) (norm theta)

A column of zeros stays one: its parameter comes out as zero, and nothing is divided by its norm.
"""

from __future__ import annotations

import numpy as np


def scale_columns(W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (N, p) scaled to unit norm, and what they were divided by (p,); 1 for a column of zeros."""
    norm = np.linalg.norm(W, axis=0)
    norm[norm == 0] = 1.0
    return W / norm, norm


def solve_scaled(W: np.ndarray, y: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the parameters (p,) of columns (N, p) that leave least of `y` (N,).

    Args:
        W: Columns.
        y: What they are to explain.
        tolerance: Singular value of the unit columns, relative to the largest, below which a direction is left at zero.
    """
    unit, norm = scale_columns(W)
    return np.linalg.lstsq(unit, y, rcond=tolerance)[0] / norm
