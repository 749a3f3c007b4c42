"""Notch filters for a controller: a resonance is taken out of a signal, a sample at a time.

    H(s) = (s^2 + 2 z w s + w^2) / (s^2 + 2 z_p w s + w^2)

replaces the mode's poles by well damped ones; it is mapped by Tustin's rule, prewarped so that the centre stays
(Franklin, Powell & Workman 1998, 6.1). Its gain at the centre is z / z_p; away from it, it costs phase below the resonance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfilt, sosfreqz

from tau_dyn.control.iterative import build_notch
from tau_dyn.control.vibration.resonance import Resonance
from tau_dyn.exceptions import InputError

POLE_DAMPING = 0.7  # z_p: the poles that replace the mode's hardly ring
MIN_ZERO_DAMPING = 1e-4
"""Least z of the filter, where a mode is estimated as undamped: a zero on the unit circle loses its place by rounding."""


@dataclass(frozen=True, eq=False)
class CausalNotch:
    """A notch filter for each of some modes, one after the other.

    Attributes:
        sections: Second-order sections (s, 6), b then a, a[0] = 1.
        dt: Sampling step [s].
    """

    sections: np.ndarray
    dt: float

    def apply(self, x: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) filtered along time from rest."""
        return np.asarray(sosfilt(self.sections, x, axis=0))

    def response(self, frequency: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the complex response (F,) at frequencies (F,) [Hz]."""
        return np.asarray(sosfreqz(self.sections, worN=2 * np.pi * np.asarray(frequency, float) * self.dt)[1])

    def find_worst_gain(self, mode: Resonance) -> float:
        """Return the largest gain over the 95 % interval of a mode's frequency, up to half the sampling rate."""
        low, high = mode.frequency_interval
        return float(np.abs(self.response(np.linspace(low, min(high, 0.5 / self.dt), 101))).max())


def design_causal_notch(modes: Sequence[Resonance], dt: float, pole_damping: float = POLE_DAMPING) -> CausalNotch:
    """Return a notch filter for modes.

    Args:
        modes: The modes.
        dt: The controller's step [s].
        pole_damping: Damping ratio of the poles that replace those of each mode.

    Raises:
        InputError: A mode is not below half the sampling rate, or is damped as much as the new poles.
    """
    sections = []
    for mode in modes:
        z = max(mode.damping_ratio, MIN_ZERO_DAMPING)
        if not z < pole_damping <= 1:
            raise InputError(
                "invalid_value",
                f"a notch with poles of damping ratio {pole_damping:g} has no effect on a mode of {z:.3g}; "
                "give a larger one, up to 1",
            )
        # one pass of a filter of both directions, whose floor is the square of one pass
        both = build_notch(mode.frequency_hz, 2 * pole_damping * mode.frequency_hz, (z / pole_damping) ** 2, dt)
        sections.append(both.sections)
    return CausalNotch(np.vstack(sections), dt)
