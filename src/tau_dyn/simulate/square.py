r"""The thesis' path for iterative learning: a square, twice round, at rest in every corner.

Speed along an edge is what acceleration and jerk time allow: full acceleration for the first half, full braking for the second,
both averaged over the jerk time, so that a 10 mm edge at 1 m/s^2 comes close to 100 mm/s and does not reach it.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError


def square_path(
    n: int,
    dt: float,
    *,
    side: float = 0.010,
    speed: float = 0.1,
    acceleration: float = 1.0,
    jerk_time: float = 0.04,
    pause: float = 0.1,
    start: float = 1.2,
    rounds: int = 2,
) -> np.ndarray:
    """Return tool positions relative to the first corner (n, 3) [m]: -y, +x, +y, -x.

    Args:
        n: Samples.
        dt: Step [s].
        side: Of the square [m].
        speed: Not exceeded along an edge [m/s].
        acceleration: Along an edge [m/s^2].
        jerk_time: How long the acceleration takes from one value to the next [s].
        pause: At rest in each corner [s].
        start: Of the first edge [s].
        rounds: How often.

    Raises:
        InputError: A number is not positive, or the path does not end within n samples.
    """
    if not min(n, dt, side, speed, acceleration, jerk_time, rounds) > 0 or min(pause, start) < 0:
        raise InputError("invalid_value", "a square needs positive sizes, speeds and times")
    top = min(speed, np.sqrt(side * acceleration))
    moving = side / top + top / acceleration + jerk_time
    edge = moving + pause
    if start + 4 * rounds * edge > n * dt:
        raise InputError(
            "invalid_value",
            f"{rounds} rounds take {start + 4 * rounds * edge:.2f} s; {n} samples of {1000 * dt:g} ms are {n * dt:.2f} s",
        )
    t = np.arange(n) * dt - start
    corner = np.clip(np.floor(t / edge), 0, 4 * rounds - 1).astype(int)
    way = _way(t - corner * edge, side, top, acceleration, jerk_time)
    corners = side * np.array([[0, 0, 0], [0, -1, 0], [1, -1, 0], [1, 0, 0], [0, 0, 0]], float)
    here, there = corners[corner % 4], corners[corner % 4 + 1]
    return here + (there - here) * (way / side)[:, None]


def _way(t: np.ndarray, side: float, top: float, a: float, jerk_time: float) -> np.ndarray:
    """Return the way along an edge (N,): the trapezoid of speed, averaged over the jerk time."""
    ramp, cruise = top / a, side / top - top / a
    turns = np.cumsum([0.0, ramp, cruise, ramp])

    def integral(at: np.ndarray) -> np.ndarray:  # of the way
        return sum(
            sign * a / 6 * np.maximum(at - turn, 0) ** 3 for sign, turn in zip((1, -1, -1, 1), turns, strict=True)
        )  # type: ignore[return-value]

    end = turns[-1] + jerk_time
    at = np.clip(t, 0, end)
    return np.clip((integral(at) - integral(at - jerk_time)) / jerk_time, 0, side)
