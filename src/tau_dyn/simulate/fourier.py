"""Fourier motions: each joint a finite sum of sines of its own, by chance or chosen to make parameters visible.

    q_j(t) = home_j + w(t) sum_h A_jh sin(2 pi f_jh t + phi_jh),

with a smooth window `w` that starts and ends at rest. Low harmonics are as large as the range allows, high ones as fast as
the speed allows. `build_exciting_motion` tries many and keeps the one whose base regressor, with columns of unit length, has the
smallest condition number. Reference: Swevers et al. 1997; Gautier & Khalil 1992 (the criterion).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.estimate import find_base
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.simulate.limits import scale_to_limits
from tau_dyn.simulate.profiles import MotionProfile, apply_window, build_window
from tau_dyn.simulate.trajectory import Trajectory

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
        seed: Of the amplitudes and phases.
        harmonics: Sines a joint.
        slow_hz: Lowest frequency [Hz]; joint j's are higher by up to 10 %, so that joints do not repeat each other.
        fast_hz: Highest frequency [Hz].

    Raises:
        InputError: The motion is too short, or nothing around home is within the limits.
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
    """Return the best conditioned of `trials` random Fourier motions; its note says the condition number.

    Raises:
        InputError: As `build_fourier_motion`; or fewer than one trial is asked for.
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
