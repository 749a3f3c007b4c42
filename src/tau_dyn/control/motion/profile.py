"""The trapezoidal speed profile that a search starts from: a third each of constant acceleration, speed and deceleration."""

from __future__ import annotations

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import Coordinates
from tau_dyn.control.motion.limits import MotionLimits

_THIRD = 1 / 3  # of the time each for speeding up, cruising and slowing down: least peak power
_FIRST, _LAST = 0.02, 300.0  # [s] shortest and longest duration that is tried
_GROWTH = 1.15  # factor on the duration of a first guess until limits hold
_FALLBACK = 2.0  # [s] where weight alone is beyond a limit on the way
_MIN_SPEED = 1e-3  # [m/s or rad/s]


def compute_trapezoid(intervals: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return share of the way, speed and acceleration (2 intervals + 1,) by the normalised time, at nodes and middles.

    The acceleration is linear between the nodes and zero at both ends, as the program's is.
    """
    nodes, h = np.linspace(0, 1, intervals + 1), 1 / (2 * intervals)
    rate = np.where(nodes < _THIRD - 1e-9, 1.0, np.where(nodes > 1 - _THIRD + 1e-9, -1.0, 0.0))
    rate[[0, -1]] = 0.0
    a = np.interp(np.linspace(0, 1, 2 * intervals + 1), nodes, rate)
    v = np.concatenate([[0], np.cumsum(h / 2 * (a[1:] + a[:-1]))])
    s = np.concatenate([[0], np.cumsum(h * v[:-1] + h**2 * (a[:-1] / 3 + a[1:] / 6))])
    return s / s[-1], v / s[-1], a / s[-1]


def compute_min_duration(
    coordinates: Coordinates, feedforward: Feedforward, limits: MotionLimits, profile: tuple[np.ndarray, ...]
) -> float:
    """Return nearly the shortest duration [s] at which a profile along the starting path keeps all limits."""
    x, dx, ddx = coordinates.along(*profile)
    T = _FIRST
    while T < _LAST:
        q, v, a = coordinates.motion(x, dx, ddx, T)
        used = [np.abs(feedforward(q, v, a)) / limits.force, np.abs(v) / limits.speed, np.abs(a) / limits.acceleration]
        if max(float(np.max(x)) for x in used) <= 1:
            return T
        T *= _GROWTH
    return _FALLBACK


def compute_smoothing_width(
    coordinates: Coordinates, profile: tuple[np.ndarray, ...], T: float, intervals: int
) -> np.ndarray:
    """Return the speed (na,) within which friction changes its sign: what the profile gains in half an interval."""
    x, dx, ddx = coordinates.along(*profile)
    _, v, _ = coordinates.motion(x, dx, ddx, T)
    return np.maximum(np.abs(v).max(axis=0) / (2 * _THIRD * intervals), _MIN_SPEED)
