"""How a model follows what was measured: fits, frequency and impulse responses, traces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Response:
    """The model's frequency response with its uncertainty, on a grid of frequencies.

    Attributes:
        frequency: (F,) [Hz].
        value: (F, p, m) complex.
        deviation: Standard error of real and imaginary part together, as a radius in the complex plane (F, p, m).
    """

    frequency: np.ndarray
    value: np.ndarray
    deviation: np.ndarray


@dataclass(frozen=True, eq=False)
class ImpulseResponses:
    """Response to a unit pulse, measured and of the model, both seen through the same band of the inputs.

    Attributes:
        t: (T,) [s].
        measured: (T, p, m).
        model: (T, p, m).
        how: How the measured one was had, in words.
        held_out: Whether from data that the model was not fitted to.
    """

    t: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    how: str
    held_out: bool
