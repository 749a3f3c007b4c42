"""Calibrated placements back in the robot file: joint origins and loop points, so that every other program uses them too.

An offset becomes part of its joint's placement: `R exp([r]x) exp(offset axis)` for a turn, a shift along the axis for a
slide. The encoders keep counting as before. What a robot file cannot say (a gear ratio) is refused. Comments of the
original are lost, all else stays.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.calibrate.geometry import Predicted, WithoutClosure
from tau_dyn.calibrate.tree_closure import ClosedConfigurations, TreeClosure, compute_open_rates, propagate_twists
from tau_dyn.calibrate.tree_shape import (
    PRIORITY,
    Knob,
    TreeNumbers,
    TreeShape,
    build_rows,
    compute_dimensions_at,
    get_shape,
)
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses, compute_frames, multiply_by_rotation, require_positions, transform_point
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

_ROUNDING = 1e-10
"""[m or rad, per m or rad] what is left of a column that is zero."""
_UNSEEN = 1e-7
"""Size of a column relative to the largest of its unit below which a parameter does not reach the tool."""


@dataclass(frozen=True, eq=False)
class TreeGeometry(WithoutClosure):
    """A tree, with or without loops, whose placements are parameters; build it with `build_tree_geometry`.

    Attributes:
        shape: The robot taken apart.
        parameters: Nominal values, those of the robot file.
        knobs: What each parameter does.
    """

    shape: TreeShape
    parameters: Parameters
    knobs: tuple[Knob, ...]

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

    @cached_property
    def loops(self) -> TreeClosure:
        """The solver of the loops."""
        return TreeClosure(self.shape)

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses at `theta` (p,) and `q` (N, na).

        The assembly mode is that of the robot file's home; `start` is not needed.
        """
        numbers = self._numbers(theta)
        closed = self.loops.close(numbers, require_positions(self.shape.robot, q))
        at = compute_frames(numbers.joints, closed.x)
        position = transform_point(at, self.shape.tool.joint, numbers.tool).T
        rotation = np.moveaxis(
            multiply_by_rotation(at.rotation[self.shape.tool.joint], self.shape.tool.axes), 2, 0
        ).copy()
        position[~closed.ok] = rotation[~closed.ok] = np.nan
        return Predicted(Poses(position, rotation), closed.ok, closed.reason)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p), loops kept closed; nan where they cannot be closed."""
        return self._linearised(theta, q, self.knobs)[0]

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na), loops kept closed."""
        return self._linearised(theta, q, ())[1]

    def left_open(self, theta: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the largest distance (N,) [m] between points that should coincide, where loops are over-constrained."""
        return self.loops.close(self._numbers(theta), require_positions(self.shape.robot, q)).open

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
        return numbers, self.loops.close(numbers, require_positions(self.shape.robot, q)).x

    def _numbers(self, theta: np.ndarray) -> TreeNumbers:
        theta = np.asarray(theta, float)
        if theta.shape != (len(self.knobs),):
            raise InputError("wrong_shape", f"this geometry has {len(self.knobs)} parameters, not {theta.shape}")
        return compute_dimensions_at(self.shape, self.knobs, theta, self.parameters.values)

    def _linearised(self, theta: np.ndarray, q: np.ndarray, knobs: Sequence[Knob]) -> tuple[np.ndarray, np.ndarray]:
        numbers, q = self._numbers(theta), require_positions(self.shape.robot, q)
        closed: ClosedConfigurations = self.loops.close(numbers, q)
        found = compute_open_rates(self.shape, numbers, knobs, compute_frames(numbers.joints, closed.x), closed.x, q.T)
        by_parameter, by_joint = propagate_twists(self.shape, found, closed.inverse, numbers.gain)
        by_parameter[~closed.ok] = by_joint[~closed.ok] = np.nan
        return by_parameter, by_joint


def build_tree_geometry(robot: Robot, *, tool: str | None = None) -> TreeGeometry:
    """Build the geometry of any robot file.

    Args:
        robot: The robot.
        tool: Frame that was measured; by default `tool`, or the last link of a robot with a single chain.

    Raises:
        InputError: A joint has several degrees of freedom, or it is not clear which frame is the tool.
        LoopClosureError: The loops cannot be closed at home.
    """
    shape = get_shape(robot, tool)
    rows = build_rows(shape)
    parameters = Parameters([row.parameter for row in rows])
    full = TreeGeometry(shape, parameters, tuple(row.knob for row in rows))
    return replace(full, parameters=Parameters(_without_unseen(full)))


def _without_unseen(geometry: TreeGeometry) -> list[Parameter]:
    """Return the parameters with those fixed that do not reach the tool near home."""
    robot = geometry.shape.robot
    reach = np.where(np.isfinite(robot.upper - robot.lower), 0.3 * (robot.upper - robot.lower), 0.6)
    spread = np.random.default_rng(0).uniform(-0.5, 0.5, (12, robot.na)) * np.minimum(reach, 0.6)
    columns = geometry.tool_by_parameter(geometry.parameters.values, robot.home + spread)
    columns = columns[np.isfinite(columns).all(axis=(1, 2))].reshape(-1, len(geometry.knobs))
    size = np.abs(columns).max(axis=0, initial=0.0)
    out = []
    for p, mine in zip(geometry.parameters, size, strict=True):
        alike = max(
            (s for other, s in zip(geometry.parameters, size, strict=True) if other.unit == p.unit), default=0.0
        )
        unseen = len(columns) > 0 and mine < max(_UNSEEN * alike, _ROUNDING)
        out.append(replace(p, free=False, origin="robot file; does not reach the tool") if unseen else p)
    return out


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
