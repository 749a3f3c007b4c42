"""Load a robot file as a `Robot`: expand, read, pass the tree to Pinocchio, add frames at the loops' ends.

The file remains the single source for Pinocchio (which ignores the loop elements), Drake (which reads them) and `tau_dyn`.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName, require_kind, require_names
from tau_dyn.files import compute_sha256
from tau_dyn.message_codes import CodedWarning
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import count
from tau_dyn.robot.annotations import (
    Annotations,
    BallConstraint,
    JointFriction,
    Mimic,
    Spring,
    read_annotations,
)
from tau_dyn.robot.body_prior import find_placeholders
from tau_dyn.robot.closed_home import close_home
from tau_dyn.robot.expand import expand, find_robot
from tau_dyn.robot.floating_base import BASE_COORDINATES, free_base
from tau_dyn.robot.held_joints import hold_joints
from tau_dyn.robot.independent_drives import find_independent_drives
from tau_dyn.robot.loop_file import add_loops, find_loop_file
from tau_dyn.robot.numbers import MAX_NUMBER, check_inertia
from tau_dyn.robot.packages import StockRobot, find_described_robot
from tau_dyn.robot.plausible_units import list_unit_warnings
from tau_dyn.robot.robot import NO_DRIVE, NOT_GIVEN, LinkInertia, Loop, Robot, get_inertial_parameters
from tau_dyn.robot.semantics import find_srdf, read_passive_joints

_LOGGER = logging.getLogger(__name__)
TOOL_NAMES = ("tool", "tool0", "tcp", "hand_tcp", "ee_link", "end_effector", "attachment_site", "flange")
_MOUNTS = TOOL_NAMES[5:]  # tool flanges: the only leaf behind one is the tool
"""Usual names of a tool frame: those of the built-in robots, of ROS-Industrial, and of common arms.

The first one that exists is used; otherwise the first one with which the name of exactly one frame ends, such as
`panda_hand_tcp`."""
FITTED = '<tau_dyn:estimated_inertias xmlns:tau_dyn="urn:tau_dyn"/>'
"""Element of a robot file whose inertias were fitted to data; they need not be physically consistent."""
MAX_DEGREES_OF_FREEDOM = 300
"""Largest number of degrees of freedom of a tree; Pinocchio's setup takes a second at 300 and a minute at 1000."""


def load_robot(
    robot: str | Path,
    /,
    *,
    actuated: Iterable[str] | None = None,
    tool: str | None = None,
    xacro: bool = True,
    packages: Mapping[str, str | Path] | None = None,
    srdf: str | Path | None = None,
    fitted_inertias: bool = False,
    hold: Mapping[str, float] | None = None,
    base: object = "fixed",
    contacts: Iterable[str] = (),
    **arguments: object,
) -> Robot:
    """Load a robot from a file or by its short name.

    Args:
        robot: Path to a `.urdf`, `.urdf.xacro` or MJCF `.xml`, or the short name of a robot that comes with the package, with
            `example-robot-data` (`ur5`), or is in the cache of `robot_descriptions` (`ur5e_description`).
        actuated: Names of the actuated joints; by default those with a `<transmission>` or commanded by `<ros2_control>`.
        tool: Name of the tool frame; by default the first of `TOOL_NAMES`, or the only leaf of the tree.
        xacro: Whether a xacro may be evaluated; False accepts plain URDF only, for files from an untrusted source.
        packages: Folders of ROS packages by name; they take precedence over those that are found (`packages.py`).
        srdf: An SRDF that names passive joints; by default the one next to the file, of the same name.
        fitted_inertias: Accept inertias that no body can have, such as those fitted to forces.
        hold: Positions of joints that are fixed [m or rad], by name.
        base: `floating` for a robot that walks; its pose is then measured (`floating_base.py`). The default is `fixed`; any
            other value is the xacro argument of this name, a dimension of some robots.
        contacts: Links that touch the ground at times: `FRAME` for a point foot, `FRAME=RADIUS` [m] for a ball about its origin
            (by default the sphere of the link's geometry), `FRAME=flat` for a flat foot.
        **arguments: xacro arguments, such as `prototype="l1"`.

    Raises:
        InputError: The file cannot be read, expanded or understood; a looped robot names no actuated joints.
        UnknownName: An unknown robot, xacro argument, joint or frame.

    Example:
        >>> robot = td.load_robot("delta")
        >>> robot.actuated
        ('arm1', 'arm2', 'arm3')
    """
    path = find_robot(robot)
    _require_kinds(srdf, {"actuated": actuated, "contacts": contacts}, {"packages": packages, "hold": hold})
    described = find_described_robot(str(robot)) or StockRobot(path)
    named = {} if base in ("fixed", "floating") else {"base": base}
    given = {k: str(v) for k, v in {**described.arguments, **arguments, **named}.items()}
    folders = {**described.packages, **(packages or {})}
    urdf = expand(path, given, evaluate=xacro, packages=folders)
    if (loops := find_loop_file(path)) is not None:
        urdf = add_loops(urdf, loops)
    if fitted_inertias:
        urdf = re.sub(r"</robot>\s*$", f"{FITTED}</robot>", urdf)
    if hold:
        read_annotations(urdf, str(robot))
        urdf = hold_joints(urdf, hold, str(robot))
    urdf = _float(urdf, () if contacts is None else tuple(contacts), str(robot), floating=base == "floating")
    semantics = Path(srdf) if srdf is not None else find_srdf(path)
    found = load_robot_from_urdf(
        urdf,
        str(robot),
        actuated=actuated,
        tool=tool,
        arguments=given,
        sha256=compute_sha256(path),
        passive=read_passive_joints(semantics) if semantics is not None else (),
        packages=folders,
    )
    _LOGGER.info("loaded %s: %s", path, ", ".join(found.actuated))
    return found


def _require_kinds(srdf: object, names: Mapping[str, object], tables: Mapping[str, object]) -> None:
    """Refuse options of `load_robot` of another type; None stands for the default."""
    if srdf is not None:
        require_kind(srdf, str | Path, "SRDF", "the path of its file")
    for name, value in names.items():
        if value is not None:
            require_names(value, name)
    for name, value in tables.items():
        if value is not None:
            require_kind(value, Mapping, f"value of {name}", "a dictionary")


def _float(urdf: str, contacts: tuple[str, ...], where: str, *, floating: bool) -> str:
    """Return URDF text with the requested base."""
    if floating:
        read_annotations(urdf, where)
        return free_base(urdf, contacts, where)
    if contacts:
        raise InputError("bad_option", f"--contact {' '.join(map(str, contacts))} goes with --base floating")
    return urdf


def as_robot(robot: Robot | str | Path) -> Robot:
    """Return a robot unchanged, or load it from its path or short name; see `load_robot`.

    Raises:
        InputError: It is something else, or its file cannot be used.
    """
    if isinstance(robot, Robot):
        return robot
    return load_robot(robot)


def load_robot_from_urdf(
    urdf: str,
    source: str,
    *,
    actuated: Iterable[str] | None = None,
    tool: str | None = None,
    arguments: Mapping[str, str] | None = None,
    sha256: str = "",
    lock_springs: bool = True,
    passive: Iterable[str] = (),
    packages: Mapping[str, str | Path] | None = None,
    hold_passive: bool = True,
) -> Robot:
    """Build a robot from URDF text; `source` is its name in messages and saved models. See `load_robot`.

    Joints with a `<tau_dyn:spring>` are locked at zero, so that the robot is rigid; `lock_springs=False` leaves them movable.
    Joints named `passive` are not actuated unless the text or `actuated` names them. Meshes are searched in `packages`.
    Joints of a tree that no motor moves become fixed ones in the text, so that the links behind them are part of one body;
    `hold_passive=False` holds them at zero and leaves their links bodies of their own, as older saved models have them.
    """
    notes = read_annotations(urdf, source)
    model = _build_model(urdf, source)
    if not notes.estimated:
        _check_bodies(model, notes, source)
    if lock_springs and notes.springs:
        model = _locked(model, [s.joint for s in notes.springs], source)
    wanted = None if actuated is None else tuple(actuated)
    names, warnings = _actuated(model, notes, wanted, tuple(passive), source)
    coordinates = BASE_COORDINATES if notes.floating else ()
    if notes.floating and notes.loops:
        raise InputError("unsupported", f"{source}: loops in the legs of a floating base are not read yet")
    warnings += [*notes.warnings, *list_unit_warnings(model, source)]
    followers = [n for n in notes.mimics if n in names]
    if followers:
        warnings.append(f"{source}: {', '.join(followers)} are named as actuated, so their <mimic> does not count")
    mimics = _resolve_mimics(model, notes, names, source)
    warnings += _narrow_limits(model, mimics, source)
    passive = [n for n in model.names[1:] if n not in names and n not in mimics]
    if passive and not notes.loops:
        moved = "it" if len(passive) == 1 else "them"
        sentence = f"{source}: held still at zero, for neither a motor nor a loop moves {moved}: {', '.join(passive)}"
        several = [n for n in passive if model.joints[model.getJointId(n)].nv != 1]
        if held := passive if hold_passive else several:
            found = load_robot_from_urdf(
                hold_joints(urdf, dict.fromkeys(held, 0.0), source),
                source,
                actuated=names,
                tool=tool,
                arguments=arguments,
                sha256=sha256,
                lock_springs=lock_springs,
                packages=packages,
                hold_passive=hold_passive,
            )
            return replace(found, warnings=(*warnings, *(w for w in found.warnings if w not in warnings), sentence))
        warnings.append(sentence)
    loops = tuple(_add_loop(model, k, ball, source) for k, ball in enumerate(notes.loops))
    links = _links(model, notes)
    if not any(model.inertias[link.joint_id].mass > 0 for link in links):
        warnings.append("the robot file gives no mass at all; all inertial parameters start from zero")
    if alike := find_placeholders(model):
        warnings.append(
            f"{source}: {len(alike)} bodies are equal spheres on their joints; they look like placeholders, so logs are compared "
            "with them loosely"
        )
    kinds = {j: model.joints[model.getJointId(j)].shortname() for j in names}
    units = {j: "kg" if kind.startswith("JointModelP") else "kg m^2" for j, kind in kinds.items()}
    found = Robot(
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
        parameters=_parameters(links, units, notes, mimics),
        base_coordinates=coordinates,
        contacts=notes.contacts,
        arms=notes.gantry_tau_arms,
        plate=notes.gantry_tau_plate,
        assumed=notes.assumed,
        warnings=tuple(warnings),
        springs=notes.springs,
        drive_springs=_require_actuated_springs(names, notes, source),
        shared_drives=notes.shared_drives,
        tool=_find_tool(model, notes, tool, source),
        passive_home={joint: value for joint, value in notes.home.items() if joint in passive},
        drive_scales=_drive_scales(names, notes, source),
        mimics=mimics,
        friction=_sum_friction(names, notes, mimics),
        gear_ratios={t.joint: t.ratio for t in notes.transmissions if t.ratio != 1 and t.joint in names},
        packages=dict(packages or {}),
    )
    independent = find_independent_drives(found, [n for n in wanted or names if n in names])
    if independent == names:
        return close_home(found) if loops else found
    fewer = load_robot_from_urdf(
        urdf,
        source,
        actuated=independent,
        tool=tool,
        arguments=arguments,
        sha256=sha256,
        lock_springs=lock_springs,
        packages=packages,
    )
    return _with_all_drives(fewer, found)


def _with_all_drives(fewer: Robot, found: Robot) -> Robot:
    """Return the robot of independent drives with what the file gives for the others, and a warning that names them."""
    others = [name for name in found.actuated if name not in fewer.actuated]
    sentence = (
        f"{found.source}: {len(found.actuated)} drives and {count(fewer.na, 'independent motion')}: "
        f"{', '.join(others)} {'follows' if len(others) == 1 else 'follow'} {', '.join(fewer.actuated)} through the loops; log "
        "the forces of all of them. "
        f"Forces of {', '.join(fewer.actuated)} are generalised, tau_k + sum of tau_i dq_i/dq_k over {', '.join(others)}"
    )
    return replace(
        fewer,
        redundant=found.parameters.select([f"{name}.armature" for name in others]),
        friction=found.friction,
        gear_ratios=found.gear_ratios,
        warnings=(*fewer.warnings, CodedWarning("redundant_drives", sentence)),
    )


def _require_actuated_springs(actuated: tuple[str, ...], notes: Annotations, where: str) -> tuple[Spring, ...]:
    passive = next((s.joint for s in notes.drive_springs if s.joint not in actuated), None)
    if passive is not None:
        raise InputError(
            "robot_structure",
            f"{where}: <drive_spring> of '{passive}': the joint is not actuated; a passive joint that yields has a "
            "<tau_dyn:spring>",
        )
    return notes.drive_springs


def _drive_scales(actuated: tuple[str, ...], notes: Annotations, where: str) -> dict[str, float]:
    passive = next((joint for joint in notes.drive_scales if joint not in actuated), None)
    if passive is not None:
        raise InputError("robot_structure", f"{where}: <drive> of '{passive}': the joint is not actuated")
    return notes.drive_scales


def _build_model(urdf: str, where: str) -> pin.Model:
    text = re.sub(r"<\?xml[^>]*\?>", "", urdf, count=1)
    text = re.sub(r"<robot(?=[\s>])(?![^>]*\bname=)", '<robot name="robot"', text, count=1)
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
    none = model.lowerPositionLimit == model.upperPositionLimit  # a URDF's limits are zero if they are not given
    model.lowerPositionLimit = np.where(none, -np.inf, model.lowerPositionLimit)
    model.upperPositionLimit = np.where(none, np.inf, model.upperPositionLimit)
    model.lowerPositionLimit = np.clip(model.lowerPositionLimit, -MAX_NUMBER, MAX_NUMBER)
    model.upperPositionLimit = np.clip(model.upperPositionLimit, -MAX_NUMBER, MAX_NUMBER)
    return model


def _check_bodies(model: pin.Model, notes: Annotations, where: str) -> None:
    """Reject moving bodies, with the links fixed to them, whose inertia no body can have."""
    for joint in range(1, model.njoints):
        body = model.inertias[joint]
        moments = np.linalg.eigvalsh(body.inertia) if np.isfinite(body.inertia).all() else np.full(3, np.inf)
        check_inertia(body.mass, moments.tolist(), f"{where}: link '{notes.joints[model.names[joint]]}'")


def _locked(model: pin.Model, joints: list[str], where: str) -> pin.Model:
    """Return the tree with these joints fixed at zero; the bodies behind them are merged with the body before."""
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
    """Capture the text that a C++ library writes to the process' stderr; the list holds it after the block."""
    said: list[str] = []
    try:
        kept = os.dup(2)
    except OSError:  # closed: no message can be written there
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
    model: pin.Model, notes: Annotations, wanted: Iterable[str] | None, passive: tuple[str, ...], where: str
) -> tuple[tuple[str, ...], list[str]]:
    """Return the actuated joints in the tree's order, and warnings about them."""
    movable = [n for n in model.names[1:]]
    driven = [t.joint for t in notes.transmissions if t.joint not in notes.mimics]
    names = list(wanted) if wanted is not None else driven
    base = BASE_COORDINATES if notes.floating else ()
    for name in names:
        if name not in movable:
            raise UnknownName("movable joint", name, movable, where)
    left = [name for name in movable if name not in (*notes.mimics, *passive, *base)]
    if not names and notes.loops and passive:
        names = left
    if not names and notes.loops:
        raise InputError(
            "robot_structure",
            f"{where}: the robot has kinematic loops but no <transmission>; "
            "name its actuated joints with --actuated (load_robot(..., actuated=[...]))",
        )
    warnings = []
    if not names:
        names = left
        listed = ", ".join(names)
        warnings = [f"{where} has no <transmission>; all its movable joints are taken as actuated: {listed}"]
    for name in names:
        if model.joints[model.getJointId(name)].nv != 1:
            raise InputError(
                "robot_structure",
                f"{where}: joint '{name}' has several degrees of freedom and cannot be actuated; hold it still "
                f"(--hold {name}=0, or type='fixed' in the file), or name the joints with a motor (--actuated)",
            )
    return tuple(n for n in movable if n in (*base, *names)), warnings


def _resolve_mimics(model: pin.Model, notes: Annotations, actuated: tuple[str, ...], where: str) -> dict[str, Mimic]:
    """Return the joints that follow an actuated joint or a fixed one, with the joint that they finally follow."""
    found = {}
    for name in notes.mimics:
        leader, share, offset, seen = name, 1.0, 0.0, [name]
        while leader in notes.mimics and leader not in actuated:
            rule = notes.mimics[leader]
            leader, share, offset = rule.joint, share * rule.multiplier, offset + share * rule.offset
            if leader in seen:
                raise InputError("robot_structure", f"{where}: the <mimic> of joint '{name}' comes back to itself")
            seen.append(leader)
        ids = [model.getJointId(joint) for joint in (name, leader)]
        if name in actuated or not all(k < model.njoints for k in ids):
            continue
        if any(model.joints[k].nv != 1 for k in ids):
            raise InputError(
                "robot_structure", f"{where}: the <mimic> of '{name}' needs joints of one degree of freedom"
            )
        if notes.loops and leader not in actuated:
            raise InputError(
                "unsupported",
                f"{where}: joint '{name}' follows '{leader}', which has no motor; in a robot with loops it must",
            )
        found[name] = Mimic(leader, share, offset)
    return found


def _narrow_limits(model: pin.Model, mimics: Mapping[str, Mimic], where: str) -> list[str]:
    """Narrow the leaders' limits of position and speed to those at which their followers are within theirs.

    Returns:
        A sentence for each follower that no position of its leader brings within its limits.
    """
    warnings = []
    for name, mimic in mimics.items():
        own, leader = (model.joints[model.getJointId(joint)] for joint in (name, mimic.joint))
        if not mimic.multiplier or own.nq != 1 or leader.nq != 1:
            continue
        reach = np.array([x[own.idx_q] for x in (model.lowerPositionLimit, model.upperPositionLimit)]) - mimic.offset
        low, high = sorted(reach / mimic.multiplier)
        low = max(low, model.lowerPositionLimit[leader.idx_q])
        high = min(high, model.upperPositionLimit[leader.idx_q])
        if low >= high:
            warnings.append(f"{where}: no position of {mimic.joint} brings {name}, which follows it, within its limits")
            continue
        _set_entry(model, "lowerPositionLimit", leader.idx_q, low)
        _set_entry(model, "upperPositionLimit", leader.idx_q, high)
        fastest, speed = model.upperVelocityLimit[own.idx_v], model.upperVelocityLimit[leader.idx_v]
        if fastest > 0:
            fastest = fastest / abs(mimic.multiplier)
            _set_entry(model, "upperVelocityLimit", leader.idx_v, min(fastest, speed) if speed > 0 else fastest)
    return warnings


def _set_entry(model: pin.Model, limit: str, k: int, value: float) -> None:
    """Change one entry of a limit, which Pinocchio takes as a whole."""
    changed = np.array(getattr(model, limit))
    changed[k] = value
    setattr(model, limit, changed)


def _sum_friction(
    actuated: tuple[str, ...], notes: Annotations, mimics: Mapping[str, Mimic]
) -> dict[str, JointFriction]:
    """Return the file's friction of the actuated joints; a follower's acts through its share, viscous by its square."""
    found = {joint: notes.friction[joint] for joint in actuated if joint in notes.friction}
    for joint, mimic in mimics.items():
        if joint in notes.friction and mimic.joint in actuated:
            before, more = found.get(mimic.joint, JointFriction(0.0, 0.0)), notes.friction[joint]
            found[mimic.joint] = JointFriction(
                before.viscous + mimic.multiplier**2 * more.viscous,
                before.coulomb + abs(mimic.multiplier) * more.coulomb,
            )
    return found


def _find_tool(model: pin.Model, notes: Annotations, wanted: str | None, where: str) -> str:
    """Return the tool frame's name; empty if no frame is named and no frame is evident."""
    if wanted is not None:
        if not model.existFrame(str(wanted)):
            raise UnknownName("frame", wanted, [f.name for f in model.frames[1:]], where)
        return wanted
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    named = [name for name in TOOL_NAMES if name in links or (name not in _MOUNTS and model.existFrame(name))]
    if len(notes.leaves) == 1 and not notes.loops and (not named or named[0] in _MOUNTS):
        return notes.leaves[0]
    if named:
        return named[0]
    ending = ([link for link in links if link.endswith((f"_{name}", f"-{name}"))] for name in TOOL_NAMES)
    return next((same[0] for same in ending if len(same) == 1), "")


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
    """Return the links with mass; all links, starting from zero, for a file without any inertia."""
    found, bodies = [], range(1, model.njoints)
    for i in [i for i in bodies if model.inertias[i].mass > 0] or bodies:
        link = notes.joints[model.names[i]]
        own = (0,) if link in notes.mass_only else tuple(range(10))
        found.append(LinkInertia(link, i, np.array(model.inertias[i].toDynamicParameters()), own))
    return tuple(found)


def _parameters(
    links: tuple[LinkInertia, ...], armature_units: dict[str, str], notes: Annotations, mimics: Mapping[str, Mimic]
) -> Parameters:
    armature = {t.joint: t.armature for t in notes.transmissions if t.armature is not None}
    for joint, mimic in mimics.items():
        if joint in armature:
            armature[mimic.joint] = armature.get(mimic.joint, 0.0) + mimic.multiplier**2 * armature[joint]
    rows = [p for link in links for p in get_inertial_parameters(link)]
    for joint, unit in armature_units.items():
        origin = "robot file" if joint in armature else NOT_GIVEN
        if notes.floating and joint in BASE_COORDINATES:
            origin = NO_DRIVE
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
