"""Reference motions by name, each suited to some parameters, all within the robot's limits and at rest at their ends.

    fourier     random Fourier series: masses, and friction at all speeds
    exciting    the best conditioned of many of them
    slow        small slow circles with many reversals: friction at low speed, stiction, backlash
    strokes     constant speeds in both directions: the friction law, ripple
    multisine   2-14 Hz multisine riding on constant speed: resonances, unhidden by reversals
    prbs        random binary speeds with smooth ramps: masses, delays

Motions are built about `robot.home`; if they meet a limit or a singularity they are scaled towards home, and `Trajectory.notes`
reports it. Speeds go up to 1 m/s or 2 rad/s, accelerations to about 6 m/s^2 or 12 rad/s^2. A Fourier motion is

    q_j(t) = home_j + w(t) sum_h A_jh sin(2 pi f_jh t + phi_jh),

with a smooth window `w`; low harmonics are as large as the range allows, high ones as fast as the speed allows. The exciting one
has the base regressor, with columns of unit length, of the smallest condition number. Reference: Swevers et al. 1997;
Gautier & Khalil 1992 (the criterion).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from tau_dyn.estimate import find_base
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.model import Model
from tau_dyn.simulate.limits import scale_to_limits
from tau_dyn.simulate.trajectory import (
    TURNING,
    MotionProfile,
    Segment,
    Trajectory,
    apply_window,
    build_speed_profile,
    build_stroke_profile,
    build_window,
    compute_ramp_time,
)

RATE_HZ = 1000.0
"""Sampling rate of generated motions [Hz]."""


def compute_reach(model: Model) -> np.ndarray:
    """Return how far each joint may go from home to both sides (na,): 95 % of the room, 0.4 m or 1 rad without limits."""
    robot = model.robot
    room = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    default = np.where([unit == "m" for unit in robot.position_units], 0.4, 1.0)
    if np.any(room <= 0):
        joint = robot.actuated[int(np.argmin(room))]
        raise InputError(
            "unreachable",
            f"{robot.source}: home of joint {joint} is not inside its range, so no motion around it is possible",
        )
    return np.where(np.isfinite(room), 0.95 * room, default)


def compute_top_speed(model: Model) -> np.ndarray:
    """Return the highest speed motions aim at (na,): 90 % of the limit, at most 1 m/s or 2 rad/s."""
    default = np.where([unit == "m" for unit in model.robot.position_units], 1.0, 2.0)
    return np.minimum(0.9 * model.robot.velocity_limit, default)


def build_clock(duration: float, shortest: float, name: str) -> np.ndarray:
    """Return times (N,) [s] at 1 kHz; a motion shorter than `shortest` [s] is refused."""
    if not shortest <= duration <= 3600:
        raise InputError(
            "invalid_value", f"a {name} motion takes between {shortest:g} s and an hour, not {duration:g} s"
        )
    return np.arange(round(duration * RATE_HZ) + 1) / RATE_HZ


def shift_to_home(model: Model, t: np.ndarray, path: MotionProfile, name: str) -> Trajectory:
    """Return home plus a path (N, na) as a trajectory."""
    return Trajectory(model.robot.actuated, t, model.robot.home + path.q, path.v, path.a, name)


def build_fourier_motion(
    model: Model,
    duration: float = 20.0,
    seed: int = 0,
    *,
    harmonics: int = 5,
    slow_hz: float = 0.15,
    fast_hz: float = 1.2,
) -> Trajectory:
    """Return a random Fourier motion within the robot's limits that starts and ends at rest at home.

    Args:
        model: Robot and friction; both count for limits.
        duration: Length [s], at least 4.
        seed: Seed of the amplitudes and phases.
        harmonics: Sines a joint.
        slow_hz: Lowest frequency [Hz]; joint j's are higher by up to 10 %, so that joints do not repeat each other.
        fast_hz: Highest frequency [Hz].

    Raises:
        InputError: The motion is too short, or no motion around home is within the limits.
    """
    t = build_clock(duration, 4.0, "fourier")
    rng = np.random.default_rng(seed)
    na = model.robot.na
    f = np.linspace(slow_hz, fast_hz, harmonics) * (1 + 0.1 * np.arange(na)[:, None] / na)
    widest, fastest = compute_reach(model)[:, None], compute_top_speed(model)[:, None]
    amplitude = rng.uniform(0.3, 1.0, f.shape) * np.minimum(widest, fastest / (2 * np.pi * f))
    path = apply_window(
        sum_sines(t, f, amplitude, rng.uniform(0, 2 * np.pi, f.shape)),
        build_window(t, duration, min(1.0, duration / 4)),
    )
    full = _at_limits(path, compute_reach(model), compute_top_speed(model))
    return scale_to_limits(
        model, lambda x: shift_to_home(model, t, MotionProfile(*(x * p for p in full)), "fourier"), "fourier"
    )


def build_exciting_motion(
    model: Model, duration: float = 20.0, seed: int = 0, *, trials: int = 30, harmonics: int = 5
) -> Trajectory:
    """Return the best conditioned of `trials` random Fourier motions; its note reports the condition number.

    Raises:
        InputError: As `build_fourier_motion`; or fewer than one trial is requested.
    """
    if trials < 1:
        raise InputError("invalid_value", f"a search needs at least one trial, not {trials}")
    seeds = np.random.default_rng(seed).integers(2**31, size=trials)  # neighbouring seeds must not share trials
    motions = [build_fourier_motion(model, duration, int(k), harmonics=harmonics) for k in seeds]
    conditions = [compute_base_condition(model, motion) for motion in motions]
    best = motions[int(np.argmin(conditions))]
    note = (
        f"the best of {trials} Fourier motions: condition number {min(conditions):.3g} of the base regressor with unit "
        f"columns (median {np.median(conditions):.3g})"
    )
    return replace(best, name="exciting", notes=(*best.notes, note))


def compute_base_condition(model: Model, motion: Trajectory, samples: int = 400) -> float:
    """Return the condition number of the base regressor along a motion, columns scaled to unit length.

    Columns are those of the free parameters that a single state shows, dependent ones regrouped (Gautier 1991).
    """
    model = model.steady()
    few = motion.every(motion.n_samples // samples)
    free = [p for p in model.parameters if p.free]
    W = model.regressor(few.q, few.v, few.a)[:, :, model.parameters.free].reshape(-1, len(free))
    base = find_base(W, tuple(p.name for p in free), units=[p.unit for p in free])
    if base.rank == 0:
        return np.inf
    kept = W[:, base.kept]
    return float(np.linalg.cond(kept / np.linalg.norm(kept, axis=0)))


def sum_sines(t: np.ndarray, f: np.ndarray, amplitude: np.ndarray, phase: np.ndarray) -> MotionProfile:
    """Return sums of sines (N, na); frequencies, amplitudes and phases are (na, n)."""
    w = 2 * np.pi * f
    angle = t[:, None, None] * w + phase
    sine, cosine = np.sin(angle), np.cos(angle)
    return MotionProfile(*((amplitude * x).sum(axis=2) for x in (sine, w * cosine, -(w**2) * sine)))


def _at_limits(path: MotionProfile, widest: np.ndarray, fastest: np.ndarray) -> MotionProfile:
    """Scale each joint (N, na) to its full range or full speed, whichever comes first."""
    gain = np.minimum(widest / np.max(np.abs(path.q), axis=0), fastest / np.max(np.abs(path.v), axis=0))
    return MotionProfile(*(gain * x for x in path))


ACCELERATION = 6.0
"""Peak acceleration of ramps, as a multiple of the highest speed a second."""
HOLD_S = (0.25, 0.9)
"""Shortest and longest time of one speed in a random binary motion [s]."""
STROKE_SHARE = 0.3
"""Speed of the strokes under a multisine, as a share of the highest."""


def build_slow_motion(model: Model, duration: float = 20.0, seed: int = 0, *, speed: float | None = None) -> Trajectory:
    """Return a small slow circle: each joint the same sine, their phases spread over a turn.

    Args:
        model: The robot.
        duration: Length [s], at least 4.
        seed: Seed of the common phase.
        speed: Highest speed [m/s or rad/s]; by default 6 % of the fastest motions', at about one reversal a second.
    """
    t = build_clock(duration, 4.0, "slow")
    na, fastest = model.robot.na, compute_top_speed(model)
    speeds = 0.06 * fastest if speed is None else np.full(na, float(speed))
    f = 0.5 * (1 + 0.05 * np.arange(na)[:, None])
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(na)[:, None] / na
    path = apply_window(sum_sines(t, f, speeds[:, None] / (2 * np.pi * f), phase), build_window(t, duration, 1.0))
    return scale_to_limits(
        model, lambda x: shift_to_home(model, t, MotionProfile(*(x * p for p in path)), "slow"), "slow"
    )


def build_stroke_motion(
    model: Model, duration: float = 40.0, seed: int = 0, *, speeds: Sequence[float] = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
) -> Trajectory:
    """Return round trips at constant speeds, all joints together, then against each other, then each alone.

    Args:
        model: The robot.
        duration: Length [s], at least 6; speeds are repeated in other patterns until it is filled, then it rests.
        seed: Seed of the speeds' order.
        speeds: Shares of the highest speed (1 m/s, 2 rad/s, or 90 % of the limit), each driven in both directions.

    If the travel is too short for a speed, the speed is lowered; if it is too long for a slow one, the trip is shortened to
    about a second in each direction.
    """
    t = build_clock(duration, 6.0, "strokes")
    shares = np.random.default_rng(seed).permutation(np.asarray(speeds, float))
    return scale_to_limits(
        model, lambda x: shift_to_home(model, t, _strokes(model, t, shares, x, 0.6)[0], "strokes"), "strokes"
    )


def build_multisine_on_stroke(
    model: Model, duration: float = 30.0, seed: int = 0, *, band_hz: tuple[float, float] = (2.0, 14.0), lines: int = 24
) -> Trajectory:
    """Return strokes at 30 % of the highest speed, in the patterns of `build_stroke_motion`, with a multisine riding on them.

    Args:
        model: The robot.
        duration: Length [s], at least 6.
        seed: Seed of the phases.
        band_hz: Lowest and highest frequency of the multisine [Hz].
        lines: Number of frequencies of each joint; joints alternate along the band, so their responses can be separated.

    Lines have equal acceleration. Together they stay below 60 % of the stroke's speed, so only the stroke reverses.
    """
    t = build_clock(duration, 6.0, "multisine")
    na, fastest, rng = model.robot.na, compute_top_speed(model), np.random.default_rng(seed)
    f = band_hz[0] + (band_hz[1] - band_hz[0]) * (np.arange(lines) + np.arange(na)[:, None] / na) / lines
    ripple = sum_sines(t, f, 1 / (2 * np.pi * f) ** 2, rng.uniform(0, 2 * np.pi, f.shape))
    gain = 0.6 * STROKE_SHARE * fastest / np.max(np.abs(ripple.v), axis=0)

    def build(share: float) -> Trajectory:
        longest = (
            duration / (4 * np.ceil(duration / 6)) - 0.06 / share
        )  # of trips that fill the time; ramps take the rest
        stroke, end = _strokes(model, t, np.array([STROKE_SHARE]), share, max(longest, 0.2))
        riding = apply_window(MotionProfile(*(share * gain * x for x in ripple)), build_window(t, end, 1.0))
        return shift_to_home(
            model, t, MotionProfile(*(x + y for x, y in zip(stroke, riding, strict=True))), "multisine"
        )

    return scale_to_limits(model, build, "multisine")


def build_random_binary_motion(
    model: Model, duration: float = 20.0, seed: int = 0, *, share: float = 0.8
) -> Trajectory:
    """Return speeds that jump at random between two values, one random sequence a joint, with ramps a drive can follow.

    Args:
        model: The robot.
        duration: Length [s], at least 4.
        seed: Seed of the sequences.
        share: The speed as a share of the highest; lowered where the range is short.
    """
    t = build_clock(duration, 4.0, "prbs")
    widest, fastest = compute_reach(model), compute_top_speed(model)

    def build(scale: float) -> Trajectory:
        rng = np.random.default_rng(seed)
        paths = [
            _binary(t, scale * w, share * v, scale * ACCELERATION * v, rng)
            for w, v in zip(widest, fastest, strict=True)
        ]
        return shift_to_home(model, t, MotionProfile(*(np.column_stack(x) for x in zip(*paths, strict=True))), "prbs")

    return scale_to_limits(model, build, "prbs")


MOTIONS: dict[str, Callable[[Model, float, int], Trajectory]] = {
    "exciting": build_exciting_motion,
    "fourier": build_fourier_motion,
    "multisine": build_multisine_on_stroke,
    "prbs": build_random_binary_motion,
    "slow": build_slow_motion,
    "strokes": build_stroke_motion,
}
"""Every motion by the name that `simulate --motion` takes."""


def build_named_motion(name: str, model: Model, duration: float = 20.0, seed: int = 0) -> Trajectory:
    """Return the motion of that name, of a length [s], within the robot's limits.

    Raises:
        UnknownName: There is no such motion.
        InputError: It is too short, or no motion around home is within the limits.
    """
    if name not in MOTIONS:
        raise UnknownName("motion", name, MOTIONS)
    return MOTIONS[name](model, duration, seed)


def _strokes(
    model: Model, t: np.ndarray, shares: np.ndarray, scale: float, longest: float
) -> tuple[MotionProfile, float]:
    """Return round trips (N, na) through all speeds and patterns, and when the last one ends [s].

    Joints move together, then neighbours against each other, then (with several speeds) each joint alone.
    Along each trip the coordinate is time at the highest speed; `scale` shortens ways and softens ramps, speeds stay; half a way
    takes at most `longest` [s].
    """
    na, fastest = model.robot.na, compute_top_speed(model)
    together, against = np.ones(na), (-1.0) ** np.arange(na)
    patterns = [together] if na == 1 else [together, against, *(np.eye(na) if len(shares) > 1 else [])]
    room = scale * compute_reach(model) / fastest
    q, v, a = np.zeros((3, len(t), na))
    start = 0.0
    for k in count():
        pattern, speed = patterns[(k // len(shares)) % len(patterns)], float(shares[k % len(shares)])
        half = float(np.min(room[pattern != 0])) * (1.0 if pattern is together else 0.5)
        trip = build_stroke_profile(speed, min(half, longest * speed), ACCELERATION * scale)
        end = start + sum(s.duration for s in trip)
        if end > t[-1]:
            break
        now = (t >= start) & (t < end)
        for out, x in zip((q, v, a), build_speed_profile(t[now] - start, trip), strict=True):
            out[now] = x[:, None] * pattern * fastest
        start = end
    return MotionProfile(q, v, a), start


def _binary(t: np.ndarray, widest: float, speed: float, acceleration: float, rng: np.random.Generator) -> MotionProfile:
    """Return a random binary speed (N,) that stays within `widest` of its start and is at rest at both ends."""
    speed = min(speed, float(np.sqrt(widest * acceleration / 8)))
    stop = compute_ramp_time(speed, acceleration)
    segments, place, now = [Segment(0.1, 0.0, 0.0)], 0.0, 0.0
    overshoot = TURNING * stop  # time at full speed that a reversal still goes on for
    while True:
        hold = min(float(rng.uniform(*HOLD_S)), 0.5 * widest / speed)
        wish = float(rng.choice((-speed, speed)))
        for new in (wish, -wish):  # one of them always leads inwards
            ramp = Segment(compute_ramp_time(new - now, acceleration) or 0.5 * hold, now, new)
            ends = place + ramp.distance + new * hold
            if abs(ends + new * overshoot) <= widest:
                break
        if sum(s.duration for s in segments) + ramp.duration + hold + stop > t[-1]:
            return build_speed_profile(t, [*segments, Segment(stop, now, 0.0)])
        segments += [ramp, Segment(hold, new, new)]
        place, now = ends, new
