r"""The learning filter `L = gain q^shift` (thesis 7.10): the error that is still to come, times a gain.

The shift makes up for the delay of the plant. Beyond the end the last error is held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError


@dataclass(frozen=True)
class TimeShift:
    """A gain and a shift forwards in time.

    Attributes:
        gain: Part of the error that one iteration takes away where the plant follows at once.
        samples: Whole samples.
        dt: Sampling step [s].
    """

    gain: float
    samples: int
    dt: float

    def __post_init__(self) -> None:
        """Refuse what is no filter of this kind."""
        if not np.isfinite(self.gain) or self.samples < 0 or not self.dt > 0:
            raise InputError(
                "invalid_value", "a learning filter has a finite gain, a shift of 0 samples or more and a positive step"
            )

    def apply(self, e: np.ndarray) -> np.ndarray:
        """Return errors (N, ...) shifted, the last one held."""
        return self.gain * e[self._places(len(e))]

    def transposed(self, e: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) through the transposed matrix."""
        out = np.zeros_like(e)
        np.add.at(out, self._places(len(e)), self.gain * e)
        return out

    def matrix(self, n: int) -> np.ndarray:
        """Return (n, n), thesis (7.10)."""
        return self.gain * np.eye(n)[self._places(n)]

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz], ends left aside."""
        return self.gain * np.exp(2j * np.pi * np.asarray(frequency, float) * self.dt * self.samples)

    def _places(self, n: int) -> np.ndarray:
        return np.minimum(np.arange(n) + self.samples, n - 1)
