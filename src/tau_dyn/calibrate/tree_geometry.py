"""Any robot file as a geometry for calibration: joint placements, offsets, rod lengths and loop points are the parameters.

A serial arm, a tree with ball constraints (Delta, H4, Stewart) or a planar linkage, as `mechanism` closes and derives it at any
dimensions. Of planar loops only what lies in the plane can be closed; what does not stays open, as in the clearance of real
bearings, and `left_open` says how much.

Calibrated placements go back into the robot file, so that every other program uses them too: an offset becomes part of its
joint's placement, `R exp([r]x) exp(offset axis)` for a turn, a shift along the axis for a slide. Encoders keep counting alike.
What a robot file cannot say (a gear ratio) is refused. Comments of the original are lost, all else stays.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.calibrate.geometry import GeometryDefaults, Predicted
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import (
    PRIORITY,
    Knob,
    Poses,
    TreeDimensions,
    TreeNumbers,
    TreeShape,
    compute_dimensions_at,
    get_shape,
    require_positions,
)
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

_DRAKE = ("http://drake.mit.edu", "https://drake.mit.edu")
_OURS = "urn:tau_dyn"


@dataclass(frozen=True, eq=False)
class TreeGeometry(GeometryDefaults):
    """A tree, with or without loops, whose placements are parameters; build it with `build_tree_geometry`.

    Attributes:
        tree: The robot at any dimensions.
        parameters: Nominal values, those of the robot file.
        knobs: What each parameter does.
    """

    tree: TreeDimensions
    parameters: Parameters
    knobs: tuple[Knob, ...]

    beyond_file = ""

    @property
    def description(self) -> dict[str, Any]:
        """Kind and tool frame."""
        return {"kind": "tree", "tool": self.shape.tool.link}

    def format_urdf(self, theta: np.ndarray) -> str:
        """Return the robot file with these dimensions."""
        return format_corrected_urdf(self, theta)

    @property
    def shape(self) -> TreeShape:
        """The robot taken apart."""
        return self.tree.shape

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints, in the order of `q`."""
        return self.shape.robot.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`."""
        return self.shape.robot.position_units

    @property
    def home(self) -> np.ndarray:
        """Actuated positions in the middle of the workspace (na,)."""
        return self.shape.robot.home

    @property
    def orients(self) -> bool:
        """Whether the tool can turn: some revolute joint carries it."""
        joints = {j.index: j for j in self.shape.joints}
        return any(not joints[k].slides for k in self.shape.tool.carriers)

    @property
    def priority(self) -> np.ndarray:
        """Whole numbers (p,): offsets and lengths are kept first, then placements, then gear ratios and the tool's place."""
        return np.array([PRIORITY[knob.kind] for knob in self.knobs], int)

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses at `theta` (p,) and `q` (N, na).

        The assembly mode is that of the robot file's home; `start` is not needed.
        """
        poses, closed = self.tree.forward(self._numbers(theta), require_positions(self.shape.robot, q))
        return Predicted(poses, closed.ok, closed.reason)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p), loops kept closed; nan where they cannot be closed."""
        return self.tree.twists(self._numbers(theta), require_positions(self.shape.robot, q), self.knobs)[0]

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na), loops kept closed."""
        return self.tree.twists(self._numbers(theta), require_positions(self.shape.robot, q), ())[1]

    def left_open(self, theta: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the largest distance (N,) [m] between points that should coincide, where loops are over-constrained."""
        return self.tree.loops.close(self._numbers(theta), require_positions(self.shape.robot, q)).open

    def freed(self, names: Iterable[str]) -> TreeGeometry:
        """Return the geometry with exactly these parameters free, by name or shell pattern."""
        wanted = {found for name in names for found in self.parameters.match(name)}
        changes = {p.name: {"free": p.name in wanted} for p in self.parameters}
        return replace(self, parameters=self.parameters.update(changes))

    def only(self, names: Sequence[str]) -> TreeGeometry:
        """Return the geometry with these parameters alone, in this order; the others stay as in the robot file."""
        index = [self.parameters.names.index(name) for name in names if name in self.parameters]
        if len(index) < len(names):
            raise UnknownName("geometry parameter", next(n for n in names if n not in self.parameters), self.parameters)
        return replace(self, parameters=self.parameters.select(names), knobs=tuple(self.knobs[k] for k in index))

    def with_values(self, theta: np.ndarray) -> Parameters:
        """Return the parameters at other values (p,)."""
        return self.parameters.with_values(np.asarray(theta, float))

    def place(self, theta: np.ndarray, q: np.ndarray) -> tuple[TreeNumbers, np.ndarray]:
        """Return the tree at `theta` (p,) and the positions of all its joints (nv, N) at `q` (N, na)."""
        numbers = self._numbers(theta)
        return numbers, self.tree.loops.close(numbers, require_positions(self.shape.robot, q)).x

    def _numbers(self, theta: np.ndarray) -> TreeNumbers:
        theta = np.asarray(theta, float)
        if theta.shape != (len(self.knobs),):
            raise InputError("wrong_shape", f"this geometry has {len(self.knobs)} parameters, not {theta.shape}")
        return compute_dimensions_at(self.shape, self.knobs, theta, self.parameters.values)


def build_tree_geometry(robot: Robot, *, tool: str | None = None) -> TreeGeometry:
    """Build the geometry of any robot file.

    Args:
        robot: The robot.
        tool: Frame that was measured; by default `tool`, or the last link of a robot with a single chain.

    Raises:
        InputError: A joint has several degrees of freedom, or it is not clear which frame is the tool.
        LoopClosureError: The loops cannot be closed at home.
    """
    tree = TreeDimensions(get_shape(robot, tool))
    return TreeGeometry(tree, tree.parameters, tree.knobs)


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
