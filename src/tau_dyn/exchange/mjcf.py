"""A model's robot as MJCF for MuJoCo: nested bodies, loops as `<connect>` between sites, motors, home as a keyframe.

MuJoCo's own URDF reader drops loops and drive inertia. Here every movable joint becomes a body with the model's inertia
(links fixed to it merged in), `armature`, `damping` and `frictionloss`. A drive's gain and constant force are attributes of its
actuator; `mjcf_effects.py` describes the elements of other effects.
Loops are constrained at sites: unlike constraints between bodies, these do not depend on the pose at which the file is compiled.
The base of a walking robot has a free joint, `base`, and round feet are balls that touch the ground.
Bodies without mass get 1e-9 kg, since MuJoCo requires a mass. Meshes are written as binary STL, since MuJoCo reads no Collada.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.exchange.content import (
    Exported,
    build_body,
    format_header,
    list_nominal_parameters,
    raise_moments,
    read_joint_law,
    split,
)
from tau_dyn.exchange.mjcf_effects import (
    TIMESTEP_S,
    EffectPlaces,
    add_late_sensors,
    add_passive_motors,
    add_shared_motors,
    compute_bristle_force,
    compute_drag,
    compute_gravity,
    place_effects,
)
from tau_dyn.mechanism import Joint, LoopSolver, list_joints
from tau_dyn.model import Model
from tau_dyn.robot import Mesh, Visual, list_missing_meshes, read_visuals

_STIFF = {"solref": f"{2 * TIMESTEP_S:g} 1", "solimp": "0.9999 0.99999 0.001"}
"""Stiffest loops and dry friction that MuJoCo accepts: its shortest time constant is two steps, and an impedance of 1 - 1e-5
leaves 1e-5 of a loop's acceleration. With the defaults, 20 ms and 0.9, loops open by millimetres."""

_SEEN_ONLY = {"contype": "0", "conaffinity": "0", "mass": "0"}
_MAX_STL_FACES = 200_000
"""Largest number of triangles in an STL file for MuJoCo."""
_LIGHT = 1e-9  # kg, of bodies without mass
_MIN_INERTIAL = {"pos": "0 0 0", "mass": f"{_LIGHT:g}", "diaginertia": "1e-12 1e-12 1e-12"}
_ROUNDED = 1e-6  # relative, rounding of an inertia from an interior-point solver


def build_mjcf(model: Model, meshes: str = "") -> Exported:
    """Return the model's robot as MJCF text.

    Args:
        model: The model.
        meshes: Prefix of the names of mesh files, which are located next to the MJCF file; without it no meshes are written.

    Raises:
        InputError: A joint has more than one degree of freedom, or a drive has a scale.
    """
    robot = model.robot
    robot.require_unscaled_drives("a MuJoCo file")
    joints = list_joints(robot.model)
    if joints is None:
        raise InputError(
            "unsupported", f"{robot.source}: MJCF is written for robots of joints with one degree of freedom each"
        )
    places = place_effects(model)
    carried, left_out = places.carried, places.lost
    root = Element("mujoco", model=robot.name)
    root.append(Comment(f" {format_header(model, (*places.said, *left_out))} "))
    SubElement(root, "compiler", angle="radian", autolimits="true", boundmass="1e-9", boundinertia="1e-12")
    SubElement(root, "option", gravity=_numbers(compute_gravity(model, places)), timestep=_numbers([TIMESTEP_S]))
    world = SubElement(root, "worldbody")
    bodies, raised = _bodies(world, carried, joints, places)
    _add_weights(bodies, model)
    _add_feet(bodies, model)
    visuals, missing = read_visuals(robot)
    files, shapes = _draw(root, visuals, [world, *bodies], meshes)
    _mark_tool(model, [world, *bodies])
    _tie(root, model, [world, *bodies])
    _couple(root, model)
    add_shared_motors(root, model, places, _STIFF)
    actuator = SubElement(root, "actuator")
    limits = dict(zip(robot.actuated, robot.effort_limit, strict=True))
    for joint in robot.driven:
        limit = limits[joint]
        more = {"ctrlrange": _numbers([-limit, limit])} if np.isfinite(limit) else {}
        law = read_joint_law(carried, joint)
        if law.gain != 1 or law.offset:
            more |= {
                "biastype": "affine",
                "gainprm": _numbers([1 / law.gain]),
                "biasprm": _numbers([-law.offset, 0, 0]),
            }
        SubElement(actuator, "general", {"name": f"{joint}_motor", "joint": joint, **more})
    add_passive_motors(actuator, model, places)
    add_late_sensors(root, model, places)
    key = SubElement(root, "keyframe")
    SubElement(key, "key", name="home", qpos=_numbers(_home(model, joints, world)))
    ElementTree.indent(root)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    left_out = (*left_out, *raised, *shapes, *list_missing_meshes(missing))
    told = {"callback": places.callback, "by_callback": places.said, "told": places.known if places.callback else None}
    return Exported(text, left_out, carried, list_nominal_parameters(model), split(model), files, **told)


def _bodies(world: Element, model: Model, joints: list[Joint], places: EffectPlaces) -> tuple[list[Element], list[str]]:
    """Return the bodies by joint index minus one, each inside its parent's, and sentences about changed inertias."""
    robot, found, raised = model.robot, [world], []
    inertias = {link.joint_id: link for link in robot.links}
    names = {f.parentJoint: f.name for f in reversed(robot.model.frames.tolist()) if f.type == pin.FrameType.BODY}
    for joint in joints:
        name = robot.model.names[joint.index]
        if name in robot.base_coordinates[:-1]:
            found.append(world)
            continue
        held = robot.held_positions.get(name)
        turn, place = joint.place(held or 0.0)
        rotation = pin.Quaternion(turn)
        pose = {"pos": _numbers(place), "quat": _numbers([rotation.w, rotation.x, rotation.y, rotation.z])}
        body = SubElement(found[joint.parent], "body", {"name": names[joint.index], **pose})
        if name in robot.base_coordinates:
            SubElement(body, "freejoint", name="base")
        elif held is None:
            SubElement(body, "joint", _joint(model, joint, places))
        if joint.index in inertias:
            carried = build_body(inertias[joint.index], model)
            said, sentence = _inertia(carried.inertia, inertias[joint.index].link)
            raised.append(sentence)
            said |= {"pos": _numbers(carried.centre), "mass": _numbers([carried.mass])}
            SubElement(body, "inertial", said)
        else:
            SubElement(body, "inertial", _MIN_INERTIAL)
        found.append(body)
    return found[1:], [sentence for sentence in raised if sentence]


def _add_feet(bodies: list[Element], model: Model) -> None:
    """Add the ball of each foot, which touches the ground."""
    for contact in model.robot.contacts:
        frame = model.robot.model.frames[model.robot.model.getFrameId(contact.frame, pin.FrameType.BODY)]
        if contact.radius:
            place = frame.placement.act(np.array(contact.centre))
            said = {"pos": _numbers(place), "size": _numbers([contact.radius]), "mass": "0"}
            SubElement(bodies[frame.parentJoint - 1], "geom", {"name": contact.frame, "type": "sphere", **said})


def _inertia(inertia: np.ndarray, link: str) -> tuple[dict[str, str], str]:
    """Return an inertia's attributes, and a sentence if the inertia had to be changed to a physically consistent one."""
    admitted = raise_moments(inertia)
    if admitted is None:
        return {"fullinertia": _numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])}, ""
    moments, axes = admitted
    much = np.abs(axes * moments @ axes.T - inertia).max() > _ROUNDED * np.abs(inertia).max()
    turn = pin.Quaternion(axes)
    said = {"diaginertia": _numbers(moments), "quat": _numbers([turn.w, turn.x, turn.y, turn.z])}
    return said, f"{link}: no body has its inertia, so MJCF holds the next that one may have" if much else ""


def _joint(model: Model, joint: Joint, places: EffectPlaces) -> dict[str, str]:
    robot, name = model.robot, model.robot.model.names[joint.index]
    said = {"name": name, "type": "slide" if joint.slides else "hinge", "axis": _numbers(joint.axis)}
    item = robot.model.joints[joint.index]
    lower, upper = robot.model.lowerPositionLimit[item.idx_q], robot.model.upperPositionLimit[item.idx_q]
    if item.nq == 1 and lower < upper and np.isfinite(lower + upper) and upper - lower < 1e10:
        said["range"] = _numbers([lower, upper])
    if name in robot.actuated:
        law = read_joint_law(model, name)
        drag = compute_drag(model, places, name)
        said |= {"armature": _numbers([law.armature]), "damping": _numbers([law.viscous, *([drag] if drag else [])])}
        dry = law.coulomb - compute_bristle_force(model, places, name)
        if dry or places.callback:
            said |= {f"{key}friction": value for key, value in _STIFF.items()}
        if dry:
            said["frictionloss"] = _numbers([dry])
    return said


def _add_weights(bodies: list[Element], model: Model) -> None:
    """Add a body of negligible inertia for each mass on which only gravity acts; a negative `gravcomp` scales its weight.

    MuJoCo evaluates `gravcomp` only if some body has a positive value, so the carrier gets a negligible one.
    """
    robot = model.robot
    for name in robot.parameters.names:
        mass = robot.parameters[name].value
        if name.endswith(".gravity_mass") and mass:
            link = robot.model.frames[robot.model.getFrameId(name.rsplit(".", 1)[0])]
            place = {"name": name.replace(".", "_"), "pos": _numbers(link.placement.translation)}
            carrier = bodies[link.parentJoint - 1]
            carrier.set("gravcomp", "1e-12")
            body = SubElement(carrier, "body", {**place, "gravcomp": _numbers([-mass / _LIGHT])})
            SubElement(body, "inertial", _MIN_INERTIAL)


def _draw(
    root: Element, visuals: Sequence[Visual], bodies: list[Element], prefix: str
) -> tuple[dict[str, bytes], list[str]]:
    """Add the visuals of the robot file, without contact; return the mesh files and sentences about omitted visuals."""
    files: dict[str, bytes] = {}
    names: dict[Mesh, str] = {}
    left = 0
    for visual in visuals:
        shape = visual.shape
        if isinstance(shape, Mesh) and prefix and len(shape.faces) <= _MAX_STL_FACES:
            if shape not in names:
                names[shape] = _name_mesh(shape, names)
                files[f"{prefix}{names[shape]}.stl"] = format_stl(shape)
            said: dict[str, str] | None = {"type": "mesh", "mesh": names[shape]}
        else:
            said = None if isinstance(shape, Mesh) else _format_primitive(shape)
        if said is None or visual.joint >= len(bodies):
            left += 1
            continue
        place, turn = visual.placement.translation, pin.Quaternion(visual.placement.rotation)
        said |= {"pos": _numbers(place), "quat": _numbers([turn.w, turn.x, turn.y, turn.z])}
        said |= {} if visual.colour is None else {"rgba": _numbers(np.round(visual.colour, 4))}
        SubElement(bodies[visual.joint], "geom", {**said, **_SEEN_ONLY})
    if files:
        asset = Element("asset")
        for path, name in zip(files, names.values(), strict=True):
            SubElement(asset, "mesh", name=name, file=path, inertia="shell")
        root.insert(list(root).index(bodies[0]), asset)
    return files, [f"{left} visual shapes are left out"] if left else []


def _name_mesh(mesh: Mesh, names: Mapping[Mesh, str]) -> str:
    stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in mesh.path.stem)
    taken, k = set(names.values()), 2
    name = stem
    while name in taken:
        name, k = f"{stem}_{k}", k + 1
    return name


def format_stl(mesh: Mesh) -> bytes:
    """Return a mesh as a binary STL file: 80 bytes, the number of triangles, then 50 bytes for each."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    rows["normal"], rows["corners"] = normals / np.where(length > 0, length, 1.0), corners
    return bytes(80) + np.uint32(len(rows)).astype("<u4").tobytes() + rows.tobytes()


def _format_primitive(shape: Any) -> dict[str, str] | None:
    kind = type(shape).__name__
    if kind == "Box":
        return {"type": "box", "size": _numbers(shape.halfSide)}
    if kind == "Cylinder":
        return {"type": "cylinder", "size": _numbers([shape.radius, shape.halfLength])}
    return {"type": "sphere", "size": _numbers([shape.radius])} if kind == "Sphere" else None


def _mark_tool(model: Model, bodies: list[Element]) -> None:
    """Add the tool's frame as a site."""
    robot = model.robot
    if robot.tool_frame is not None and all(body.get("name") != robot.tool for body in bodies):
        frame = robot.model.frames[robot.tool_frame]
        turn = pin.Quaternion(frame.placement.rotation)
        pose = {
            "pos": _numbers(frame.placement.translation),
            "quat": _numbers([turn.w, turn.x, turn.y, turn.z]),
        }
        SubElement(bodies[frame.parentJoint], "site", {"name": robot.tool, **pose, "size": "0.005"})


def _tie(root: Element, model: Model, bodies: list[Element]) -> None:
    """Add the loops: a site at each end, and a constraint between them."""
    if not model.robot.loops:
        return
    equality = SubElement(root, "equality")
    for loop in model.robot.loops:
        ends = [model.robot.model.frames[k] for k in (loop.frame_a, loop.frame_b)]
        for end in ends:
            SubElement(
                bodies[end.parentJoint], "site", name=end.name, pos=_numbers(end.placement.translation), size="0.005"
            )
        a, b = (end.name for end in ends)
        SubElement(equality, "connect", {"name": f"{a}_{b}", "site1": a, "site2": b, **_STIFF})


def _couple(root: Element, model: Model) -> None:
    """Add the joints that follow others."""
    equality = root.find("equality")
    moving = {j: mimic for j, mimic in model.robot.mimics.items() if j not in model.robot.held_positions}
    for joint, mimic in moving.items():
        equality = SubElement(root, "equality") if equality is None else equality
        law = {"polycoef": _numbers([mimic.offset, mimic.multiplier, 0, 0, 0])}
        SubElement(equality, "joint", {"joint1": joint, "joint2": mimic.joint, **law})


def _home(model: Model, joints: list[Joint], world: Element) -> list[float]:
    """Return the closed configuration at home in MuJoCo's order, that of the file."""
    robot = model.robot
    q = LoopSolver(robot).close(robot.home)
    at = {}
    for joint in joints:
        item = robot.model.joints[joint.index]
        turning = item.nq == 2
        at[robot.model.names[joint.index]] = (
            float(np.arctan2(q[item.idx_q + 1], q[item.idx_q])) if turning else float(q[item.idx_q])
        )
    upright = [0.0, 0.0, _find_height(model, q), 1.0, 0.0, 0.0, 0.0] if robot.base_coordinates else []
    return [*upright, *(at[element.get("name", "")] for element in world.iter("joint"))]


def _find_height(model: Model, q: np.ndarray) -> float:
    """Return the height [m] at which the lowest foot of a floating base touches the ground at a configuration (nq,)."""
    tree, data = model.robot.model, model.robot.model.createData()
    pin.framesForwardKinematics(tree, data, q)
    lowest = [0.0]
    for contact in model.robot.contacts:
        place = data.oMf[tree.getFrameId(contact.frame, pin.FrameType.BODY)]
        lowest.append(float(place.act(np.array(contact.centre))[2]) - contact.radius)
    return -min(lowest)


def _numbers(values: Any) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(values, float).ravel())
