"""References at the controller's sample period: files of positions, speeds and accelerations, a row a sample.

CSV with the columns of every motion file here, `t`, `q_ref_J`, `v_ref_J`, `a_ref_J` [s, m or rad, per s, per s^2], so that
`simulate` reads it too.

The controller's sample period: a file that has another one is refused; resampling is asked for, and checked.

The extended IRC5 takes a reference every 4 ms (thesis 3.2). A file at another period would be played too fast or too slow,
with speeds that nobody checked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tau_dyn.control.interface.limits import CommandLimits, check_motion
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory

DEFAULT_PERIOD_S = 0.004
"""Sample period of the thesis' controller [s]."""

_JITTER = 1e-3  # share of the period; clocks written with four digits pass
_KEPT = 1e-3  # share of each joint's travel that resampling may change


def require_period(t: np.ndarray, period: float, name: str) -> None:
    """Refuse a clock (N,) [s] that is not the controller's.

    Raises:
        InputError: Its steps are uneven, or of another size; the message says which.
    """
    steps = np.diff(t)
    mean = float((t[-1] - t[0]) / len(steps))
    worst = int(np.argmax(np.abs(steps - mean)))
    if abs(steps[worst] - mean) > _JITTER * mean:
        raise InputError(
            "time_stamps",
            f"{name}: its samples are not even ({1e3 * steps[worst]:.4g} ms after sample {worst + 1}, {1e3 * mean:.4g} ms in the "
            "mean); resample it",
        )
    if abs(mean - period) > _JITTER * period:
        raise InputError(
            "time_stamps",
            f"{name}: it has a sample every {1e3 * mean:.6g} ms, the controller takes one every {1e3 * period:.6g} ms and would "
            f"play it {mean / period:.3g} times as fast; resample it, or say the controller's period",
        )


def resample_to_period(motion: Trajectory, period: float, *, resample: bool = False) -> Trajectory:
    """Return a motion on the controller's clock from zero.

    Args:
        motion: The motion.
        period: The controller's period [s].
        resample: Allow another clock: every n-th sample where the period is n of the motion's, else the quintic spline through
            the samples.

    Raises:
        InputError: The period is another one and resampling was not asked for, or it would lose part of the motion.
    """
    if not 0 < period < 1:
        raise InputError(
            "invalid_value", f"a controller's sample period is a positive number of seconds below 1, not {period:g}"
        )
    if not resample:
        require_period(motion.t, period, motion.name)
    n = count_samples_in_period(motion, period)
    found = motion.resampled(1 / period) if n in (0, 1) else _take_every(motion, n, period)
    if len(found.t) < 6:
        raise InputError(
            "too_little_data",
            f"{motion.name} lasts {motion.duration:g} s, {len(found.t)} samples of {1e3 * period:g} ms; too short",
        )
    left = motion.duration - found.duration
    if left > _JITTER * period:  # the last sample falls between two of the controller's: end where the motion ends
        found = _ended(motion, period)
    _require_kept(motion, found, period)
    return found


def count_samples_in_period(motion: Trajectory, period: float) -> int:
    """Return how many of the motion's samples make one period of the controller; 0 where no whole number does."""
    step = motion.duration / (motion.n_samples - 1)
    n = round(period / step)
    even = np.abs(np.diff(motion.t) - step).max() <= _JITTER * step
    return n if n >= 1 and even and abs(n * step - period) <= _JITTER * period else 0


def _take_every(motion: Trajectory, n: int, period: float) -> Trajectory:
    """Return every n-th sample as it is; the last one is held until the controller's next sample."""
    keep = np.minimum(np.arange(0, motion.n_samples + n - 1, n), motion.n_samples - 1)
    t = np.arange(len(keep)) * period
    return replace(motion, t=t, q=motion.q[keep], v=motion.v[keep], a=motion.a[keep])


def _ended(motion: Trajectory, period: float) -> Trajectory:
    """Return the motion with its last position held until the controller's next sample."""
    t, q = motion.t - motion.t[0], motion.q
    n = int(np.ceil(t[-1] / period - 1e-9))
    held = np.arange(1, 7)[:, None] * np.median(np.diff(t))
    longer = Trajectory.through(
        motion.joints, np.r_[t, t[-1] + held[:, 0]], np.r_[q, np.repeat(q[-1:], 6, axis=0)], motion.name
    )
    found = longer.resampled(1 / period)
    keep = slice(0, n + 1)
    return replace(found, t=found.t[keep], q=found.q[keep], v=found.v[keep], a=found.a[keep], notes=motion.notes)


def _require_kept(motion: Trajectory, found: Trajectory, period: float) -> None:
    """Refuse a clock too slow for the motion: its samples of position, speed and acceleration must lead there in between."""
    at = motion.t - motion.t[0]
    inside = at <= found.t[-1]
    off = np.abs(found.interpolate(at[inside])[0] - motion.q[inside]).max(axis=0)
    allowed = _KEPT * np.maximum(np.ptp(motion.q, axis=0), 1e-9)
    if np.any(off > allowed):
        k = int(np.argmax(np.round(off / allowed, 6)))
        raise InputError(
            "invalid_value",
            f"{motion.name}: samples every {1e3 * period:g} ms would miss joint {motion.joints[k]} by up to {off[k]:.3g} "
            f"({100 * off[k] / np.ptp(motion.q[:, k]):.2g} % of its stroke); the motion is too fast for this period",
        )


def build_reference(
    model: Model,
    motion: Trajectory,
    *,
    period: float = DEFAULT_PERIOD_S,
    resample: bool = False,
    limits: CommandLimits | None = None,
) -> Trajectory:
    """Return a motion as a controller may be given it.

    Args:
        model: Robot and effects.
        motion: The motion.
        period: The controller's sample period [s].
        resample: Allow interpolation where the motion has another period.
        limits: By default the robot file's.

    Raises:
        InputError: The sample period is another one, or a limit is broken.
    """
    found = resample_to_period(motion, period, resample=resample)
    check_motion(model, found, limits)
    return found


def write_reference(
    path: str | Path,
    model: Model,
    motion: Trajectory,
    *,
    period: float = DEFAULT_PERIOD_S,
    resample: bool = False,
    limits: CommandLimits | None = None,
) -> None:
    """Write a reference file, the whole of it or none; see `build_reference` for arguments and refusals."""
    build_reference(model, motion, period=period, resample=resample, limits=limits).to_csv(path)


def read_reference(path: str | Path, joints: Sequence[str], *, period: float = DEFAULT_PERIOD_S) -> Trajectory:
    """Read a reference file.

    Args:
        path: The file.
        joints: Drives, in the order of the columns wanted.
        period: The controller's sample period [s].

    Raises:
        InputError: It cannot be read, or its sample period is another one.
    """
    found = Trajectory.from_csv(path, joints)
    require_period(found.t, period, found.name)
    return found


def compute_digest(motion: Trajectory) -> str:
    """Return what tells a motion from another: a hash of joints, period and positions as a file holds them (12 digits)."""
    period = (motion.t[-1] - motion.t[0]) / (motion.n_samples - 1)
    words = [*motion.joints, f"{period:.9g}", *map("%.12g".__mod__, motion.q.ravel().tolist())]
    return hashlib.sha256(",".join(words).encode()).hexdigest()[:16]
