"""Learned corrections: a signal added to the drives' references, and its derivative added to their speeds (thesis 3.5).

A file names the motion on which it was learnt (a hash of its reference) and the sample period. A correction is refused for
another motion, at another period or beyond its limits. Columns `t`, `dq_J`, `dv_J` [s, m or rad, per s].
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.control.interface.reference import (
    DEFAULT_PERIOD_S,
    CommandLimits,
    check_motion,
    compute_digest,
    require_period,
)
from tau_dyn.control.iterative import LearningHistory, UpdateLaw
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes, write_whole
from tau_dyn.log import read_table
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory

_HEAD = re.compile(r"# correction of motion ([0-9a-f]{16}), a sample every ([0-9.e+-]+) s\s*")


@dataclass(frozen=True, eq=False)
class Correction:
    """A signal that is added to a reference.

    Attributes:
        joints: Drives.
        dt: Sample period [s].
        dq: Correction of the positions (N, na) [m or rad].
        motion: Hash of the reference that it belongs to.
    """

    joints: tuple[str, ...]
    dt: float
    dq: np.ndarray
    motion: str

    def __post_init__(self) -> None:
        """Refuse values that are not a valid signal."""
        if (
            self.dq.ndim != 2
            or self.dq.shape[1] != len(self.joints)
            or len(self.dq) < 2
            or not np.isfinite(self.dq).all()
        ):
            raise InputError(
                "wrong_shape",
                f"a correction of {len(self.joints)} joints is finite and (N, {len(self.joints)}), not {self.dq.shape}",
            )
        if not self.dt > 0:
            raise InputError("invalid_value", f"a correction's sample period must be positive, not {self.dt:g} s")

    @property
    def dv(self) -> np.ndarray:
        """Added to speeds (N, na) [m/s or rad/s]: central differences, at rest before and after."""
        wide = np.pad(self.dq, ((1, 1), (0, 0)))
        return (wide[2:] - wide[:-2]) / (2 * self.dt)


def build_correction(done: LearningHistory, law: UpdateLaw, joints: Sequence[str], *, trial: int = -1) -> Correction:
    """Return the correction of a trial, as a correction of the drives.

    Args:
        done: Result of `learn`.
        law: The learning law that was used; it maps a tool's correction to the drives.
        joints: Names of the drives.
        trial: Index of the trial; the last one by default.
    """
    q = law.side.commands(done.motion, done.corrections[trial])
    return Correction(tuple(joints), done.motion.dt, q - done.motion.q, compute_digest(_reference(done, joints)))


def _reference(done: LearningHistory, joints: Sequence[str]) -> Trajectory:
    t = np.arange(done.motion.n) * done.motion.dt
    return Trajectory.through(joints, t, done.motion.q)


def apply_correction(
    model: Model, reference: Trajectory, correction: Correction, limits: CommandLimits | None = None
) -> Trajectory:
    """Return a reference with its correction, checked as a whole.

    Raises:
        InputError: The correction belongs to another motion, joints or period, or a limit is broken.
    """
    limits = CommandLimits.of(model.robot) if limits is None else limits
    require_same_motion(reference, correction)
    _require_small(correction, limits, model.robot.position_units)
    q = reference.q + correction.dq
    found = Trajectory.through(reference.joints, reference.t, q, f"{reference.name} with its correction")
    check_motion(model, found, limits)
    return found


def require_same_motion(reference: Trajectory, correction: Correction) -> None:
    """Refuse a correction that belongs to another motion.

    Raises:
        InputError: Joints, period, length or the motion itself differ; the message names the difference.
    """
    if correction.joints != reference.joints:
        raise InputError(
            "mismatch",
            f"the correction is for {', '.join(correction.joints)}, the motion moves {', '.join(reference.joints)}",
        )
    require_period(reference.t, correction.dt, f"{reference.name}, for a correction every {1e3 * correction.dt:g} ms")
    if len(correction.dq) != reference.n_samples:
        raise InputError(
            "mismatch", f"the correction has {len(correction.dq)} samples, {reference.name} has {reference.n_samples}"
        )
    if correction.motion != compute_digest(reference):
        raise InputError(
            "mismatch",
            f"the correction was learnt on another motion ({correction.motion}) than {reference.name} "
            f"({compute_digest(reference)})",
        )


def write_correction(
    path: str | Path,
    model: Model,
    reference: Trajectory,
    correction: Correction,
    *,
    period: float = DEFAULT_PERIOD_S,
    limits: CommandLimits | None = None,
) -> None:
    """Write a correction file atomically.

    Args:
        path: The file.
        model: Robot and effects.
        reference: The motion that it belongs to.
        correction: The correction.
        period: The controller's sample period [s].
        limits: Limits; default: those of the robot file, with corrections up to 10 deg of a turning drive and 10 mm of a slide.

    Raises:
        InputError: See `apply_correction`; or the controller has another sample period.
    """
    require_period(reference.t, period, reference.name)
    apply_correction(model, reference, correction, limits)
    write_whole(path, format_correction_text(correction))


def format_correction_text(correction: Correction) -> str:
    """Return a correction file's text."""
    columns = {"t": np.arange(len(correction.dq)) * correction.dt}
    for signal, values in (("dq", correction.dq), ("dv", correction.dv)):
        columns |= {f"{signal}_{j}": values[:, k] for k, j in enumerate(correction.joints)}
    head = f"# correction of motion {correction.motion}, a sample every {correction.dt!r} s\n"
    return head + pd.DataFrame(columns).to_csv(index=False, float_format="%.12g", lineterminator="\n")


def read_correction(path: str | Path, joints: Sequence[str], *, period: float = DEFAULT_PERIOD_S) -> Correction:
    """Read a correction file.

    Raises:
        InputError: It cannot be read, is no correction, or its sample period is not the controller's.
    """
    table = read_table(path)
    first = read_bytes(path).partition(b"\n")[0]
    head = _HEAD.fullmatch(first.decode("utf-8", "replace"))
    if head is None:
        raise InputError(
            "file_format",
            f"{table.name}: its first line does not name the motion that it corrects; it is no correction file",
        )
    t = table.numbers("t")
    if len(t) < 2:
        raise InputError("too_little_data", f"{table.name}: a correction has at least two samples, not {len(t)}")
    require_period(t, period, table.name)
    dq = np.column_stack([table.numbers(f"dq_{j}") for j in joints])
    return Correction(tuple(joints), period, dq, head[1])


def _require_small(correction: Correction, limits: CommandLimits, units: Sequence[str]) -> None:
    excess = np.abs(correction.dq) - limits.correction
    k, j = divmod(int(np.argmax(excess)), excess.shape[1])
    if excess[k, j] > 0:
        factor, unit = (np.rad2deg(1.0), "deg") if units[j] == "rad" else (1e3, "mm")
        raise InputError(
            "invalid_value",
            f"the correction of joint {correction.joints[j]} is {factor * correction.dq[k, j]:.4g} {unit} at sample {k + 1} and "
            f"may be no more than {factor * limits.correction[j]:.4g} {unit}",
        )
    jump = np.abs(np.diff(np.pad(correction.dq, ((1, 1), (0, 0))), axis=0)) / correction.dt
    k, j = divmod(int(np.argmax(jump - limits.speed)), jump.shape[1])
    if jump[k, j] > limits.speed[j]:
        raise InputError(
            "invalid_value",
            f"the correction of joint {correction.joints[j]} jumps at sample {k + 1}: {jump[k, j]:.4g} {units[j]}/s, the drive "
            f"may no more than {limits.speed[j]:.4g}; fade it in and out",
        )
