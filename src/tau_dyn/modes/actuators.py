r"""Controlled actuators as first-order systems with a dead time, from step responses.

    tau y' + y = gain * r(t - delay)

The reference r is held over each sample, so sampling is exact for any delay, whole samples or not. The thesis writes the same as
`G(q) = q^-d b / (1 - a q^-1)`, (6.11): `d` counts the sample that the hold itself takes, so `delay = (d - 1) dt` there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError


@dataclass(frozen=True)
class Actuator:
    """One axis from position reference to position.

    Attributes:
        gain: Static gain.
        time_constant: [s].
        delay: Dead time [s].
    """

    gain: float
    time_constant: float
    delay: float

    @property
    def bandwidth_hz(self) -> float:
        """Frequency at which the gain has dropped by 3 dB [Hz]."""
        return 1 / (2 * np.pi * self.time_constant)

    def simulate(self, reference: np.ndarray, dt: float) -> np.ndarray:
        """Return positions (N,) to a reference (N,), at rest at its first value."""
        return self.gain * filter_at_rest(np.asarray(reference, float), dt, self.time_constant, self.delay)

    def discrete(self, dt: float) -> tuple[np.ndarray, float, int]:
        """Return b (2,), a and d of `G(q) = q^-d (b0 + b1 q^-1) / (1 - a q^-1)`; b1 is zero for a delay of whole samples."""
        whole, near, far, a = _sampled(dt, self.time_constant, self.delay)
        return self.gain * np.array([near, far]), a, whole + 1

    @staticmethod
    def from_discrete(b: float, a: float, d: int, dt: float) -> Actuator:
        """Return the actuator behind `q^-d b / (1 - a q^-1)`.

        Raises:
            InputError: `a` is not between 0 and 1, or `d` is below 1.
        """
        if not 0 < a < 1 or d < 1:
            raise InputError(
                "invalid_value",
                f"q^-{d} {b:g} / (1 - {a:g} q^-1) is no delayed first-order system: it takes 0 < a < 1 and d >= 1",
            )
        return Actuator(b / (1 - a), -dt / float(np.log(a)), (d - 1) * dt)


def filter_at_rest(reference: np.ndarray, dt: float, time_constant: float, delay: float) -> np.ndarray:
    """Return the response (N,) of unit gain, at rest at the reference's first value."""
    whole, near, far, a = _sampled(dt, time_constant, delay)
    rise = reference - reference[0]
    late = np.concatenate([np.zeros(min(whole + 1, len(rise))), rise])[: len(rise)]
    later = np.concatenate([[0.0], late])[: len(rise)]
    return reference[0] + np.asarray(lfilter([1.0], [1.0, -a], near * late + far * later))


def _sampled(dt: float, time_constant: float, delay: float) -> tuple[int, float, float, float]:
    """Return whole samples of delay, the weights of the input then and one sample earlier, and the pole."""
    whole = int(np.floor(delay / dt + 1e-9))
    part = max(delay - whole * dt, 0.0)  # this long into each step the older input still acts
    a, left = np.exp(-dt / time_constant), np.exp(-(dt - part) / time_constant)
    return whole, float(1 - left), float(left - a), float(a)
