r"""Stability limit of a force loop: the contact stiffness, or the gain, at which it begins to oscillate.

Along one axis the tool has position x, speed v and a servo that follows a velocity command u with bandwidth w_b. The
command is held over a sample T, so the plant is known exactly at the samples,

    v+ = e v + (1 - e) u,   x+ = x + a v + (T - a) u,   e = exp(-w_b T),   a = (1 - e) / w_b,

and the contact force is f = k x + c v. With u = -K f, d samples late and after a first-order filter, the loop is `K G(z)`, G
the force per velocity command. It oscillates at the lowest gain with `K G = -1`, therefore

    K_max = min 1 / |G(exp(j w T))|   over the w at which G is real and negative.

For c = 0 the loop is an integrator with about the delay `T_d = T / 2 + d T + 1 / w_b`. If that is long compared with T, the
rule of thumb is `K_max k = pi / (2 T_d)` (a lower bound, since a servo also attenuates) at `1 / (4 T_d)`. So only the product
of gain and stiffness counts, and the frequency depends on the delay, not on the stiffness. Åström & Murray 2008, ch. 9; delay
and stiffness in force control: Whitney 1977.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar

from tau_dyn.exceptions import InputError

_GRID = 2000  # frequencies over four decades, 500 a decade


class StabilityLimit(NamedTuple):
    """Stability limit of a loop.

    Attributes:
        gain: The lowest gain at which it oscillates [m/s per N, or rad/s per N m].
        hz: The frequency of that oscillation [Hz].
    """

    gain: float
    hz: float


@dataclass(frozen=True)
class ForceLoop:
    """Dynamics between a force sample and the motion that it causes.

    Attributes:
        sample_time: Time between samples [s].
        servo_hz: Bandwidth of the servo that follows velocity commands [Hz].
        delay: Whole samples from a measurement to the command that follows it.
        filter_hz: Corner of a first-order low-pass on the tool force [Hz]; inf without a filter.
    """

    sample_time: float = 0.004
    servo_hz: float = 69.0
    delay: int = 0
    filter_hz: float = np.inf

    def __post_init__(self) -> None:
        """Refuse values that describe no loop."""
        for name in ("sample_time", "servo_hz", "filter_hz"):
            if not getattr(self, name) > 0:
                raise InputError(
                    "invalid_value", f"{name} of the force loop must be above zero, not {getattr(self, name)}"
                )
        if not np.isfinite([self.sample_time, self.servo_hz]).all():
            raise InputError("invalid_value", "sample_time and servo_hz of the force loop must be finite")
        if int(self.delay) != self.delay or self.delay < 0:
            raise InputError(
                "invalid_value", f"delay of the force loop is a number of samples, 0, 1, .., not {self.delay}"
            )

    @property
    def smoothing(self) -> float:
        """Share of a new sample in the filtered force, 1 without a filter."""
        return float(-np.expm1(-2 * np.pi * self.filter_hz * self.sample_time))

    def plant(self) -> tuple[np.ndarray, np.ndarray]:
        """Return A (2, 2) and B (2,) of position and speed over a sample."""
        rate = 2 * np.pi * self.servo_hz
        e = np.exp(-rate * self.sample_time)
        a = (1 - e) / rate
        return np.array([[1, a], [0, e]]), np.array([self.sample_time - a, 1 - e])

    def response(self, hz: np.ndarray, stiffness: float, damping: float = 0.0) -> np.ndarray:
        """Return the filtered force per velocity command, complex (N,) [N s/m], at frequencies (N,) [Hz].

        Args:
            hz: Frequencies, above zero up to half the sampling frequency.
            stiffness: Contact stiffness [N/m].
            damping: Contact damping [N s/m].
        """
        z = np.exp(2j * np.pi * np.asarray(hz) * self.sample_time)
        a, b = self.plant()
        speed = b[1] / (z - a[1, 1])
        position = (a[0, 1] * speed + b[0]) / (z - 1)
        smooth = self.smoothing * z / (z - 1 + self.smoothing)
        return (stiffness * position + damping * speed) * smooth * z ** (-float(self.delay))

    def limit(self, stiffness: float, damping: float = 0.0) -> StabilityLimit:
        """Return the gain at which a contact of this stiffness [N/m] and damping [N s/m] begins to oscillate."""
        return _crossing(lambda hz: self.response(hz, stiffness, damping), self.sample_time)

    def hand_limit(self, mass: float, damping: float) -> StabilityLimit:
        """Return the stiffest hand [N/m] that may hold a handle of this mass [kg] and damping [N s/m], as `gain`.

        The hand is a spring, the handle the sampled impedance (8.6); the rest of the loop is the same, without the filter.
        """
        bare = ForceLoop(self.sample_time, self.servo_hz, self.delay)

        def response(hz: np.ndarray) -> np.ndarray:
            z = np.exp(2j * np.pi * np.asarray(hz) * self.sample_time)
            handle = self.sample_time / mass * z / (z - 1 + self.sample_time * damping / mass)
            return bare.response(hz, 1.0) * handle

        return _crossing(response, self.sample_time)

    def matrix(self, gain: float, stiffness: float, damping: float = 0.0) -> np.ndarray:
        """Return the closed loop's state matrix; its states are x, v, the filtered force and the commands on their way.

        Its largest eigenvalue by magnitude is above one exactly if `gain` is above `limit(..).gain`.
        """
        n = 3 + self.delay
        unit = np.eye(n)
        a, b = self.plant()
        force = (1 - self.smoothing) * unit[2] + self.smoothing * (stiffness * unit[0] + damping * unit[1])
        commands = np.vstack([-gain * force, unit[3:]])
        rows = np.zeros((n, n))
        rows[:2, :2] = a
        rows[:2] += np.outer(b, commands[-1])
        rows[2] = force
        rows[3:] = commands[: self.delay]
        return rows


def _crossing(response, sample_time: float) -> StabilityLimit:
    """Return the smallest gain at which the response, times it, is -1."""
    nyquist = 0.5 / sample_time
    hz = nyquist * np.geomspace(1e-4, 1, _GRID)
    g = response(hz)
    found = [(1 / abs(g[-1]), nyquist)] if g[-1].real < 0 and abs(g[-1].imag) < 1e-6 * abs(g[-1]) else []
    for k in np.flatnonzero((np.sign(g.imag[:-2]) != np.sign(g.imag[1:-1])) & (g.real[:-2] < 0)):
        imaginary = root_scalar(lambda f: float(response(np.array([f]))[0].imag), bracket=(hz[k], hz[k + 1]), xtol=1e-9)
        at = float(imaginary.root)
        found.append((1 / abs(complex(response(np.array([at]))[0])), at))
    return StabilityLimit(*map(float, min(found))) if found else StabilityLimit(np.inf, np.nan)
