r"""A position model with two states more, the tool's velocity and acceleration (thesis 7.19 to 7.21).

    x_v(t + T) = (z(t + T) - z(t)) / T,    x_a(t + T) = (x_v(t + T) - x_v(t)) / T

with `z(t + T) = C (A x + B u)` give the matrices of (7.21). Two things the thesis does not say:

* `x_a(t)` is the second difference of `z(t), z(t - T), z(t - 2T)`, that is the acceleration at `t - T`. It has to be compared
  with the accelerometer's sample before, not with the present one: at 4 ms and 11.5 Hz that is 17 degrees.
* (7.21) needs `z = C x`. An identified model has a direct part D (rods carry the carts' acceleration to the tool at once). Then
  the input becomes a state: `x' = (x, u)`, driven by the input of the next sample, which is known when that sample is judged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace


@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """The extended model: `x(t + T) = A x(t) + B u`, with `u` at t, or at `t + T` where `ahead`.

    Attributes:
        A: (n, n).
        B: (n, m).
        position: Tool position from states (p, n).
        acceleration: Tool acceleration, one sample late, from states (p, n).
        disturbed: How a disturbance of the first states reaches all of them (n, n0).
        ahead: Whether the input of the new sample drives the step.
        dt: Step [s].
    """

    A: np.ndarray
    B: np.ndarray
    position: np.ndarray
    acceleration: np.ndarray
    disturbed: np.ndarray
    ahead: bool
    dt: float


def extend_model(model: StateSpace) -> ExtendedModel:
    """Return (7.21) of a model from computed to true tool positions.

    Raises:
        InputError: The model is unstable.
    """
    if not model.spectral_radius() < 1:
        raise InputError(
            "unstable",
            f"the model is unstable: it has a pole of magnitude {model.spectral_radius():.4g}; all must be below 1",
        )
    undelayed = _with_delay_as_states(model)
    ahead = bool(np.any(undelayed.D))
    A, B, C = _without_direct_part(undelayed) if ahead else (undelayed.A, undelayed.B, undelayed.C)
    n, p, h = len(A), len(C), 1 / model.dt
    differ = C @ (A - np.eye(n))
    wide = np.block(
        [
            [A, np.zeros((n, 2 * p))],
            [h * differ, np.zeros((p, 2 * p))],
            [h**2 * differ, -h * np.eye(p), np.zeros((p, p))],
        ]
    )
    spread = np.vstack([np.eye(n), h * C, h**2 * C])
    none = np.zeros((p, 2 * p))
    position = np.hstack([C, none])
    acceleration = np.hstack([np.zeros((p, n + p)), np.eye(p)])
    return ExtendedModel(wide, spread @ B, position, acceleration, spread, ahead, model.dt)


def _without_direct_part(model: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C of the model whose states hold the last input as well, `x' = (x, u)`, so that `z = C x'`."""
    n, m = model.B.shape
    A = np.block([[model.A, model.B], [np.zeros((m, n + m))]])
    return A, np.vstack([np.zeros((n, m)), np.eye(m)]), np.hstack([model.C, model.D])


def _with_delay_as_states(model: StateSpace) -> StateSpace:
    """Return the same model with the past inputs among its states."""
    for _ in range(model.delay):
        A, B, C = _without_direct_part(model)
        K = np.zeros((len(A), len(C)))
        model = StateSpace(A, B, C, np.zeros_like(model.D), K, model.dt, model.delay - 1, model.noise)
    return model
