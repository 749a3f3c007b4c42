r"""The handle's impedance: a mass and a damper without a spring, Dressler 2012, (8.5)-(8.7).

    A = M^-1 (F_h - D V),   V_h(k + 1) = P_h V_h(k) + T A(k).

The second line is (8.7) multiplied out: its correction `(V_h - P_h V_h) / T` inside the sum puts the integrator back to
what was applied, every sample. So it cannot wind up behind a velocity limit or a projection; a component that P_h takes
away is worth one sample of acceleration, `T A`, when the contact ends. (As printed, (8.5) has the index k + 1 beside
`T / (q - 1)`, which would cost a sample more; meant is the sum up to and with sample k.) D acts on the velocity that was
applied, the force controller's share included, as in (8.6).

Passive: along one axis, with a = 1 - T D / M, the hand's force F(k) and the velocity V(k + 1) that follows it at once
have the response `(T / M) z / (z - a)`, whose real part has the sign of `1 - a cos(w T)`: above zero at every frequency
while |a| < 1, so no motion of the hand draws energy from the robot. With the sample more of the printed index it would
be the sign of `cos(w T) - a`, below zero over most frequencies. `checks.py` refuses M that is not positive definite, D
with a negative part, and T M^-1 D of 1 or more. A projection and a velocity limit take energy away.
"""

from __future__ import annotations

import numpy as np


class HandleImpedance:
    """Integrates (8.6) and (8.7)."""

    def __init__(self, mass: np.ndarray, damping: np.ndarray, sample_time: float) -> None:
        """Keep mass (6, 6) [kg, kg m^2] and damping (6, 6) [N s/m, N m s/rad], and start at rest."""
        self._inverse = np.linalg.inv(mass)
        self._damping, self._time = damping, sample_time
        self.held = np.zeros(6)

    def step(self, wrench: np.ndarray, applied: np.ndarray) -> np.ndarray:
        """Return the velocity (6,) that the handle asks for.

        Args:
            wrench: The hand's force and torque on the handle (6,), world axes at the tool point.
            applied: The velocity applied to the robot over the last sample (6,).
        """
        return self.held + self._time * (self._inverse @ (wrench - self._damping @ applied))

    def hold(self, projected: np.ndarray) -> None:
        """Remember what of the answer was really applied (6,): the anti-windup of (8.7)."""
        self.held = projected
