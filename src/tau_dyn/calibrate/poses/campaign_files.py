"""Files of a campaign: a RAPID module for ABB controllers, CSV, and the progress of a campaign that can be interrupted.

In RAPID, the robot moves to joint targets (`MoveAbsJ`: mm along slides, degrees about turning joints); robot targets are
written next to them for the reader. `next_place` is persistent: a program that was stopped goes on with the pose it had not
measured. The robot does not drive to a touch, because the nominal robot would miss it or collide: the program stops at the place
before.

The progress file is JSON, numbers in m and rad, one entry for every place of the tour, written whole or not at all after every
pose. Killed at any point, a campaign loses at most the pose that was being measured.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.calibrate.measured import TOUCHES, PoseSet
from tau_dyn.control.interface import (
    format_array,
    format_comment,
    format_jointtarget,
    format_robtarget,
    require_few_joints,
    require_rapid_name,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import read_bytes, write_whole
from tau_dyn.mechanism import Poses, convert_from_quaternions, convert_to_quaternions


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
    cells: Sequence[Mapping[str, str]] = (),
) -> str:
    """Return a RAPID module's text.

    Args:
        q: Actuated positions in the order of the tour (k, na) [m or rad].
        pose: Number of the pose measured there (k,), from 0; -1 on the way.
        tool: Tool poses there (k) in the robot's base frame.
        kinds: `prismatic` or `revolute` of each joint.
        actuated: Names of the joints, for the comment.
        name: Name of the module.
        wait: Time to settle before measuring [s].
        speed: RAPID speed data.
        cells: Cells of a measurement file that name the device or fixture at each place, as `FixtureSet.get_cells`.

    Raises:
        InputError: More than twelve joints, a name that RAPID does not take, or an empty tour.
    """
    if not len(q):
        raise InputError("missing_input", "there is no pose to write a RAPID module for")
    require_few_joints(kinds)
    require_rapid_name(name)
    joints = [format_jointtarget(row, kinds) for row in q]
    robots = [format_robtarget(p, r) for p, r in zip(tool.position, convert_to_quaternions(tool), strict=True)]
    k = len(q)
    touches = [next((f"{kind} {row[kind]}" for kind in TOUCHES if kind in row), "") for row in cells]
    lines = [
        f"MODULE {name}",
        format_comment(
            f"{(pose >= 0).sum()} calibration poses, {(pose < 0).sum()} places on the way; axes: {', '.join(actuated)}"
        ),
        f"  CONST num n_places := {k};",
        "  PERS num next_place := 1;",
        f"  CONST num pose_number{{{k}}} := [{', '.join(str(int(p) + 1) for p in pose)}];",
        *format_array("jointtarget places", joints),
        "  ! The tool at these places by the nominal robot, for the reader; the robot does not drive to them.",
        *format_array("robtarget expected", robots),
        *(format_array("string touches", [_format_string(text) for text in touches]) if any(touches) else ()),
        "",
        "  PROC main()",
        "    ! next_place survives a stop: the program goes on where it was. Set it to 1 to start again.",
        "    WHILE next_place <= n_places DO",
        *(_TOUCH if any(touches) else ()),
        f"      MoveAbsJ places{{next_place}} \\NoEOffs, {speed}, fine, tool0;",
        "      IF pose_number{next_place} > 0 measure_pose pose_number{next_place};",
        *(("      ENDIF",) if any(touches) else ()),
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


_TOUCH = (
    '      IF touches{next_place} <> "" THEN',
    '        TPWrite "Jog until the target touches "+touches{next_place};',
    '        TPWrite "Note the joints, start again. Pose " \\Num:=pose_number{next_place};',
    "        Stop;",
    "      ELSE",
)
_MAX_STRING = 80  # characters of a RAPID string


def _format_string(text: str) -> str:
    """Return a RAPID string; characters that are no printable ASCII become question marks."""
    plain = re.sub(r"[^ -~]", "?", text).replace("\\", "?")
    return f'"{plain[:_MAX_STRING]}"'


def format_tour_csv(
    q: np.ndarray, pose: np.ndarray, actuated: Sequence[str], cells: Sequence[Mapping[str, str]] = ()
) -> str:
    """Return a tour as CSV: `pose` (from 1; 0 on the way) and `q_J` [m or rad] of every joint.

    With `cells` (k) further columns name the device or fixture of each pose. `distance_tool` and `q_J` of passive joints with
    encoders are left to be filled in.
    """
    stated = [column for column in ("device", *TOUCHES, "target") if any(column in row for row in cells)]
    more = ["distance_tool", *stated] if "device" in stated else stated
    more += sorted({column for row in cells for column in row if column.startswith("q_")})
    head = ",".join(["pose", *(f"q_{joint}" for joint in actuated), *more])
    rows = [
        ",".join([str(int(p) + 1), *(f"{x:.9g}" for x in row), *(own.get(column, "") for column in more)])
        for p, row, own in zip(pose, q, cells or ({},) * len(q), strict=True)
    ]
    return "\n".join([head, *rows]) + "\n"


_VERSION = 1  # version of the file format
_MAX_FILE_BYTES = 64 * 2**20  # [bytes]
Measure = Callable[[int, np.ndarray], "tuple[np.ndarray, np.ndarray | None] | None"]
"""Function of a pose's number and positions (na,) that returns the measured position (3,) and orientation (3, 3) or None;
None if the target was not seen."""


@dataclass(frozen=True, eq=False)
class CampaignProgress:
    """A plan and its progress.

    Attributes:
        actuated: Joints, in the order of `q`.
        q: Places of the tour (k, na).
        pose: Pose measured there (k,), -1 on the way.
        state: `open`, `measured` or `missed` of each place; of places on the way `open` or `passed`.
        position: Measured positions (k, 3) [m], nan where not measured.
        rotation: Measured orientations (k, 3, 3), nan where not measured.
        cells: Cells of a measurement file that name the device or fixture at each place, empty if there is one device.
    """

    actuated: tuple[str, ...]
    q: np.ndarray
    pose: np.ndarray
    state: tuple[str, ...]
    position: np.ndarray
    rotation: np.ndarray
    cells: tuple[dict[str, str], ...] = ()

    @property
    def left(self) -> np.ndarray:
        """Indices of the places still to be visited; places on the way only if a pose to be measured follows."""
        open_ = np.array([s == "open" for s in self.state])
        poses = np.flatnonzero(open_ & (self.pose >= 0))
        if not len(poses):
            return np.zeros(0, int)
        index = np.flatnonzero(open_)
        return index[index <= poses[-1]]

    def measured(self) -> PoseSet:
        """Return the measured poses."""
        index = np.array([k for k, s in enumerate(self.state) if s == "measured"], int)
        turned = len(index) > 0 and bool(np.isfinite(self.rotation[index]).all())
        names = tuple(f"pose {self.pose[k] + 1}" for k in index)
        rotation = self.rotation[index] if turned else None
        return PoseSet(self.q[index], self.position[index], rotation, names, source="measured so far")

    def with_result(self, place: int, found: tuple[np.ndarray, np.ndarray | None] | None) -> CampaignProgress:
        """Return the progress after a place was visited; `found` is None if no pose was measured."""
        state = list(self.state)
        if self.pose[place] >= 0:
            state[place] = "missed" if found is None else "measured"
        else:
            state[place] = "passed"
        position, rotation = self.position.copy(), self.rotation.copy()
        if found is not None:
            position[place] = found[0]
            if found[1] is not None:
                rotation[place] = found[1]
        return replace(self, state=tuple(state), position=position, rotation=rotation)

    def save(self, path: str | Path) -> None:
        """Write the file; it appears whole or not at all."""
        content = {
            "version": _VERSION,
            "actuated": list(self.actuated),
            "places": [self._row(k) for k in range(len(self.q))],
        }
        write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

    def _row(self, k: int) -> dict[str, Any]:
        row: dict[str, Any] = {"pose": int(self.pose[k]) + 1, "q": self.q[k].tolist(), "state": self.state[k]}
        if self.cells and self.cells[k]:
            row["cells"] = self.cells[k]
        if self.state[k] == "measured":
            row["position"] = self.position[k].tolist()
            if np.isfinite(self.rotation[k]).all():
                row["quaternion"] = convert_to_quaternions(Poses(self.position[k : k + 1], self.rotation[k : k + 1]))[
                    0
                ].tolist()
        return row


def build_new_progress(
    actuated: tuple[str, ...], q: np.ndarray, pose: np.ndarray, cells: tuple[dict[str, str], ...] = ()
) -> CampaignProgress:
    """Return a plan in which every place is open."""
    k = len(q)
    nothing = np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan)
    return CampaignProgress(actuated, q, pose, ("open",) * k, *nothing, cells)


def read_progress(path: str | Path, actuated: tuple[str, ...]) -> CampaignProgress:
    """Read a progress file.

    Raises:
        InputError: The file is no progress file, or belongs to another robot.
    """
    try:
        content = json.loads(read_bytes(path, _MAX_FILE_BYTES).decode("utf-8"))
        joints = tuple(map(str, content["actuated"]))
        rows = content["places"]
        if content["version"] != _VERSION:
            raise ValueError
        found = _read(joints, rows)
    except InputError:
        raise
    except FileNotFoundError as fault:
        raise InputError("file_not_found", f"{path}: no such file") from fault
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError("cannot_read", f"{path}: cannot be read as text ({fault})") from fault
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as fault:
        raise InputError(
            "file_format",
            f"{path} is no progress file of a calibration (JSON with actuated, places and version {_VERSION})",
        ) from fault
    if joints != actuated:
        raise InputError(
            "mismatch", f"{path} belongs to a robot with the joints {', '.join(joints)}, not {', '.join(actuated)}"
        )
    return found


def _read(joints: tuple[str, ...], rows: list[dict[str, Any]]) -> CampaignProgress:
    q = np.array([row["q"] for row in rows], float).reshape(len(rows), -1)
    pose = np.array([int(row["pose"]) - 1 for row in rows], int)
    state = tuple(str(row["state"]) for row in rows)
    if (
        q.shape[1] != len(joints)
        or not np.isfinite(q).all()
        or not set(state) <= {"open", "measured", "missed", "passed"}
    ):
        raise ValueError
    cells = tuple({str(column): str(word) for column, word in dict(row.get("cells", {})).items()} for row in rows)
    found = replace(build_new_progress(joints, q, pose, cells if any(cells) else ()), state=state)
    for k, row in enumerate(rows):
        if state[k] == "measured":
            found.position[k] = row["position"]
            if "quaternion" in row:
                found.rotation[k] = convert_from_quaternions(
                    found.position[k : k + 1], np.array([row["quaternion"]], float)
                ).rotation[0]
    return found


def run_campaign(plan: CampaignProgress, measure: Measure, path: str | Path) -> PoseSet:
    """Drive through a plan, or go on where an earlier call stopped.

    Args:
        plan: The plan; an existing progress file has precedence.
        measure: Function that drives to a place and measures; also called on the way, with pose -1; its result is then not used.
        path: Progress file, written after every place.

    Returns:
        The measured poses of all calls.

    Raises:
        InputError: The file belongs to another plan, or the plan is one of distances and touches.
        CannotAnswer: No pose was seen.
    """
    if any(plan.cells):
        raise InputError(
            "unsupported",
            "distances and touches are measured by hand; fill in the plan's CSV file and calibrate with it",
        )
    now = plan
    if Path(path).exists():
        now = read_progress(path, plan.actuated)
        if now.q.shape != plan.q.shape or not np.allclose(now.q, plan.q, atol=1e-9) or (now.pose != plan.pose).any():
            raise InputError(
                "mismatch", f"{path} belongs to another plan; name another file, or take the plan from this one"
            )
    else:
        now.save(path)
    for place in now.left:
        found = measure(int(now.pose[place]), now.q[place])
        now = now.with_result(int(place), found if now.pose[place] >= 0 else None)
        now.save(path)
    done = now.measured()
    if not done.n:
        raise CannotAnswer(
            "not_visible",
            f"none of the {int((plan.pose >= 0).sum())} poses was seen by the device",
            "another place for the device",
        )
    return done
