"""Whether a log of a robot with a floating base is usable: its joints as ever, and the motion of its base.

A velocity of the base that is logged beside its pose is compared with the pose's own: in axes of the base, as it has to be, and
in axes of the world. Both look plausible; a robot that turns tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.legged.base_motion import ANGULAR, LINEAR, POSITION, QUATERNION, complete_base, read_rotation
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    CheckFinding,
    ColumnProposal,
    Log,
    LogCheck,
    check_log,
    differentiate,
    lowpass,
    propose_columns,
    read_any,
    resample_segments,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

_COMPARED_HZ = 5.0
"""Low-pass of both velocities before they are compared [Hz]: above it a pose's noise is most of its derivative."""
_CLEARER = 3.0
"""How many times better one frame explains a velocity than the other where there is no doubt."""


@dataclass(frozen=True)
class DrivenJoints:
    """The joints with a motor of a robot, as `check_log` and `propose_columns` take them; see `log.JointLimits`."""

    actuated: tuple[str, ...]
    joint_kinds: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(cls, robot: Robot) -> Self:
        """Take them from a robot."""
        first = len(robot.base_coordinates)
        return cls(robot.driven, robot.joint_kinds[first:], robot.lower[first:], robot.upper[first:])


def check_robot_log(log: Log, robot: Robot | None) -> LogCheck:
    """Return the check of a log against its robot; of a floating base with what is wrong with its motion."""
    if robot is None or not robot.base_coordinates:
        return check_log(log, robot)
    joints = {name: x for name, x in log.channels.items() if not name.startswith(("q_base_", "v_base_"))}
    checked = check_log(replace(log, channels=joints), DrivenJoints.of(robot))
    # joints leap where feet touch down, with no sample lost
    findings = [finding for finding in checked.findings if finding.code != "lost_samples"]
    try:
        complete_base(robot, [log])
    except InputError as fault:
        findings.append(CheckFinding("fault", "base", str(fault), "Log it, or name it in a map (--columns MAP.yaml)."))
    else:
        findings.append(CheckFinding("ok", "base", f"{log.name} has orientation and position or velocity of the base."))
        findings += [
            CheckFinding("fault" if w.code == "base_velocity_frame" else "warning", "base", str(w), code=w.code)
            for w in list_base_warnings(robot, log)
        ]
    return replace(checked, findings=tuple(findings))


def propose_robot_columns(path: str | Path, robot: Robot) -> ColumnProposal:
    """Return the column map proposed for a log of a robot; of a floating base with the columns of its base and feet.

    Those are taken under their own names alone; what is missing is listed, with lines to complete.

    Raises:
        InputError: The log cannot be read.
        CannotAnswer: No column but the clock holds numbers.
    """
    proposal = propose_columns(path, DrivenJoints.of(robot))
    if not robot.base_coordinates:
        return proposal
    there = read_any(Path(path)).cells
    feet = tuple(f"contact_{contact.frame}" for contact in robot.contacts)
    known = {name: name for name in (*POSITION, *QUATERNION, *LINEAR, *ANGULAR, *feet) if name in there}
    place = POSITION if not all(name in known for name in LINEAR) else ()
    missing = [name for name in (*place, *QUATERNION, *feet) if name not in known]
    if not missing:
        return replace(proposal, entries={**proposal.entries, **known})
    sentence = (
        f"No column is called {', '.join(missing)}: orientation and position of the base, and feet that touch the ground. "
        "Complete their lines in the map."
    )
    return replace(
        proposal,
        entries={**proposal.entries, **known},
        warnings=(*proposal.warnings, CodedWarning("column_missing", sentence)),
        template=(*proposal.template, *(f"# {name}: COLUMN" for name in missing)),
    )


def list_base_warnings(robot: Robot, log: Log) -> list[CodedWarning]:
    """Return what is doubtful about feet and base velocity of a log with an orientation of the base."""
    missing = [contact.frame for contact in robot.contacts if f"contact_{contact.frame}" not in log.channels]
    found = []
    if missing:
        listed = ", ".join(f"contact_{frame}" for frame in missing)
        found.append(
            CodedWarning(
                "contact_unknown",
                f"{log.name} has no {listed}: these feet count as touching the ground all the time, and the equations of "
                "their legs in the air are not used; log 0 or 1, or the force in N",
            )
        )
    pieces = resample_segments(log)
    longest = max(pieces, key=lambda piece: piece.n_samples, default=log)
    if longest.n_samples >= MIN_SEGMENT_SAMPLES:
        found += _compare_velocities(longest)
    return found


def _compare_velocities(log: Log) -> list[CodedWarning]:
    """Return a warning about each velocity of the base that agrees with the pose in axes of the world instead."""
    rotation, dt = read_rotation(log), log.dt
    cutoff = min(_COMPARED_HZ, 0.2 * log.rate_hz)
    found = []
    if all(name in log.channels for name in POSITION):
        world = differentiate(lowpass(_stack(log, POSITION), cutoff, log.rate_hz), dt)
        found += _compare(log, LINEAR, world, rotation, cutoff)
    turn = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / dt
    spin = lowpass(np.concatenate([turn, turn[-1:]]), cutoff, log.rate_hz)
    return found + _compare(log, ANGULAR, rotation.apply(spin), rotation, cutoff)


def _compare(
    log: Log, names: tuple[str, ...], world: np.ndarray, rotation: Rotation, cutoff: float
) -> list[CodedWarning]:
    if not all(name in log.channels for name in names):
        return []
    logged = lowpass(_stack(log, names), cutoff, log.rate_hz)
    ends = slice(len(logged) // 20, len(logged) - len(logged) // 20)
    in_base, in_world = (float(np.sqrt(np.mean((logged - x)[ends] ** 2))) for x in (rotation.inv().apply(world), world))
    if in_base <= _CLEARER * in_world:
        return []
    unit = "m/s" if names == LINEAR else "rad/s"
    return [
        CodedWarning(
            "base_velocity_frame",
            f"{log.name}: {', '.join(names)} are in axes of the world: they differ from the pose's velocity by {in_world:.2g} "
            f"{unit} there and by {in_base:.2g} {unit} in axes of the base, where they belong; turn them by the inverse of "
            "the base's orientation",
        )
    ]


def _stack(log: Log, names: tuple[str, ...]) -> np.ndarray:
    return np.column_stack([log.channels[name] for name in names])
