"""Design of the most informative motion for a model's parameters within the robot's limits, and its predicted errors.

A design is a periodic Fourier series, repeated, then strokes at constant speeds in both directions if there is time for them;
all of it starts and ends at rest at home. The search (`search.py`) optimises the series for the criterion over series and
strokes together; at the end the standard errors are predicted at the log's full rate (`information.py`), for the design and for
the best of the random motions that it started from.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError, UnknownName
from tau_dyn.excitation.bounds import Bounds
from tau_dyn.excitation.information import (
    CRITERIA,
    Information,
    InformationPrediction,
    Noise,
    compute_information_matrix,
    predict,
)
from tau_dyn.excitation.search import MotionSearch, Series, Stopped
from tau_dyn.model import Model
from tau_dyn.simulate import (
    ACCELERATION,
    RATE_HZ,
    MotionProfile,
    Trajectory,
    build_stroke_motion,
    compute_reach,
    compute_top_speed,
    describe_exceeded_limit,
)

PERIOD_S = 10.0
"""Length of a period, about [s]."""
_STROKES_S = 6.0  # s per stroke; a slower joint shows mostly friction
_MIN_HARMONICS = 3  # of a Fourier series, to separate position, velocity and acceleration


class MotionLayout(NamedTuple):
    """The strokes, if there is time for them, and the series that fills the rest."""

    after: Trajectory | None
    series: Series


def lay_out(bounds: Bounds, duration: float, fast_hz: float, share: float) -> MotionLayout:
    """Return the layout of a duration [s]: strokes for a share of it, and the series, up to a frequency [Hz], for the rest.

    Raises:
        InputError: The share is not from 0 to below 1, or the rest for the series holds too few harmonics.
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
    """Return whether strokes violate a bound that their design ignores: the tool's box, accelerations, passive joints."""
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


SHORTEST_S, LONGEST_S = 4.0, 3600.0
_BAND = 8.0  # the low-pass of forces is this many times the highest harmonic, about
_GRID, _FEWEST_SAMPLES = 10, 200


@dataclass(frozen=True, eq=False)
class ExcitationDesign:
    """A designed motion.

    Attributes:
        motion: The motion.
        prediction: Its predicted standard errors.
        before: Those of the best random motion that the search started from.
        criterion: Name of the criterion.
        values: The criterion at the start and at the end.
        evaluations: Number of evaluations of the model along a period.
        seconds: Duration of the search [s].
        finished: Whether the search converged, instead of being stopped by time or by the user.
        noise: The assumed noise.
        search: Summary of the search in a sentence.
    """

    motion: Trajectory
    prediction: InformationPrediction
    before: InformationPrediction
    criterion: str
    values: tuple[float, float]
    evaluations: int
    seconds: float
    finished: bool
    noise: Noise
    search: str


def design_motion(
    model: Model,
    duration: float = 30.0,
    seed: int = 0,
    *,
    criterion: str = "worst",
    noise: Noise | None = None,
    trials: int = 20,
    fast_hz: float = 2.0,
    strokes: float = 0.2,
    speed: Sequence[float] | None = None,
    acceleration: Sequence[float] | None = None,
    box: Sequence[float] | None = None,
    condition: float | None = None,
    seconds: float = 90.0,
    rate_hz: float = 1000.0,
    progress: Callable[[str], None] = lambda step: None,
) -> ExcitationDesign:
    """Design a motion.

    Args:
        model: The model to be identified; its values give the forces and the scales of errors.
        duration: Length [s], 4 to 3600.
        seed: Seed of the random motions that the search starts from.
        criterion: 'worst' (largest relative error), 'd' (volume of the confidence ellipsoid) or 'condition'.
        noise: Noise of forces and encoders; by default that of good drives.
        trials: Random motions to start from.
        fast_hz: Highest frequency of the periodic part [Hz].
        strokes: Share of the duration for strokes at constant speeds; they are omitted if it is below 6 s.
        speed: Highest speeds, one for all joints or one for each; by default 90 % of the limit, at most 1 m/s or 2 rad/s.
        acceleration: Highest accelerations; by default 6 times the highest speed per second.
        box: Lowest and highest corner of the tool's box (6,) [m].
        condition: Largest conditioning of the loops; by default five times home's, at least 20.
        seconds: Time for the search [s].
        rate_hz: Rate of the log to come [Hz], if no noise is given.
        progress: Callback that receives a sentence from time to time.

    Raises:
        InputError: An argument is invalid, or the limits permit no motion.
        CannotAnswer: No free parameter affects the forces.
    """
    begun = time.monotonic()
    _refuse(criterion, trials, duration)
    model, rng = model.steady(), np.random.default_rng(seed)
    bounds = _bounds(model, speed, acceleration, box, condition)
    layout = lay_out(bounds, duration, fast_hz, strokes)
    samples = max(_FEWEST_SAMPLES, _GRID * layout.series.harmonics)
    first = _generic(model, layout.series, samples, rng)
    noise = noise or Noise.typical(model, model.torque(*first), rate_hz)
    information = _information(model, noise, fast_hz, first)
    search = MotionSearch(
        layout.series,
        information,
        bounds,
        CRITERIA[criterion],
        information.prior + _of_strokes(information, layout.after, noise.rate_hz),
        noise.rate_hz,
        samples,
        begun + seconds,
        progress,
    )
    start, value, finished = _searched(search, rng, trials)
    if search.best is None or start is None:
        raise InputError(
            "unreachable", f"{model.robot.source}: no motion around home was found within the limits in {seconds:g} s"
        )
    motions = [build_full_motion(model, layout, x) for x in (search.best, start)]
    taken = time.monotonic() - begun
    try:
        told, before = (
            predict(
                model,
                motion,
                noise,
                seed,
                driven=True,
                progress=lambda share, k=k: progress(f"predicting errors: {50 * (k + share):.0f} %"),
            )
            for k, motion in enumerate(motions)
        )
    except KeyboardInterrupt:  # the user stopped the simulation
        told, before = (predict(model, motion, noise, seed) for motion in motions)
    return ExcitationDesign(
        motions[0] if finished else replace(motions[0], notes=(_STOPPED,)),
        told,
        before,
        criterion,
        (value, search.value),
        search.evaluations,
        taken,
        finished,
        noise,
        _describe_search(search, criterion, value, taken),
    )


def _refuse(criterion: str, trials: int, duration: float) -> None:
    if criterion not in CRITERIA:
        raise UnknownName("criterion", criterion, CRITERIA)
    if trials < 1:
        raise InputError("invalid_value", f"a search needs at least one random motion to start from, not {trials}")
    if not SHORTEST_S <= duration <= LONGEST_S:
        raise InputError(
            "invalid_value", f"an optimal motion takes between {SHORTEST_S:g} s and an hour, not {duration:g} s"
        )


def _bounds(
    model: Model,
    speed: Sequence[float] | None,
    acceleration: Sequence[float] | None,
    box: Sequence[float] | None,
    condition: float | None,
) -> Bounds:
    fastest = _per_joint(model, "speed", speed, compute_top_speed(model))
    quickest = _per_joint(model, "acceleration", acceleration, ACCELERATION * compute_top_speed(model))
    corners = None if box is None else np.reshape(box, (2, 3))
    return Bounds.of(model, compute_reach(model), fastest, quickest, corners, condition)


def _searched(search: MotionSearch, rng: np.random.Generator, trials: int) -> tuple[np.ndarray | None, float, bool]:
    """Search until it converges, the time is over or the user stops it.

    Returns:
        Coefficients and criterion of the random motion that it started from, and whether the search converged.
    """
    finished = True
    try:
        search.start(rng, trials)
    except KeyboardInterrupt:
        finished = False
    start, value = search.best, search.value
    try:
        if finished and start is not None:
            search.improve(start)
    except (Stopped, KeyboardInterrupt):
        finished = False
    return start, value, finished


def _generic(model: Model, series: Series, samples: int, rng: np.random.Generator) -> MotionProfile:
    """Return a random path (samples, na) that the loops allow."""
    x, waves = series.random(rng), series.waves(series.period * np.arange(samples) / samples)
    for _ in range(60):
        path = series.path(waves, x)
        try:
            model.mechanism.condition(path.q)
        except LoopClosureError:
            x = 0.9 * x
        else:
            return path
    raise InputError(
        "unreachable", f"{model.robot.source}: the loops do not close anywhere around home, so no motion is possible"
    )


def _information(model: Model, noise: Noise, fast_hz: float, path: MotionProfile) -> Information:
    """Return the builder of white rows, with the filters that identification will probably choose."""
    force_hz = min(_BAND * fast_hz, 0.16 * noise.rate_hz)
    position_hz = min(8 * force_hz, 0.4 * noise.rate_hz)
    gain = 2 * np.pi * position_hz * np.sqrt(2 * position_hz / noise.rate_hz / 3)  # of white encoder noise, low-passed
    slow = np.maximum(10 * gain * noise.encoder, 1e-3 * np.max(np.abs(path.v), axis=0))
    return Information.of(model, noise.weighing(model, force_hz), 2 / position_hz, slow, path)


def _of_strokes(information: Information, motion: Trajectory | None, rate_hz: float) -> np.ndarray | float:
    if motion is None:
        return 0.0
    step = max(1, motion.n_samples // 2000)
    few = motion.every(step)
    return compute_information_matrix(information.rows(MotionProfile(few.q, few.v, few.a))) * rate_hz * step / RATE_HZ


def _per_joint(model: Model, name: str, given: Sequence[float] | None, default: np.ndarray) -> np.ndarray:
    if given is None:
        return default
    x = np.asarray(given, float).ravel()
    if len(x) not in (1, model.robot.na) or not np.all(x > 0):
        raise InputError(
            "wrong_shape",
            f"the highest {name} must be a positive number, or one for each of {', '.join(model.robot.actuated)}",
        )
    return np.broadcast_to(x, (model.robot.na,)).copy()


_STOPPED = "the search was stopped before it had settled; the motion is the best so far"
_MINIMISED = {
    "worst": "log of the largest relative standard error",
    "d": "minus the mean log information",
    "condition": "half the log of the condition number",
}
"""Value that each criterion minimises, in words."""


def _describe_search(search: MotionSearch, criterion: str, before: float, seconds: float) -> str:
    series = search.series
    return (
        f"{series.periods} periods of {series.period:.4g} s with {series.harmonics} harmonics up to "
        f"{series.harmonics / series.period:.3g} Hz; criterion '{criterion}' ({_MINIMISED[criterion]}) from {before:.4g} to "
        f"{search.value:.4g} in {search.evaluations} evaluations and {seconds:.0f} s"
    )
