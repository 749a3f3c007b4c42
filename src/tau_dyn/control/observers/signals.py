"""What tool observers are given: positions computed from the actuators, and the tool's acceleration."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError


def require_signals(kinematic: np.ndarray, acceleration: np.ndarray, axes: int) -> np.ndarray:
    """Return positions (N, m) that belong to accelerations (N, m), both of so many axes.

    Raises:
        InputError: Their shapes differ or do not fit, or a number is not finite.
    """
    if kinematic.shape != acceleration.shape or kinematic.shape[1:] != (axes,) or len(kinematic) < 2:
        raise InputError(
            "wrong_shape",
            f"an observer of {axes} axes takes positions and accelerations (N, {axes}), "
            f"not {kinematic.shape} and {acceleration.shape}",
        )
    if not (np.isfinite(kinematic).all() and np.isfinite(acceleration).all()):
        raise InputError("bad_sample", "positions or accelerations hold a number that is not finite")
    return kinematic
