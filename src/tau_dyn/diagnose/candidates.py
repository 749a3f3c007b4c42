"""Random pieces that a proposal is put together from: every kind of motion, at other speeds and frequencies each time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.simulate import (
    Trajectory,
    build_fourier_motion,
    build_multisine_on_stroke,
    build_random_binary_motion,
    build_slow_motion,
    build_stroke_motion,
    compute_top_speed,
)

_Maker = Callable[[Model, float, int, np.random.Generator], Trajectory]


def _fourier(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return sines, the lowest 0.05 to 0.2 Hz, the highest 0.4 to 3 Hz."""
    slow, fast = 0.05 * 4 ** rng.uniform(), 0.4 * 7.5 ** rng.uniform()
    return build_fourier_motion(model, duration, seed, harmonics=int(rng.integers(3, 8)), slow_hz=slow, fast_hz=fast)


def _very_slow(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return strokes of 0.3 to 6 % of the highest speed."""
    return build_stroke_motion(
        model, duration, seed, speeds=tuple(np.geomspace(0.003, 0.06, 6) * rng.uniform(0.7, 1.4, 6))
    )


def _strokes(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return strokes from slow to full speed."""
    lowest = 0.01 * 20 ** rng.uniform()
    return build_stroke_motion(model, duration, seed, speeds=tuple(np.geomspace(lowest, 1.0, int(rng.integers(4, 9)))))


def _multisine(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return strokes with a multisine of a band between 1 and 14 Hz riding on them."""
    low = rng.uniform(1.0, 4.0)
    return build_multisine_on_stroke(model, duration, seed, band_hz=(low, rng.uniform(low + 3, 14.0)))


def _slow(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return slow circles of 1 to 30 % of the highest speed, a reversal a second."""
    return build_slow_motion(
        model, duration, seed, speed=float(compute_top_speed(model).min()) * 0.01 * 30 ** rng.uniform()
    )


def _binary(model: Model, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    """Return random binary speeds of 10 to 90 %."""
    return build_random_binary_motion(model, duration, seed, share=0.1 * 9 ** rng.uniform())


_KINDS: tuple[_Maker, ...] = (_fourier, _very_slow, _strokes, _binary, _slow, _multisine)


def build_candidate_pieces(model: Model, duration: float, count: int, rng: np.random.Generator) -> list[Trajectory]:
    """Return `count` motions of this length [s], kinds in turn; those that the robot's limits forbid are left out.

    Raises:
        InputError: The limits forbid all of them, or they are too short.
    """
    found, fault = [], None
    for k in range(count):
        try:
            found.append(_KINDS[k % len(_KINDS)](model, duration, int(rng.integers(2**31)), rng))
        except InputError as error:
            fault = error
    if not found:
        raise fault or InputError("invalid_value", "a motion is chosen among at least one trial")
    return found
