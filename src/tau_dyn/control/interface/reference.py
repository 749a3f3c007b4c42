"""Reference files: positions, speeds and accelerations of the drives, a row for each of the controller's samples.

CSV with the columns of every motion file here, `t`, `q_ref_J`, `v_ref_J`, `a_ref_J` [s, m or rad, per s, per s^2], so that
`simulate` reads it too.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from tau_dyn.control.interface.check import check_motion
from tau_dyn.control.interface.limits import CommandLimits
from tau_dyn.control.interface.period import DEFAULT_PERIOD_S, require_period, resample_to_period
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory


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
