"""The motion that tells most about a model's parameters within the robot's limits, and what it will tell.

A design is a periodic Fourier series (`series.py`), repeated, then strokes at constant speeds in both directions; all of it
starts and ends at rest at home. The series is searched (`search.py`) for the criterion over series and strokes together; at the
end the standard errors are predicted at the log's full rate (`predict.py`), for the design and for the best of the random motions
that it started from.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError, UnknownName
from tau_dyn.excitation.bounds import Bounds
from tau_dyn.excitation.criteria import CRITERIA
from tau_dyn.excitation.information import Information, gram
from tau_dyn.excitation.noise import Noise
from tau_dyn.excitation.predict import Prediction, predict
from tau_dyn.excitation.search import Search, Stopped
from tau_dyn.excitation.series import Series
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory
from tau_dyn.simulate.fourier import RATE_HZ, reach, top_speed
from tau_dyn.simulate.limits import broken_limit
from tau_dyn.simulate.motions import ACCELERATION, stroke_motion
from tau_dyn.simulate.profiles import Path

PERIOD_S = 10.0
"""Length of a period, about [s]."""
SHORTEST_S, LONGEST_S = 4.0, 3600.0
_STROKES_S = 6.0
_FEWEST_HARMONICS = 3
_BAND = 8.0  # the low-pass of forces is this many times the highest harmonic, about
_GRID, _FEWEST_SAMPLES = 10, 200


@dataclass(frozen=True, eq=False)
class Design:
    """A designed motion.

    Attributes:
        motion: The motion.
        prediction: What it will tell.
        before: What the best random motion that the search started from would tell.
        criterion: Name of the criterion.
        values: The criterion at the start and at the end.
        evaluations: How often the model was evaluated along a period.
        seconds: How long the search took [s].
        finished: Whether the search ended by itself, not by time or by hand.
        noise: What was assumed.
    """

    motion: Trajectory
    prediction: Prediction
    before: Prediction
    criterion: str
    values: tuple[float, float]
    evaluations: int
    seconds: float
    finished: bool
    noise: Noise


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
) -> Design:
    """Design a motion.

    Args:
        model: What shall be identified; its values give forces and what errors are compared with.
        duration: Length [s], 4 to 3600.
        seed: Of the random motions that the search starts from.
        criterion: 'worst' (largest relative error), 'd' (volume of the confidence ellipsoid) or 'condition'.
        noise: Of forces and encoders; by default that of good drives.
        trials: Random motions to start from.
        fast_hz: Nothing in the periodic part is faster [Hz].
        strokes: Share of the duration for strokes at constant speeds; none below 6 s of them.
        speed: Highest speeds, one or one a joint; by default 90 % of the limit, at most 1 m/s or 2 rad/s.
        acceleration: Highest accelerations; by default 6 times the highest speed a second.
        box: Lowest and highest corner of the tool's box (6,) [m].
        condition: Largest conditioning of the loops; by default five times home's, at least 20.
        seconds: Time for the search [s].
        rate_hz: Rate of the log to come [Hz], where no noise is given.
        progress: Called with a sentence now and then.

    Raises:
        InputError: Something asked for cannot be, or the limits leave no motion.
        CannotAnswer: No free parameter shows.
    """
    begun = time.monotonic()
    if criterion not in CRITERIA:
        raise UnknownName("criterion", criterion, CRITERIA)
    if trials < 1:
        raise InputError(f"a search needs at least one random motion to start from, not {trials}")
    if not SHORTEST_S <= duration <= LONGEST_S:
        raise InputError(f"an optimal motion takes between {SHORTEST_S:g} s and an hour, not {duration:g} s")
    model, rng = model.steady(), np.random.default_rng(seed)
    fastest = _per_joint(model, "speed", speed, top_speed(model))
    quickest = _per_joint(model, "acceleration", acceleration, ACCELERATION * top_speed(model))
    bounds = Bounds.of(
        model, reach(model), fastest, quickest, None if box is None else np.reshape(box, (2, 3)), condition
    )
    after, series = _layout(model, duration, fast_hz, strokes, bounds)
    samples = max(_FEWEST_SAMPLES, _GRID * series.harmonics)
    waves = series.waves(series.period * np.arange(samples) / samples)
    first = _generic(model, series, waves, rng)
    noise = noise or Noise.typical(model, model.torque(*first), rate_hz)
    information = _information(model, noise, fast_hz, first)
    added = information.prior + (0.0 if after is None else _of_strokes(information, after, noise.rate_hz))
    search = Search(
        series, information, bounds, CRITERIA[criterion], added, noise.rate_hz, samples, begun + seconds, progress
    )
    finished = True
    progress(f"{trials} random motions")
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
    if search.best is None or start is None:
        raise InputError(f"{model.robot.source}: no motion around home was found within the limits in {seconds:g} s")
    progress("predicting")
    chosen, random = (_whole(model, series, x, after) for x in (search.best, start))
    taken = time.monotonic() - begun
    told, before = _errors(model, (chosen, random), noise, seed)
    notes = _notes(search, criterion, value, finished, taken)
    return Design(
        replace(chosen, notes=notes),
        told,
        before,
        criterion,
        (value, search.value),
        search.evaluations,
        taken,
        finished,
        noise,
    )


def _errors(
    model: Model, motions: tuple[Trajectory, Trajectory], noise: Noise, seed: int
) -> tuple[Prediction, Prediction]:
    """Return what both motions will tell, driven in simulation; without it where the user will not wait."""
    try:
        return predict(model, motions[0], noise, seed, driven=True), predict(
            model, motions[1], noise, seed, driven=True
        )
    except KeyboardInterrupt:
        return predict(model, motions[0], noise, seed), predict(model, motions[1], noise, seed)


def _layout(
    model: Model, duration: float, fast_hz: float, share: float, bounds: Bounds
) -> tuple[Trajectory | None, Series]:
    """Return the strokes, if there is time for them, and the series that fills the rest."""
    if not 0 <= share < 1:
        raise InputError(f"strokes take a share of the duration from 0 to below 1, not {share:g}")
    after = None
    if share * duration >= _STROKES_S - 1e-9:
        after = stroke_motion(model, round(share * duration, 3), 0)
        if _outside(bounds, after):
            after = None
    left = duration - (0.0 if after is None else after.duration)
    periods = max(1, round(left / PERIOD_S))
    harmonics = int(np.floor(fast_hz * left / periods + 1e-9))
    if harmonics < _FEWEST_HARMONICS:
        raise InputError(
            f"{fast_hz:g} Hz leaves {harmonics} harmonics in a period of {left / periods:.3g} s; a design needs at least "
            f"{_FEWEST_HARMONICS}: take a longer motion or a higher --fastest"
        )
    return after, Series(model.robot.home, reach(model), left / periods, harmonics, periods)


def _outside(bounds: Bounds, motion: Trajectory) -> bool:
    """Return whether strokes break a bound that they do not know of: the tool's box, accelerations, passive joints."""
    few = motion.every(max(1, motion.n_samples // 600))
    path = Path(few.q, few.v, few.a)
    found = [*bounds.of_states(path, np.zeros_like(few.q), []), *bounds.of_places(few.q, slopes=False)]
    return any(e.values.max() > 1e-9 for e in found)


def _generic(model: Model, series: Series, waves: Path, rng: np.random.Generator) -> Path:
    """Return a random path (n, na) that the loops allow."""
    x = series.random(rng)
    for _ in range(60):
        path = series.path(waves, x)
        try:
            model.mechanism.condition(path.q)
        except LoopClosureError:
            x = 0.9 * x
        else:
            return path
    raise InputError(f"{model.robot.source}: the loops do not close anywhere around home, so no motion is possible")


def _information(model: Model, noise: Noise, fast_hz: float, path: Path) -> Information:
    """Return what makes rows; filters are guessed as identification will choose them."""
    force_hz = min(_BAND * fast_hz, 0.16 * noise.rate_hz)
    position_hz = min(8 * force_hz, 0.4 * noise.rate_hz)
    gain = 2 * np.pi * position_hz * np.sqrt(2 * position_hz / noise.rate_hz / 3)  # of white encoder noise, low-passed
    slow = np.maximum(10 * gain * noise.encoder, 1e-3 * np.max(np.abs(path.v), axis=0))
    return Information.of(model, noise.weighing(model, force_hz), 2 / position_hz, slow, path)


def _of_strokes(information: Information, motion: Trajectory, rate_hz: float) -> np.ndarray:
    step = max(1, motion.n_samples // 2000)
    few = motion.every(step)
    return gram(information.rows(Path(few.q, few.v, few.a))) * rate_hz * step / RATE_HZ


def _whole(model: Model, series: Series, x: np.ndarray, after: Trajectory | None) -> Trajectory:
    """Return all periods and the strokes as one motion at 1 kHz."""
    t = np.arange(round(series.duration * RATE_HZ) + 1) / RATE_HZ
    path = series.path(series.waves(t), x)
    if after is not None:
        path = Path(*(np.concatenate([a[:-1], b]) for a, b in zip(path, (after.q, after.v, after.a), strict=True)))
    clock = np.arange(len(path.q)) / RATE_HZ
    motion = Trajectory(model.robot.actuated, clock, *path, "optimal")
    broken = broken_limit(model, motion, condition=np.inf)
    if broken:
        raise InputError(f"{model.robot.source}: the designed motion breaks a limit: {broken}")
    return motion


def _per_joint(model: Model, name: str, given: Sequence[float] | None, default: np.ndarray) -> np.ndarray:
    if given is None:
        return default
    x = np.asarray(given, float).ravel()
    if len(x) not in (1, model.robot.na) or not np.all(x > 0):
        raise InputError(
            f"the highest {name} must be a positive number, or one for each of {', '.join(model.robot.actuated)}"
        )
    return np.broadcast_to(x, (model.robot.na,)).copy()


def _notes(search: Search, criterion: str, before: float, finished: bool, seconds: float) -> tuple[str, ...]:
    series = search.series
    said = (
        f"{series.periods} periods of {series.period:.4g} s with {series.harmonics} harmonics up to "
        f"{series.harmonics / series.period:.3g} Hz; criterion '{criterion}' from {before:.4g} to {search.value:.4g} in "
        f"{search.evaluations} evaluations and {seconds:.0f} s"
    )
    return (
        (said,) if finished else (said, "the search was stopped before it had settled; the motion is the best so far")
    )
