"""A tour as a RAPID module for ABB controllers, and as CSV.

Joint targets are what is driven to (`MoveAbsJ`: mm along slides, degrees about turning joints); robot targets stand
beside them for whoever reads. `next_pose` is persistent, so a program that was stopped goes on with the pose that it
had not measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.control.interface import (
    format_array,
    format_comment,
    format_jointtarget,
    format_robtarget,
    require_few_joints,
    require_rapid_name,
)
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, convert_to_quaternions


def format_rapid_module(
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
        raise InputError("missing_input", "there is no pose to write a RAPID module for")
    require_few_joints(kinds)
    require_rapid_name(name)
    joints = [format_jointtarget(row, kinds) for row in q]
    robots = [format_robtarget(p, r) for p, r in zip(tool.position, convert_to_quaternions(tool), strict=True)]
    k = len(q)
    lines = [
        f"MODULE {name}",
        format_comment(
            f"{(pose >= 0).sum()} calibration poses, {(pose < 0).sum()} places on the way; axes: {', '.join(actuated)}"
        ),
        f"  CONST num n_places := {k};",
        "  PERS num next_place := 1;",
        f"  CONST num pose_number{{{k}}} := [{', '.join(str(int(p) + 1) for p in pose)}];",
        *format_array("jointtarget places", joints),
        "  ! The tool at these places by the nominal robot, for the reader; nothing drives to them.",
        *format_array("robtarget expected", robots),
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


def format_tour_csv(q: np.ndarray, pose: np.ndarray, actuated: Sequence[str]) -> str:
    """Return a tour as CSV: `pose` (from 1; 0 on the way) and `q_J` [m or rad] of every joint."""
    head = ",".join(["pose", *(f"q_{joint}" for joint in actuated)])
    rows = [",".join([str(int(p) + 1), *(f"{x:.9g}" for x in row)]) for p, row in zip(pose, q, strict=True)]
    return "\n".join([head, *rows]) + "\n"
