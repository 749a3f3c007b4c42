"""Calibrated placements back in the robot file: joint origins and loop points, so that every other program uses them too.

An offset becomes part of its joint's placement: `R exp([r]x) exp(offset axis)` for a turn, a shift along the axis for a
slide. The encoders keep counting as before. What a robot file cannot say (a gear ratio) is refused. Comments of the
original are lost, all else stays.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import TreeNumbers, TreeShape, compute_dimensions_at

_DRAKE = ("http://drake.mit.edu", "https://drake.mit.edu")
_OURS = "urn:tau_dyn"


def format_corrected_urdf(geometry: TreeGeometry, theta: np.ndarray) -> str:
    """Return the robot file's text with calibrated joint placements, offsets, rod lengths and loop points.

    Args:
        geometry: The robot.
        theta: Calibrated parameters (p,).

    Raises:
        InputError: A gear ratio other than one, which a robot file cannot say.
    """
    shape = geometry.shape
    numbers = compute_dimensions_at(shape, geometry.knobs, np.asarray(theta, float), geometry.parameters.values)
    odd = np.flatnonzero(numbers.gain != 1.0)
    if len(odd):
        raise InputError(
            "unsupported",
            f"{shape.robot.source}: {shape.robot.actuated[odd[0]]}.gain is {numbers.gain[odd[0]]:.6g}, and a robot file "
            "has no gear ratios; fix the gains in the fit, or correct the encoder's scale",
        )
    root = fromstring(shape.robot.urdf)
    joints = {e.get("name", ""): e for e in root.findall("joint")}
    for k, name in enumerate(shape.names):
        placement = _placement(shape, numbers, k)
        if not placement.isApprox(_nominal(shape, k), 1e-15):
            _write_origin(joints[name], placement)
    _write_points(root, shape, numbers)
    _write_tool(joints, shape, numbers)
    for prefix, uri in (("drake", _DRAKE[0]), ("tau_dyn", _OURS)):
        ElementTree.register_namespace(prefix, uri)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _nominal(shape: TreeShape, k: int) -> pin.SE3:
    joint = shape.joints[k]
    return shape.within[k].actInv(pin.SE3(joint.rotation, joint.offset))


def _placement(shape: TreeShape, numbers: TreeNumbers, k: int) -> pin.SE3:
    """Return a joint's calibrated placement in its parent link, its offset included."""
    joint = numbers.joints[k]
    placement = pin.SE3(joint.rotation, joint.offset)
    if joint.v in shape.active:
        offset = float(numbers.offset[np.flatnonzero(shape.active == joint.v)[0]])
        step = (
            pin.SE3(np.eye(3), offset * joint.axis)
            if joint.slides
            else pin.SE3(pin.exp3(offset * joint.axis), np.zeros(3))
        )
        placement = placement * step
    return shape.within[k].actInv(placement)


def _write_origin(joint: ElementTree.Element, placement: pin.SE3) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(joint, "origin")
    origin.set("xyz", _words(placement.translation))
    origin.set("rpy", _words(pin.rpy.matrixToRpy(placement.rotation)))


def _write_points(root: ElementTree.Element, shape: TreeShape, numbers: TreeNumbers) -> None:
    elements = [(uri, e) for uri in _DRAKE for e in root.findall(f"{{{uri}}}ball_constraint")]
    for k, (uri, element) in enumerate(elements):
        for side, tag in enumerate(("p_AP", "p_BQ")):
            end, local = shape.ends[2 * k + side], numbers.points[2 * k + side]
            if not np.array_equal(local, end.local):
                body = shape.robot.model.frames[shape.robot.model.getFrameId(end.link)].placement
                point = element.find(f"{{{uri}}}ball_constraint_{tag}")
                assert point is not None  # read_annotations found it
                point.set("value", _words(body.actInv(local)))


def _write_tool(joints: dict[str, ElementTree.Element], shape: TreeShape, numbers: TreeNumbers) -> None:
    shift = numbers.tool - shape.tool.local
    if not shift.any():
        return
    model = shape.robot.model
    for joint in joints.values():
        child, parent = joint.find("child"), joint.find("parent")
        if joint.get("type") != "fixed" or child is None or parent is None:
            continue
        if shape.tool.link in (joint.get("name"), child.get("link")):
            body = model.frames[model.getFrameId(parent.get("link", ""))].placement
            origin = joint.find("origin")
            before = (
                np.array([float(x) for x in (origin.get("xyz") or "0 0 0").split()])
                if origin is not None
                else np.zeros(3)
            )
            if origin is None:
                origin = ElementTree.SubElement(joint, "origin")
            origin.set("xyz", _words(before + body.rotation.T @ shift))
            return
    raise InputError(
        "unsupported",
        f"{shape.robot.source}: the tool frame '{shape.tool.link}' has no fixed joint of its own, "
        "whose place could be corrected",
    )


def _words(vector: np.ndarray) -> str:
    return " ".join(f"{x + 0.0:.17g}" for x in vector)
