"""From a robot file to a `Robot`: expand, read, hand the tree to Pinocchio, add frames at the loops' ends.

The file stays the single source for Pinocchio (which ignores the loop elements), Drake (which reads them) and us.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import compute_sha256
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot.annotations import Annotations, BallConstraint, read_annotations
from tau_dyn.robot.expand import expand, find_robot
from tau_dyn.robot.robot import NOT_GIVEN, LinkInertia, Loop, Robot, get_inertial_parameters

TOOL_NAMES = ("tool", "tool0", "tcp", "ee_link", "end_effector")
"""Usual names of a tool frame, the first that exists counts: our own files', ROS-Industrial's, and those of common arms."""
MAX_DEGREES_OF_FREEDOM = 300
"""Degrees of freedom of a tree; Pinocchio's preparations for one take a second at 300 and a minute at 1000."""


def load_robot(
    robot: str | Path,
    /,
    *,
    actuated: Iterable[str] | None = None,
    tool: str | None = None,
    xacro: bool = True,
    **arguments: object,
) -> Robot:
    """Load a robot from a file or by its short name.

    Args:
        robot: Path to a `.urdf` or `.urdf.xacro`, or the short name of a robot that comes with the package or with
            `example-robot-data`.
        actuated: Names of the actuated joints; by default those with a `<transmission>`.
        tool: Name of the tool frame; by default the first of `TOOL_NAMES`, or the only leaf of the tree.
        xacro: Whether a xacro may be evaluated; False takes plain URDF only, for a file from people you do not trust.
        **arguments: xacro arguments, such as `prototype="l1"`.

    Raises:
        InputError: The file cannot be read, expanded or understood; a looped robot names no actuated joints.
        UnknownName: An unknown robot, xacro argument, joint or frame.
    """
    path = find_robot(robot)
    urdf = expand(path, arguments, evaluate=xacro)
    given = {k: str(v) for k, v in arguments.items()}
    return load_robot_from_urdf(
        urdf, str(robot), actuated=actuated, tool=tool, arguments=given, sha256=compute_sha256(path)
    )


def load_robot_from_urdf(
    urdf: str,
    source: str,
    *,
    actuated: Iterable[str] | None = None,
    tool: str | None = None,
    arguments: Mapping[str, str] | None = None,
    sha256: str = "",
    lock_springs: bool = True,
) -> Robot:
    """Build a robot from URDF text; `source` is how messages and saved models call it. See `load_robot`.

    Joints with a `<tau_dyn:spring>` are locked at zero, so that the robot is rigid; `lock_springs=False` leaves them movable.
    """
    notes = read_annotations(urdf, source)
    model = _build_model(urdf, source)
    if lock_springs and notes.springs:
        model = _locked(model, [s.joint for s in notes.springs], source)
    names, warnings = _actuated(model, notes, actuated, source)
    if notes.mimics:
        warnings.append(
            f"{source}: the <mimic> of {', '.join(notes.mimics)} counts in calibrate alone; elsewhere each joint moves by itself"
        )
    passive = [n for n in model.names[1:] if n not in names]
    if passive and not notes.loops:
        listed = ", ".join(passive)
        warnings.append(
            f"{source}: {listed} neither have a <transmission> nor stand in a loop; they are taken as locked at zero"
        )
    if notes.loops and not passive:
        raise InputError(
            "robot_structure",
            f"{source}: no passive joint is left to close its loops, of {', '.join(names)}; name only those with a motor",
        )
    loops = tuple(_add_loop(model, k, ball, source) for k, ball in enumerate(notes.loops))
    links = _links(model, notes)
    if not any(model.inertias[link.joint_id].mass > 0 for link in links):
        warnings.append("the robot file gives no mass at all; all inertial parameters start from zero")
    kinds = {j: model.joints[model.getJointId(j)].shortname() for j in names}
    units = {j: "kg" if kind.startswith("JointModelP") else "kg m^2" for j, kind in kinds.items()}
    return Robot(
        name=model.name,
        source=source,
        arguments=dict(arguments or {}),
        sha256=sha256,
        urdf=urdf,
        model=model,
        loops=loops,
        actuated=names,
        home=np.array([notes.home.get(j, _middle(model, j)) for j in names]),
        links=links,
        parameters=_parameters(links, units, notes),
        arms=notes.gantry_tau_arms,
        plate=notes.gantry_tau_plate,
        assumed=notes.assumed,
        warnings=tuple(warnings),
        springs=notes.springs,
        shared_drives=notes.shared_drives,
        tool=_find_tool(model, notes, tool, source),
        passive_home={joint: value for joint, value in notes.home.items() if joint in passive},
        drive_scales=_drive_scales(names, notes, source),
    )


def _drive_scales(actuated: tuple[str, ...], notes: Annotations, where: str) -> dict[str, float]:
    passive = next((joint for joint in notes.drive_scales if joint not in actuated), None)
    if passive is not None:
        raise InputError("robot_structure", f"{where}: <drive> of '{passive}': the joint is not actuated")
    return notes.drive_scales


def _build_model(urdf: str, where: str) -> pin.Model:
    text = re.sub(r"<\?xml[^>]*\?>", "", urdf, count=1)
    with _said_on_stderr() as said:
        try:
            model = pin.buildModelFromXML(text)
        except (ValueError, RuntimeError) as fault:
            reason = " ".join(str(fault).split())
            model = None
    if model is None:
        words = re.sub(r"(Error|Warning):\s*|\s+at line \d+ in \S+", " ", said[0])
        raise InputError(
            "robot_structure", f"{where}: Pinocchio cannot build the tree: {' '.join(words.split()) or reason}"
        )
    if model.nv == 0:
        raise InputError("robot_structure", f"{where}: the robot has no movable joint")
    if model.nv > MAX_DEGREES_OF_FREEDOM:
        raise InputError(
            "robot_structure",
            f"{where}: its joints have {model.nv} degrees of freedom; a robot has {MAX_DEGREES_OF_FREEDOM} at most",
        )
    return model


def _locked(model: pin.Model, joints: list[str], where: str) -> pin.Model:
    """Return the tree with these joints rigid at zero; what hangs on them joins the body before."""
    ids = [model.getJointId(j) for j in joints]
    several = next((j for j, k in zip(joints, ids, strict=True) if model.joints[k].nv != 1), None)
    if several is not None:
        raise InputError(
            "robot_structure", f"{where}: the spring on '{several}' needs a joint of one degree of freedom"
        )
    if len(ids) == model.njoints - 1:
        raise InputError("robot_structure", f"{where}: all joints have springs; at least one must move")
    return pin.buildReducedModel(model, ids, pin.neutral(model))


@contextmanager
def _said_on_stderr() -> Iterator[list[str]]:
    """Collect what a C++ library writes to the process' stderr; the list holds it after the block."""
    said: list[str] = []
    try:
        kept = os.dup(2)
    except OSError:  # closed: nothing can be said there
        yield said
        said.append("")
        return
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            said.append(file.read().decode(errors="replace"))


def _actuated(
    model: pin.Model, notes: Annotations, wanted: Iterable[str] | None, where: str
) -> tuple[tuple[str, ...], list[str]]:
    """Return the actuated joints in the tree's order, and what is doubtful about them."""
    movable = [n for n in model.names[1:]]
    names = list(wanted) if wanted is not None else [t.joint for t in notes.transmissions]
    for name in names:
        if name not in movable:
            raise UnknownName("movable joint", name, movable, where)
    if not names and notes.loops:
        raise InputError(
            "robot_structure",
            f"{where}: the robot has kinematic loops but no <transmission>; "
            "name its actuated joints with --actuated (load_robot(..., actuated=[...]))",
        )
    warnings = []
    if not names:
        names = movable
        listed = ", ".join(names)
        warnings = [f"{where} has no <transmission>; all its movable joints are taken as actuated: {listed}"]
    for name in names:
        if model.joints[model.getJointId(name)].nv != 1:
            raise InputError("robot_structure", f"{where}: actuated joint '{name}' must have one degree of freedom")
    return tuple(n for n in movable if n in names), warnings


def _find_tool(model: pin.Model, notes: Annotations, wanted: str | None, where: str) -> str:
    """Return the tool frame's name; empty where none was named and none is evident."""
    if wanted is not None:
        if not model.existFrame(wanted):
            raise UnknownName("frame", wanted, [f.name for f in model.frames[1:]], where)
        return wanted
    named = next((name for name in TOOL_NAMES if model.existFrame(name)), "")
    return named or (notes.leaves[0] if len(notes.leaves) == 1 and not notes.loops else "")


def _add_loop(model: pin.Model, k: int, ball: BallConstraint, where: str) -> Loop:
    ids = [_anchor(model, f"loop{k + 1}_{side}", link, np.array(point), where) for side, link, point in
           (("a", ball.link_a, ball.point_a), ("b", ball.link_b, ball.point_b))]  # fmt: skip
    return Loop(f"{ball.link_a}-{ball.link_b}", *ids)


def _anchor(model: pin.Model, name: str, link: str, point: np.ndarray, where: str) -> int:
    if not model.existFrame(link, pin.FrameType.BODY):
        raise InputError(
            "robot_structure", f"{where}: <drake:ball_constraint> names link '{link}', which is not in the tree"
        )
    body = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
    placement = body.placement * pin.SE3(np.eye(3), point)
    return model.addFrame(pin.Frame(name, body.parentJoint, 0, placement, pin.FrameType.OP_FRAME))


def _links(model: pin.Model, notes: Annotations) -> tuple[LinkInertia, ...]:
    """Return the links that carry mass; of a file without any inertia all links, starting from zero."""
    found, bodies = [], range(1, model.njoints)
    for i in [i for i in bodies if model.inertias[i].mass > 0] or bodies:
        link = notes.joints[model.names[i]]
        own = (0,) if link in notes.mass_only else tuple(range(10))
        found.append(LinkInertia(link, i, np.array(model.inertias[i].toDynamicParameters()), own))
    return tuple(found)


def _parameters(links: tuple[LinkInertia, ...], armature_units: dict[str, str], notes: Annotations) -> Parameters:
    armature = {t.joint: t.armature for t in notes.transmissions if t.armature is not None}
    rows = [p for link in links for p in get_inertial_parameters(link)]
    for joint, unit in armature_units.items():
        origin = "robot file" if joint in armature else NOT_GIVEN
        rows.append(Parameter(f"{joint}.armature", armature.get(joint, 0.0), unit, 0.0, free=False, origin=origin))
    for link, value in notes.gravity_masses.items():
        rows.append(Parameter(f"{link}.gravity_mass", value, "kg", free=False))
    return Parameters(rows)


def _middle(model: pin.Model, joint: str) -> float:
    item = model.joints[model.getJointId(joint)]
    if item.nq != 1:
        return 0.0
    lower, upper = model.lowerPositionLimit[item.idx_q], model.upperPositionLimit[item.idx_q]
    return float((lower + upper) / 2) if np.isfinite(lower + upper) and abs(lower) + abs(upper) < 1e10 else 0.0
