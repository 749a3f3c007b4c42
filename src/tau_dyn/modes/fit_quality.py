"""How a model follows what was measured: fits, frequency and impulse responses, traces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class FitQuality:
    """How well the model follows some records.

    Attributes:
        percent: Fit of a free simulation per output (p,), initial state estimated.
        ahead: The same of predictions so many samples ahead, by number of samples; one and ten, where noise was modelled.
        n_samples: Samples looked at.
        rms: Root mean square of what the simulation misses, per output (p,).
    """

    percent: np.ndarray
    ahead: Mapping[int, np.ndarray]
    n_samples: int
    rms: np.ndarray

    @property
    def mean(self) -> float:
        """Mean over the outputs [%]."""
        return float(np.mean(self.percent))


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


@dataclass(frozen=True, eq=False)
class Trace:
    """One record, measured and simulated.

    Attributes:
        log: The log's name.
        t: (N,) [s] from the record's start.
        u: (N, m).
        measured: (N, p).
        simulated: (N, p).
        held_out: Whether the model was not fitted to it.
    """

    log: str
    t: np.ndarray
    u: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    held_out: bool
