"""Springs of rods and drives that a user states for a robot whose file has no springs, written into its file.

A rod's spring is a slide `<rod>_stretch` along the rod, without mass, where the rod meets the loop's ball joint; files that
have such a slide keep it and change its stiffness. A drive's spring is a `<tau_dyn:drive_spring>`. A stiffness of infinity
states that the part is rigid: its spring is removed. The robot with springs has the masses and the motion of the rigid one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import LoopSolver, get_rods
from tau_dyn.mechanism.flexible.file_masses import require_file_masses
from tau_dyn.robot import Robot, Spring, load_robot_from_urdf

_OURS = "{urn:tau_dyn}"
_DRAKE = ("{http://drake.mit.edu}", "{https://drake.mit.edu}")
_LIMIT = "0.05"
"""Travel of a rod's slide to either side [m], as in the flexible L1's file."""


def name_rod_spring(rod: str) -> str:
    """Return the name of the joint along which a rod yields."""
    return f"{rod}_stretch"


def state_springs(
    robot: Robot,
    *,
    rods: float | None = None,
    drives: Mapping[str, float] | None = None,
    drive_stderrs: Mapping[str, float] | None = None,
) -> Robot:
    """Return a robot with springs of these stiffnesses in its file, in place of those that it has there.

    Args:
        robot: The robot, with the masses of its file.
        rods: Stiffness of each rod with its joints [N/m], inf for rigid; None leaves the rods as they are.
        drives: Stiffness between drive and link by actuated joint [N/m or N m/rad], inf for rigid.
        drive_stderrs: Standard errors of the drives' stiffness by joint, not written by default.

    Raises:
        InputError: A stiffness is not above zero, the robot has no rods that can be given springs, or its masses are not
            its file's.
        UnknownName: A joint that is not actuated.
    """
    require_file_masses(robot)
    root = fromstring(robot.urdf, forbid_dtd=True)
    if rods is not None:
        _require_positive(rods, "a rod")
        _state_rods(robot, root, rods)
    for joint, stiffness in (drives or {}).items():
        if joint not in robot.actuated:
            raise UnknownName("actuated joint", joint, robot.actuated)
        _require_positive(stiffness, f"the drive of '{joint}'")
        _set_spring(root, "drive_spring", Spring(joint, stiffness, 0.0, (drive_stderrs or {}).get(joint)))
    return _load(robot, root)


def write_springs(robot: Robot, passive: Sequence[Spring], drives: Sequence[Spring]) -> Robot:
    """Return a robot whose file has these springs of passive joints and of drives, in place of those of the same joints.

    A damping below zero, which no spring has, is written as zero.

    Raises:
        InputError: A stiffness is not above zero, or the robot's masses are not its file's.
    """
    require_file_masses(robot)
    root = fromstring(robot.urdf, forbid_dtd=True)
    for tag, springs in (("spring", passive), ("drive_spring", drives)):
        for spring in springs:
            _require_positive(spring.stiffness, f"'{spring.joint}'")
            _set_spring(root, tag, spring)
    return _load(robot, root)


def _load(robot: Robot, root: Element) -> Robot:
    return load_robot_from_urdf(
        tostring(root, encoding="unicode"),
        robot.source,
        actuated=robot.actuated,
        tool=robot.tool or None,
        arguments=robot.arguments,
        sha256=robot.sha256,
        packages=robot.packages,
    )


def _require_positive(stiffness: float, what: str) -> None:
    if not stiffness > 0:
        raise InputError("invalid_value", f"the stiffness of {what} must be above zero, not {stiffness}")


def _set_spring(root: Element, tag: str, spring: Spring) -> None:
    """Replace a joint's spring of a kind; infinity removes it, no damping and a standard error of zero are not written."""
    for old in [e for e in root.findall(_OURS + tag) if e.get("joint") == spring.joint]:
        root.remove(old)
    if np.isfinite(spring.stiffness):
        values = {
            "stiffness": spring.stiffness,
            "damping": spring.damping,
            "stiffness_stderr": spring.stiffness_stderr or 0.0,
        }
        written = {name: repr(float(value)) for name, value in values.items() if value > 0}
        SubElement(root, _OURS + tag, {"joint": spring.joint, **written})


def _state_rods(robot: Robot, root: Element, stiffness: float) -> None:
    legs = get_rods(robot)
    if legs is None:
        raise InputError("unsupported", f"{robot.source} has no rods; state the stiffness of its drives")
    joints = {e.get("name"): e for e in root.findall("joint")}
    directions = None
    for rod in legs.names:
        name = name_rod_spring(rod)
        if name in joints:
            if not np.isfinite(stiffness):
                joints[name].set("type", "fixed")
            _set_spring(root, "spring", Spring(name, stiffness, 0.0))
        elif np.isfinite(stiffness):
            directions = _find_rod_directions(robot) if directions is None else directions
            _insert_slide(robot, root, rod, directions[rod])
            _set_spring(root, "spring", Spring(name, stiffness, 0.0))


def _find_rod_directions(robot: Robot) -> dict[str, np.ndarray]:
    """Return the direction from base to plate of every rod, as a unit vector (3,) in the frame of its link."""
    legs = get_rods(robot)
    assert legs is not None
    solver = LoopSolver(robot)
    data = solver.model.createData()
    pin.framesForwardKinematics(solver.model, data, solver.close(robot.home))
    start = legs.base_points(robot.home[None])[0]
    end = legs.plate_points(legs.home)[0]
    found = {}
    for rod, a, b in zip(legs.names, start, end, strict=True):
        link = f"{rod}_link"
        if not solver.model.existFrame(link):
            raise InputError(
                "unsupported",
                f"{robot.source}: rod '{rod}' has no link '{link}' of its own to which a spring could be added",
            )
        rotation = data.oMf[solver.model.getFrameId(link)].rotation
        found[rod] = rotation.T @ ((b - a) / np.linalg.norm(b - a))
    return found


def _insert_slide(robot: Robot, root: Element, rod: str, direction: np.ndarray) -> None:
    """Put a slide between a rod's link and the ball joint that closes its loop."""
    link, end, name = f"{rod}_link", f"{rod}_end_link", name_rod_spring(rod)
    for namespace in _DRAKE:
        for ball in root.findall(f"{namespace}ball_constraint"):
            for side, point in (("A", "p_AP"), ("B", "p_BQ")):
                body = ball.find(f"{namespace}ball_constraint_body_{side}")
                at = ball.find(f"{namespace}ball_constraint_{point}")
                if body is None or at is None or body.get("name") != link:
                    continue
                SubElement(root, "link", {"name": end})
                joint = SubElement(root, "joint", {"name": name, "type": "prismatic"})
                SubElement(joint, "origin", {"xyz": at.get("value", "0 0 0"), "rpy": "0 0 0"})
                SubElement(joint, "parent", {"link": link})
                SubElement(joint, "child", {"link": end})
                SubElement(joint, "axis", {"xyz": " ".join(repr(float(x)) for x in direction)})
                limits = {"lower": f"-{_LIMIT}", "upper": _LIMIT, "velocity": "1", "effort": "1e6"}
                SubElement(joint, "limit", limits)
                body.set("name", end)
                at.set("value", "0 0 0")
                return
    raise InputError(
        "unsupported", f"{robot.source}: no <drake:ball_constraint> closes the loop of rod '{rod}' at its link"
    )
