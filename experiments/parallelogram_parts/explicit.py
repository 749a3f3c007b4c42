r"""The paper's planar parallelogram in closed form, derived anew from its closures (42) and (43); lengths in m, angles in rad.

With u(t) = (sin t, -cos t), R(a) the platform's rotation, s = q + q0:

    A_1 + l_1 u(s) + R(a) (b_1x, 0) = A_2 + l_2 u(phi) - R(a) (b_2x, b_2y),   A_1 = (-a_1x, 0), A_2 = (a_2x, a_2y)

so that sin phi = E + F cos a + G sin a and cos phi = E' + G cos a - F sin a, as (44) and (45), with

    E = (l_1 sin s - a_1x - a_2x) / l_2,  E' = (l_1 cos s + a_2y) / l_2,  F = (b_1x + b_2x) / l_2,  G = -b_2y / l_2.

h cancels: it stands in neither closure's difference, (48) is wrong there. Squares added up give E' sin b - E cos b = I,
(50), with b = a + gamma_p, tan gamma_p = b_2y / (b_1x + b_2x), l_p^2 = (b_1x + b_2x)^2 + b_2y^2 and I = (l_2^2 (E^2 +
E'^2 - 1) + l_p^2) / (2 l_2 l_p).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

NAMES = ("q0", "a1x", "a2x", "a2y", "b1x", "b2x", "b2y", "l1", "l2")
NOMINAL = np.array([0.0, 0.125, 0.125, 0.0, 0.125, 0.125, 0.0, 0.95, 0.95])
ERRORS = np.array([np.radians(0.01), 1e-3, 0.0, 3e-3, 0.0, -2e-3, 0.0, 1e-3, -1e-3])
"""Table 2."""


class Planar(NamedTuple):
    """Where the TCP is: x along x_b, y along y_b (N,) [m], and the platform's angle (N,) [rad]."""

    x: np.ndarray
    y: np.ndarray
    alpha: np.ndarray


def forward(q: np.ndarray, k: np.ndarray, h: float) -> Planar:
    """Return the TCP at actuated positions (N,) [rad], parameters `k` (9,) as `NAMES`, and tool length `h` [m]."""
    q0, a1x, a2x, a2y, b1x, b2x, b2y, l1, l2 = k
    s = q + q0
    e, e_ = (l1 * np.sin(s) - a1x - a2x) / l2, (l1 * np.cos(s) + a2y) / l2
    lp, gamma = np.hypot(b1x + b2x, b2y), np.arctan2(b2y, b1x + b2x)
    rhs = (l2**2 * (e**2 + e_**2 - 1) + lp**2) / (2 * l2 * lp)
    root = np.sqrt(e**2 + e_**2 - rhs**2)
    alpha = np.arctan2(e_ * rhs + e * root, e_ * root - e * rhs) - gamma
    x = -a1x + l1 * np.sin(s) + b1x * np.cos(alpha) + h * np.sin(alpha)
    y = -l1 * np.cos(s) + b1x * np.sin(alpha) - h * np.cos(alpha)
    return Planar(x, y, np.arctan2(np.sin(alpha), np.cos(alpha)))


def sensitivity(q: np.ndarray, h: float) -> np.ndarray:
    """Return `S_C = J_X^-1 J_kC` (N, 3, 9) at the nominal parameters, equations (63) to (67) derived anew.

    The third row follows from (55) with the actuator's point A_1 moving too, v' (dB_1 - dA_1) = l dq0: (65) lacks it and
    has the sign of `l` turned round, so that its rank is 7 and (72) does not follow.
    """
    return np.linalg.solve(_by_pose(q, h), _by_parameter(q))


def printed_sensitivity(q: np.ndarray, h: float) -> np.ndarray:
    """Return `S_C` as (64) and (65) are printed (N, 3, 9)."""
    rows = _by_parameter(q)
    rows[:, 2, 0], rows[:, 2, 1] = -NOMINAL[7], 0.0
    return np.linalg.solve(_by_pose(q, h), rows)


def _by_pose(q: np.ndarray, h: float) -> np.ndarray:
    u, v, b1x, b2x = np.sin(q), -np.cos(q), NOMINAL[4], NOMINAL[5]
    rows = [[u, v, -u * h - v * b1x], [u, v, -u * h + v * b2x], [-v, u, v * h - u * b1x]]
    return np.moveaxis(np.array(rows), 2, 0)


def _by_parameter(q: np.ndarray) -> np.ndarray:
    u, v, l1 = np.sin(q), -np.cos(q), NOMINAL[7]
    o, one = np.zeros_like(q), np.ones_like(q)
    rows = [
        [o, -u, o, o, u, o, o, one, o],
        [o, o, u, v, o, -u, -v, o, one],
        [l1 * one, v, o, o, -v, o, o, o, o],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
