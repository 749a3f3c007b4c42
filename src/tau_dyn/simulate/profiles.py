r"""Building blocks of motions: smooth windows, and paths of constant speeds joined by smooth ramps.

A ramp from speed `v0` to `v1` in time T follows, with `s = t / T`,

    a = (v1 - v0) / T (1 - cos 2 pi s),   v = v0 + (v1 - v0) (s - sin(2 pi s) / 2 pi),

so that accelerations are continuous and peak at twice their mean. All integrals are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_TURN = 2 * np.pi
TURNING = 0.5 + 2 / np.pi**2
"""Way from full speed to the turning point of a reversal, over speed and half the reversal's time."""


class MotionProfile(NamedTuple):
    """Position, speed and acceleration along one coordinate, each (N,)."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


class Segment(NamedTuple):
    """A piece of a path: for `duration` [s] the speed goes from `start` to `end`."""

    duration: float
    start: float
    end: float

    @property
    def distance(self) -> float:
        """Distance covered."""
        return self.duration * (self.start + self.end) / 2


def build_speed_profile(t: np.ndarray, segments: Sequence[Segment]) -> MotionProfile:
    """Return the path through segments, from zero at time zero, at times (N,); the last speed goes on after the end."""
    duration, start, end = (
        np.array(x, float) for x in zip(*segments, (np.inf, segments[-1].end, segments[-1].end), strict=True)
    )
    begins = np.concatenate([[0.0], np.cumsum(duration[:-1])])
    places = np.concatenate([[0.0], np.cumsum([s.distance for s in segments])])
    k = np.searchsorted(begins, t, side="right") - 1
    T, since, change = duration[k], t - begins[k], (end - start)[k]
    s = np.where(np.isfinite(T), since / T, 0.0)
    rise = s - np.sin(_TURN * s) / _TURN
    inside = s**2 / 2 + (np.cos(_TURN * s) - 1) / _TURN**2
    finite = np.where(np.isfinite(T), T, 1.0)
    q = places[k] + start[k] * since + change * finite * inside
    return MotionProfile(q, start[k] + change * rise, change / finite * (1 - np.cos(_TURN * s)))


def compute_ramp_time(change: float, acceleration: float) -> float:
    """Return how long a ramp of the speed by `change` takes if its peak acceleration is `acceleration` [s]."""
    return 2 * abs(change) / acceleration


def build_stroke_profile(speed: float, half: float, acceleration: float) -> list[Segment]:
    """Return a round trip at a speed: from the middle to `+half`, to `-half` and back, starting and ending at rest.

    Where the ramps do not leave 40 % of the way for the constant speed, the speed is lowered until they do.
    """
    speed = min(speed, float(np.sqrt(0.6 * half * acceleration / (1 + 2 * TURNING))))
    ramp = compute_ramp_time(speed, acceleration)
    first = half / speed - (0.5 + TURNING) * ramp
    long = 2 * first + ramp
    return [
        Segment(ramp, 0.0, speed),
        Segment(first, speed, speed),
        Segment(2 * ramp, speed, -speed),
        Segment(long, -speed, -speed),
        Segment(2 * ramp, -speed, speed),
        Segment(first, speed, speed),
        Segment(ramp, speed, 0.0),
    ]


def build_window(t: np.ndarray, duration: float, rise: float) -> MotionProfile:
    """Return a weight (N,) that rises from 0 to 1 within `rise` [s] and falls to 0 before `duration`, with derivatives."""
    up = build_speed_profile(np.clip(t, 0, rise), [Segment(rise, 0.0, 1.0)])
    down = build_speed_profile(np.clip(duration - t, 0, rise), [Segment(rise, 0.0, 1.0)])
    first = t < duration / 2
    # the ramp's speed is the weight; its acceleration the weight's slope, whose slope follows analytically
    slope = [_TURN / rise**2 * np.sin(_TURN * np.clip(x, 0, rise) / rise) for x in (t, duration - t)]
    return MotionProfile(
        np.where(first, up.v, down.v), np.where(first, up.a, -down.a), np.where(first, slope[0], slope[1])
    )


def apply_window(path: MotionProfile, weight: MotionProfile) -> MotionProfile:
    """Return the product of a path (N, ...) and a weight (N,), by the product rule."""
    w, dw, ddw = (x.reshape((-1,) + (1,) * (path.q.ndim - 1)) for x in weight)
    return MotionProfile(w * path.q, w * path.v + dw * path.q, w * path.a + 2 * dw * path.v + ddw * path.q)
