"""A tour as a RAPID module for ABB controllers, and as CSV.

Joint targets are what is driven to (`MoveAbsJ`: mm along slides, degrees about turning joints); robot targets stand
beside them for whoever reads. `next_pose` is persistent, so a program that was stopped goes on with the pose that it
had not measured.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.poses import Poses, quaternions

_UNUSED = "9E9"
_AXES = 6
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")


def rapid_module(
    q: np.ndarray,
    pose: np.ndarray,
    tool: Poses,
    kinds: Sequence[str],
    *,
    actuated: Sequence[str] = (),
    name: str = "CalibrationPoses",
    wait: float = 1.0,
    speed: str = "v100",
) -> str:
    """Return a RAPID module's text.

    Args:
        q: Actuated positions in the order of the tour (k, na) [m or rad].
        pose: Number of the pose measured there (k,), from 0; -1 on the way.
        tool: Tool poses there (k) in the robot's base frame.
        kinds: `prismatic` or `revolute` of each joint.
        actuated: Names of the joints, for the comment.
        name: Of the module.
        wait: Time to settle before measuring [s].
        speed: RAPID speed data.

    Raises:
        InputError: More than twelve joints, a name that RAPID does not take, or nothing to drive to.
    """
    if not len(q):
        raise InputError("there is no pose to write a RAPID module for")
    if len(kinds) > 2 * _AXES:
        raise InputError(f"a RAPID jointtarget holds 12 axes; this robot has {len(kinds)} actuated joints")
    if not _NAME.fullmatch(name):
        raise InputError(f"'{name}' is no name for a RAPID module: a letter, then letters, digits and _, at most 32")
    joints = [_jointtarget(row, kinds) for row in q]
    robots = [_robtarget(p, r) for p, r in zip(tool.position, quaternions(tool), strict=True)]
    k = len(q)
    lines = [
        f"MODULE {name}",
        f"  ! {int((pose >= 0).sum())} calibration poses, {int((pose < 0).sum())} places on the way; "
        f"axes: {', '.join(actuated)}",
        f"  CONST num n_places := {k};",
        "  PERS num next_place := 1;",
        f"  CONST num pose_number{{{k}}} := [{', '.join(str(int(p) + 1) for p in pose)}];",
        f"  CONST jointtarget places{{{k}}} := [",
        ",\n".join(f"    {text}" for text in joints),
        "  ];",
        "  ! The tool at these places by the nominal robot, for the reader; nothing drives to them.",
        f"  CONST robtarget expected{{{k}}} := [",
        ",\n".join(f"    {text}" for text in robots),
        "  ];",
        "",
        "  PROC main()",
        "    ! next_place survives a stop: the program goes on where it was. Set it to 1 to start anew.",
        "    WHILE next_place <= n_places DO",
        f"      MoveAbsJ places{{next_place}} \\NoEOffs, {speed}, fine, tool0;",
        "      IF pose_number{next_place} > 0 measure_pose pose_number{next_place};",
        "      next_place := next_place + 1;",
        "    ENDWHILE",
        '    TPWrite "All poses measured";',
        "  ENDPROC",
        "",
        "  PROC measure_pose(num k)",
        "    ! Trigger the measuring device here.",
        f"    WaitTime \\InPos, {wait:g};",
        '    TPWrite "Measure pose " \\Num:=k;',
        "  ENDPROC",
        "ENDMODULE",
    ]
    return "\n".join(lines) + "\n"


def tour_csv(q: np.ndarray, pose: np.ndarray, actuated: Sequence[str]) -> str:
    """Return a tour as CSV: `pose` (from 1; 0 on the way) and `q_J` [m or rad] of every joint."""
    head = ",".join(["pose", *(f"q_{joint}" for joint in actuated)])
    rows = [",".join([str(int(p) + 1), *(f"{x:.9g}" for x in row)]) for p, row in zip(pose, q, strict=True)]
    return "\n".join([head, *rows]) + "\n"


def _jointtarget(row: np.ndarray, kinds: Sequence[str]) -> str:
    values = [f"{1e3 * x if kind == 'prismatic' else np.rad2deg(x):.4f}" for x, kind in zip(row, kinds, strict=True)]
    robot = values[:_AXES] + ["0"] * (_AXES - len(values[:_AXES]))
    external = values[_AXES:] + [_UNUSED] * (_AXES - len(values[_AXES:]))
    return f"[[{','.join(robot)}],[{','.join(external)}]]"


def _robtarget(position: np.ndarray, quaternion: np.ndarray) -> str:
    place = ",".join(f"{1e3 * x:.4f}" for x in position)
    turn = ",".join(f"{x:.8f}" for x in np.roll(quaternion, 1))  # RAPID writes the scalar first
    return f"[[{place}],[{turn}],[0,0,0,0],[{','.join([_UNUSED] * _AXES)}]]"
