"""How a design shares its time: strokes at constant speeds, where there is time for them, and a periodic series for the rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.excitation.bounds import Bounds
from tau_dyn.excitation.series import Series
from tau_dyn.model import Model
from tau_dyn.simulate import (
    RATE_HZ,
    MotionProfile,
    Trajectory,
    build_stroke_motion,
    compute_reach,
    describe_exceeded_limit,
)

PERIOD_S = 10.0
"""Length of a period, about [s]."""
_STROKES_S = 6.0  # s per stroke; a joint that moves slower shows mostly friction
_MIN_HARMONICS = 3  # of a Fourier series: position, velocity and acceleration apart from each other


class MotionLayout(NamedTuple):
    """The strokes, if there is time for them, and the series that fills the rest."""

    after: Trajectory | None
    series: Series


def lay_out(bounds: Bounds, duration: float, fast_hz: float, share: float) -> MotionLayout:
    """Return what of the duration [s] is strokes, a share of it, and what is the series, up to a frequency [Hz].

    Raises:
        InputError: The share is none, or what is left for the series holds too few harmonics.
    """
    if not 0 <= share < 1:
        raise InputError("invalid_value", f"strokes take a share of the duration from 0 to below 1, not {share:g}")
    model, after = bounds.model, None
    if share * duration >= _STROKES_S - 1e-9:
        after = build_stroke_motion(model, round(share * duration, 3), 0)
        if _outside(bounds, after):
            after = None
    left = duration - (0.0 if after is None else after.duration)
    periods = max(1, round(left / PERIOD_S))
    harmonics = int(np.floor(fast_hz * left / periods + 1e-9))
    if harmonics < _MIN_HARMONICS:
        raise InputError(
            "invalid_value",
            f"{fast_hz:g} Hz leaves {harmonics} harmonics in a period of {left / periods:.3g} s; a design needs at least "
            f"{_MIN_HARMONICS}: take a longer motion or a higher --fastest",
        )
    return MotionLayout(after, Series(model.robot.home, compute_reach(model), left / periods, harmonics, periods))


def _outside(bounds: Bounds, motion: Trajectory) -> bool:
    """Return whether strokes break a bound that they do not know of: the tool's box, accelerations, passive joints."""
    few = motion.every(max(1, motion.n_samples // 600))
    path = MotionProfile(few.q, few.v, few.a)
    found = [*bounds.of_states(path, np.zeros_like(few.q), []), *bounds.of_places(few.q, slopes=False)]
    return any(e.values.max() > 1e-9 for e in found)


def build_full_motion(model: Model, layout: MotionLayout, x: np.ndarray) -> Trajectory:
    """Return all periods and the strokes as one motion at 1 kHz."""
    after, series = layout
    t = np.arange(round(series.duration * RATE_HZ) + 1) / RATE_HZ
    path = series.path(series.waves(t), x)
    if after is not None:
        path = MotionProfile(
            *(np.concatenate([a[:-1], b]) for a, b in zip(path, (after.q, after.v, after.a), strict=True))
        )
    clock = np.arange(len(path.q)) / RATE_HZ
    motion = Trajectory(model.robot.actuated, clock, *path, "optimal")
    broken = describe_exceeded_limit(model, motion, condition=np.inf)
    if broken:
        raise InputError("unreachable", f"{model.robot.source}: the designed motion breaks a limit: {broken}")
    return motion
