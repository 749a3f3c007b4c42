"""The handle's impedance, and which part of each velocity reference reaches the robot.

The handle's impedance: a mass and a damper without a spring, Dressler 2012, (8.5)-(8.7).

    A = M^-1 (F_h - D V),   V_h(k + 1) = P_h V_h(k) + T A(k).

The second line is (8.7) multiplied out: its correction `(V_h - P_h V_h) / T` inside the sum puts the integrator back to
what was applied, every sample. So it cannot wind up behind a velocity limit or a projection; a component that P_h takes
away is worth one sample of acceleration, `T A`, when the contact ends. (As printed, (8.5) has the index k + 1 beside
`T / (q - 1)`, which would cost a sample more; meant is the sum up to and with sample k.) D acts on the velocity that was
applied, the force controller's share included, as in (8.6).

Passive: along one axis, with a = 1 - T D / M, the hand's force F(k) and the velocity V(k + 1) that follows it at once
have the response `(T / M) z / (z - a)`, whose real part has the sign of `1 - a cos(w T)`: above zero at every frequency
while |a| < 1, so no motion of the hand draws energy from the robot. With the sample more of the printed index it would
be the sign of `cos(w T) - a`, below zero over most frequencies. `settings.py` refuses M that is not positive definite, D
with a negative part, and T M^-1 D of 1 or more. A projection and a velocity limit take energy away.

Which part of each velocity reference reaches the robot: the projections P_h and P_t of Dressler 2012, (8.3), (8.8)-(8.11).

Twists are (6,), linear first. The two linear parts are complementary: with contact, P_h keeps what is orthogonal to the
normal n, `(I - n n') v`, and P_t what is along it, `n n' v`; no direction is driven by both sensors, and none by neither.
Both are orthogonal projections, so neither can add energy: `|P v| <= |v|`.
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


def handle_part(twist: np.ndarray, normal: np.ndarray, contact: bool) -> np.ndarray:
    """Return P_h (8.8): the handle moves the tool but never turns it; with contact, only along the surface.

    Args:
        twist: Velocity that the handle asks for (6,) [m/s, rad/s].
        normal: Unit surface normal (3,).
        contact: Whether the tool touches the work.
    """
    out = np.zeros(6)
    out[:3] = twist[:3] - (normal @ twist[:3]) * normal if contact else twist[:3]
    return out


def compute_tool_part(
    twist: np.ndarray, normal: np.ndarray, contact: bool, turns: bool, locked_axis: np.ndarray | None = None
) -> np.ndarray:
    """Return P_t: the force along the normal (8.9) and, where the tool may turn, all torques (8.11); nothing without contact.

    Args:
        twist: Velocity that the tool's force asks for (6,) [m/s, rad/s].
        normal: Unit surface normal (3,).
        contact: Whether the tool touches the work.
        turns: False for (8.9), True for (8.11).
        locked_axis: Unit axis (3,) about which the tool must not turn; a round peg leaves its own axis to noise.
    """
    out = np.zeros(6)
    if not contact:
        return out
    out[:3] = (normal @ twist[:3]) * normal
    if turns:
        out[3:] = twist[3:]
        if locked_axis is not None:
            out[3:] -= (locked_axis @ out[3:]) * locked_axis
    return out


def limit_twist(twist: np.ndarray, speed: float, turning: float) -> float:
    """Return the share, up to 1, of a twist (6,) that is within a speed [m/s] and a rate of turning [rad/s]."""
    over = np.linalg.norm(twist[:3]) / speed, np.linalg.norm(twist[3:]) / turning
    return 1.0 / max(1.0, *map(float, over))
