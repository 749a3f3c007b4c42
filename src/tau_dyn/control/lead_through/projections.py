r"""Which part of each velocity reference reaches the robot: the projections P_h and P_t of Dressler 2012, (8.3), (8.8)-(8.11).

Twists are (6,), linear first. The two linear parts are complementary: with contact, P_h keeps what is orthogonal to the
normal n, `(I - n n') v`, and P_t what is along it, `n n' v`; no direction is driven by both sensors, and none by neither.
Both are orthogonal projections, so neither can add energy: `|P v| <= |v|`.
"""

from __future__ import annotations

import numpy as np


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
