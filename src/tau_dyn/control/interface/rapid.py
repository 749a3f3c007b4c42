r"""A motion as a RAPID module: a list of places with the time to reach each, by `MoveAbsJ` (drives) or `MoveL` (tool).

The robot's own controller interpolates between the places, so fewer than one every 4 ms are needed: those between which a
straight line, in the drives or in the tool's path, leaves the motion by less than a tolerance, but no move is shorter than
`MIN_MOVE_S`. `\T` gives each move its time. Corner paths (zonedata) round the places, up to half-way to the next one. Use a
reference file for motions that must be followed exactly.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, convert_to_quaternions, forward_kinematics
from tau_dyn.robot import Robot
from tau_dyn.simulate import Trajectory

UNUSED = "9E9"
AXES = 6  # robot axes of a robtarget, and also its external axes (RAPID reference manual)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_RESERVED = frozenset(
    "alias and backward case connect const default div do else elseif endfor endfunc endif endmodule endproc endrecord "
    "endtest endtrap endwhile error exit false for from func goto if inout local mod module nostepin not noview or pers "
    "proc raise readonly record retry return step sysmodule task test then to trap true trynext undo var viewonly while "
    "with xor".split()
)


def require_rapid_name(name: str, what: str = "a RAPID module") -> str:
    """Return a name that is valid in RAPID.

    Raises:
        InputError: The name is not valid, or is a word of the language.
    """
    if not _NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise InputError(
            "invalid_value",
            f"'{name}' is no name for {what}: a letter, then letters, digits and _, at most 32, no word of RAPID",
        )
    return name


def require_few_joints(kinds: Sequence[str]) -> None:
    """Refuse a robot with more drives than a joint target holds.

    Raises:
        InputError: More than twelve joints.
    """
    if len(kinds) > 2 * AXES:
        raise InputError(
            "unsupported", f"a RAPID jointtarget holds 12 axes; this robot has {len(kinds)} actuated joints"
        )


def format_jointtarget(row: np.ndarray, kinds: Sequence[str]) -> str:
    """Return positions (na,) [m or rad] as a joint target: mm along slides, degrees about turns, 9E9 for axes not there."""
    values = [f"{1e3 * x if kind == 'prismatic' else np.rad2deg(x):.4f}" for x, kind in zip(row, kinds, strict=True)]
    robot = values[:AXES] + ["0"] * (AXES - len(values[:AXES]))
    external = values[AXES:] + [UNUSED] * (AXES - len(values[AXES:]))
    return f"[[{','.join(robot)}],[{','.join(external)}]]"


def format_robtarget(position: np.ndarray, quaternion: np.ndarray) -> str:
    """Return a place (3,) [m] and a quaternion x y z w as a robot target: mm, the quaternion's scalar first."""
    place = ",".join(f"{1e3 * x:.4f}" for x in position)
    turn = ",".join(f"{x:.8f}" for x in np.roll(quaternion, 1))
    return f"[[{place}],[{turn}],[0,0,0,0],[{','.join([UNUSED] * AXES)}]]"


def format_array(declaration: str, rows: Sequence[str]) -> list[str]:
    """Return lines that declare a constant array, one row per line."""
    return [f"  CONST {declaration}{{{len(rows)}}} := [", ",\n".join(f"    {row}" for row in rows), "  ];"]


def format_comment(text: str) -> str:
    """Return a comment line; characters that are not printable ASCII become question marks."""
    return f"  ! {re.sub(r'[^ -~]', '?', text)}"


MAX_WAYPOINTS = 4000
"""Most places of a module."""

MIN_MOVE_S = 0.1
"""Shortest move [s]: a controller plans the next move in about 0.1 s (ABB, RAPID Reference Manual, Basic Characteristics,
p. 6-28). A place whose next move is not planned in time becomes a stop (p. 6-21; event 50024, corner path failure), and
places too close are refused (event 50078; github.com/ros-industrial/abb, issue 185)."""


class Waypoints(NamedTuple):
    """Places of a motion between which a controller moves straight.

    Attributes:
        index: Samples of the motion (k,).
        path: Positions that move straight: drives (N, na) [m or rad], or the tool (N, 3) [m].
        poses: Poses of the tool at all samples; None if the robot has no tool and the drives move straight.
        deviation: Largest deviation of the straight moves from the path [m or rad].
    """

    index: np.ndarray
    path: np.ndarray
    poses: Poses | None
    deviation: float


def format_rapid_motion(
    robot: Robot,
    motion: Trajectory,
    *,
    by: str = "joints",
    tolerance: float = 1e-4,
    name: str = "TauDynMotion",
    tool: str = "tool0",
    wobj: str = "wobj0",
) -> str:
    """Return a motion as a RAPID module.

    Args:
        robot: The robot.
        motion: The motion, corrections included; see `apply_correction`.
        by: 'joints' for `MoveAbsJ`, 'tool' for `MoveL`.
        tolerance: Largest deviation of straight lines between the places from the motion [m or rad]; for `MoveL` it applies to
            the tool's position. `MIN_MOVE_S` has priority over it.
        name: Name of the module.
        tool: RAPID tool data; with 'tool' it must be the robot file's tool frame.
        wobj: RAPID work object; with 'tool' the robot's base.

    Raises:
        InputError: A name that RAPID does not take, joints that are not the robot's, or too many places.
    """
    for text, what in ((name, "a RAPID module"), (tool, "RAPID tool data"), (wobj, "a RAPID work object")):
        require_rapid_name(text, what)
    found = build_waypoints(robot, motion, by=by, tolerance=tolerance)
    places = motion.q[found.index]
    rows, kind = [format_jointtarget(row, robot.joint_kinds) for row in places], "jointtarget"
    if by == "tool" and found.poses is not None:
        few = found.poses.take(found.index)
        turns = convert_to_quaternions(few)
        rows = [format_robtarget(p, r) for p, r in zip(few.position, turns, strict=True)]
        kind = "robtarget"
    seconds = [f"{x:.4f}" for x in np.diff(motion.t[found.index], prepend=motion.t[0])]
    return "\n".join(_module(robot, motion, name, kind, rows, seconds, found, (tool, wobj))) + "\n"


def build_waypoints(robot: Robot, motion: Trajectory, *, by: str = "joints", tolerance: float = 1e-4) -> Waypoints:
    """Return the places of a motion; see `format_rapid_motion`.

    Raises:
        InputError: Joints that are not the robot's, more than twelve of them, or too many places.
    """
    require_few_joints(robot.joint_kinds)
    if by not in ("joints", "tool"):
        raise InputError("invalid_value", f"a RAPID motion goes by 'joints' or by 'tool', not by '{by}'")
    if motion.joints != robot.actuated:
        raise InputError(
            "mismatch", f"{motion.name} moves {', '.join(motion.joints)}, the robot has {', '.join(robot.actuated)}"
        )
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise InputError("invalid_value", f"the tolerance of a RAPID motion must be above zero, not {tolerance:g}")
    poses = None
    if by == "tool" or robot.tool_frame is not None:
        poses = forward_kinematics(robot, motion.q).poses
        if not np.isfinite(poses.position).all():
            raise InputError(
                "unreachable", f"{motion.name}: it leaves the robot's reach, so there is no tool path to write"
            )
    path = poses.position if by == "tool" and poses is not None else motion.q
    index = select_waypoints(motion.t, path, tolerance)
    straight = np.column_stack([np.interp(motion.t, motion.t[index], x) for x in path[index].T])
    return Waypoints(index, path, poses, float(np.abs(straight - path).max()))


def select_waypoints(t: np.ndarray, path: np.ndarray, tolerance: float) -> np.ndarray:
    """Return indices of the samples (k,) between which straight lines in time stay within a tolerance of a path (N, m).

    The next place is the farthest sample that a line reaches within the tolerance, found by doubling and halving, but not
    earlier than the first sample after `MIN_MOVE_S`; a shorter remainder joins the last move.

    Raises:
        InputError: More than 4000 are needed.
    """
    keep = [0]
    while keep[-1] < len(t) - 1:
        if len(keep) >= MAX_WAYPOINTS:
            raise InputError(
                "invalid_value",
                f"a RAPID module of more than {MAX_WAYPOINTS} places is asked for; allow a larger tolerance, or cut the motion",
            )
        soonest = int(np.searchsorted(t, t[keep[-1]] + MIN_MOVE_S * (1 - 1e-9)))
        keep.append(min(max(soonest, _farthest(t, path, keep[-1], tolerance)), len(t) - 1))
    if len(keep) > 2 and t[keep[-1]] - t[keep[-2]] < MIN_MOVE_S * (1 - 1e-9):
        del keep[-2]
    return np.array(keep)


def _farthest(t: np.ndarray, path: np.ndarray, start: int, tolerance: float) -> int:
    good, step = start + 1, 2
    while start + step < len(t) and _straight(t, path, start, start + step, tolerance):
        good, step = start + step, 2 * step
    low, high = good, min(start + step, len(t) - 1)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if _straight(t, path, start, middle, tolerance) else (low, middle - 1)
    return low


def _straight(t: np.ndarray, path: np.ndarray, a: int, b: int, tolerance: float) -> bool:
    share = ((t[a : b + 1] - t[a]) / (t[b] - t[a]))[:, None]
    line = path[a] + share * (path[b] - path[a])
    return bool(np.abs(path[a : b + 1] - line).max() <= tolerance)


def _format_zones(found: Waypoints) -> list[str]:
    """Return corner paths up to half-way to the nearer neighbour if the tool's path is known, else the smallest zone."""
    if found.poses is None:
        return ["[FALSE,0.3,0.3,0.3,0.03,0.3,0.03]"] * len(found.index)
    way = 1e3 * np.linalg.norm(np.diff(found.poses.position[found.index], axis=0), axis=1)
    half = np.minimum(np.r_[way[:1], way], np.r_[way, way[-1:]]) / 2
    return [f"[FALSE,{r:.2f},{r:.2f},{r:.2f},{r / 10:.3f},{r:.2f},{r / 10:.3f}]" for r in np.maximum(half, 0.3)]


def _module(
    robot: Robot,
    motion: Trajectory,
    name: str,
    kind: str,
    rows: list[str],
    seconds: list[str],
    found: Waypoints,
    frames: tuple[str, str],
) -> list[str]:
    tool, wobj = frames
    joints = kind == "jointtarget"
    option, move = (" \\NoEOffs", "MoveAbsJ") if joints else ("", "MoveL")
    end = f"{tool};" if joints else f"{tool} \\WObj:={wobj};"
    units = ", ".join(
        f"{j} [{'mm' if k == 'prismatic' else 'deg'}]" for j, k in zip(robot.actuated, robot.joint_kinds, strict=True)
    )

    def target(k: str) -> str:
        return f"places{{{k}}}{option}"

    return [
        f"MODULE {name}",
        format_comment(f"{motion.name}: {motion.duration:.4g} s in {len(rows)} places"),
        format_comment(
            f"moves of {MIN_MOVE_S:g} s or more; straight lines leave the motion by up to {found.deviation:.2g} m or rad"
        ),
        format_comment(f"axes: {units}" if joints else "places of the tool in the robot's base, mm; quaternions"),
        f"  CONST num n_places := {len(rows)};",
        *format_array(f"{kind} places", rows),
        format_comment("Time to reach each place from the one before, s."),
        *format_array("num seconds", seconds),
        format_comment("Corner path at each place, up to half-way to the next one, mm and deg."),
        *format_array("zonedata zones", _format_zones(found)),
        "",
        "  PROC main()",
        *([] if joints else ["    ConfL \\Off;"]),
        f"    {'MoveAbsJ' if joints else 'MoveJ'} {target('1')}, v100, fine, {end}",
        "    FOR k FROM 2 TO n_places - 1 DO",
        f"      {move} {target('k')}, v1000 \\T:=seconds{{k}}, zones{{k}}, {end}",
        "    ENDFOR",
        f"    {move} {target('n_places')}, v1000 \\T:=seconds{{n_places}}, fine, {end}",
        "  ENDPROC",
        "ENDMODULE",
    ]
