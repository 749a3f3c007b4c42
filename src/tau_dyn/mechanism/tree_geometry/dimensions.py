"""A tree with loops as named parameters: its dimensions, the part that each of them moves, and the tree at given values.

Joint j is at `origin` [m] in its parent link's frame, turned by the robot file's rotation times `exp([r]x)`:
`<joint>.rx ry rz` is a small rotation vector in the joint's own axes [rad], zero in the file. An actuated joint moves
by `gain * q + offset`. Loops join points of two links: `<link>.anchor_x..`, or `<rod>.length` where the link is a rod
that hangs on passive turns, so that only the distance from those to the point matters. Reference: Mooring, Roth &
Driels 1991, ch. 2; Khalil & Dombre 2002, ch. 11.

Left out of a fit unless requested (`free=False`): parameters with the same effect as another one (a turn of a revolute joint
about its own axis and a shift of a slide along itself equal its offset), the axes of a universal joint, gear ratios, the tool's
position (the fit has its own `tool.x` ..), and parameters without effect on the tool, such as the positions of the six joints
that represent a free plate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Joint, list_joints
from tau_dyn.parameters import Parameter
from tau_dyn.robot import Robot, read_annotations

AXES = ("x", "y", "z")


class Anchor(NamedTuple):
    """A point of a link.

    Attributes:
        link: Its name.
        joint: Index of the joint that carries the link.
        local: Where the point is in that joint's frame (3,) [m].
        axes: The link's axes in the joint's frame (3, 3).
        carriers: Joints that move it, from the base outwards.
    """

    link: str
    joint: int
    local: np.ndarray
    axes: np.ndarray
    carriers: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class TreeShape:
    """A robot's tree, loops and tool, as the robot file has them.

    Attributes:
        robot: The robot.
        joints: Its joints, parents first.
        within: Frame of the parent *link* in the parent joint's, one a joint.
        ends: The loops' points: A and B of the first loop, A and B of the second, and so on.
        tool: Where the tool is; `axes` are the tool frame's.
        active: Columns of the actuated joints in the tree's velocity (na,).
        passive: Columns of the others (empty without loops: such joints stay at zero).
    """

    robot: Robot
    joints: tuple[Joint, ...]
    within: tuple[pin.SE3, ...]
    ends: tuple[Anchor, ...]
    tool: Anchor
    active: np.ndarray
    passive: np.ndarray

    @property
    def n_loops(self) -> int:
        """Number of loops."""
        return len(self.ends) // 2

    def place(self, x: np.ndarray, q: np.ndarray) -> None:
        """Put actuated positions (na, N), and those of the joints that follow them, into all joints' (nv, N)."""
        x[self.active] = q
        if self.robot.mimics:
            share, offset = self.robot.coupling
            rows = np.flatnonzero(share.any(axis=1))
            x[rows] = share[rows] @ q + offset[rows, None]

    def gather(self, columns: np.ndarray) -> np.ndarray:
        """Return derivatives by actuated positions (m, na, N) of those by all joints (m, nv, N)."""
        if not self.robot.mimics:
            return columns[:, self.active]
        return np.einsum("mvn,va->man", columns, self.robot.coupling[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.robot.model.names[j.index] for j in self.joints)


class Knob(NamedTuple):
    """The effect of one parameter.

    Attributes:
        kind: 'origin', 'rotation', 'offset', 'gain', 'anchor', 'length' or 'tool'.
        at: Position of the joint in `joints`, of the actuated joint in `active`, or of the point in `ends`; 0 for the tool.
        direction: Unit vector (3,): of an origin in the parent joint's frame, of a rotation in the joint's own axes, of an
            anchor, a length or the tool in the frame of the joint that carries the link.
    """

    kind: str
    at: int
    direction: np.ndarray


@dataclass(frozen=True, eq=False)
class TreeNumbers:
    """A tree at given parameters.

    Attributes:
        joints: Joints at their placements.
        turned: Right Jacobian (3, 3) of each joint's rotation vector.
        points: The loops' points in their joints' frames (2 * loops, 3) [m].
        tool: The tool point in its joint's frame (3,) [m].
        gain: Gain of the actuated joints (na,).
        offset: Offset of the actuated joints (na,) [m or rad].
        key: The parameters' values as bytes, which distinguish these numbers from others of the same tree.
    """

    joints: list[Joint]
    turned: list[np.ndarray]
    points: np.ndarray
    tool: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    key: bytes


def get_shape(robot: Robot, tool: str | None = None) -> TreeShape:
    """Read the parameters of a robot.

    Args:
        robot: The robot.
        tool: Frame that was measured; by default `tool`, or the last frame of a robot with a single chain.

    Raises:
        InputError: A joint has several degrees of freedom, or it is not clear which frame is the tool.
    """
    joints = list_joints(robot.model)
    if joints is None:
        raise InputError(
            "unsupported",
            f"{robot.source}: calibration needs joints of one degree of freedom; "
            "write a spherical or floating joint as several revolute and prismatic ones",
        )
    notes = read_annotations(robot.urdf, robot.source)
    pairs = [((b.link_a, b.point_a), (b.link_b, b.point_b)) for b in notes.loops]
    ends = tuple(_anchor(robot.model, link, np.array(point)) for pair in pairs for link, point in pair)
    passive = robot.passive_v if ends else np.zeros(0, int)
    frame = robot.model.frames[compute_tool_frame(robot, tool)]
    at = Anchor(
        frame.name, frame.parentJoint, frame.placement.translation.copy(), frame.placement.rotation.copy(),
        _carriers(robot.model, frame.parentJoint),
    )  # fmt: skip
    return TreeShape(robot, tuple(joints), _parent_links(robot, joints), ends, at, robot.active_v, passive.astype(int))


def compute_tool_frame(robot: Robot, tool: str | None = None) -> int:
    """Return the index of the frame that is measured.

    Raises:
        InputError: There is no frame `tool` and the robot has several chains.
        UnknownName: The requested frame does not exist.
    """
    model = robot.model
    if tool is not None:
        if not model.existFrame(tool):
            raise UnknownName("frame", tool, [f.name for f in model.frames[1:]], robot.source)
        return model.getFrameId(tool)
    if robot.tool_frame is not None:
        return robot.tool_frame
    tips = [k for k in range(1, model.njoints) if k not in list(model.parents)]
    if len(tips) != 1:
        listed = ", ".join(f.name for f in model.frames[1:] if f.type == pin.FrameType.BODY)
        raise InputError(
            "unsupported",
            f"{robot.source} has no frame 'tool' and several chains; name the measured frame, one of {listed}",
        )
    on_tip = [k for k, f in enumerate(model.frames) if f.parentJoint == tips[0] and f.type == pin.FrameType.BODY]
    return on_tip[-1]


def compute_dimensions_at(
    shape: TreeShape, knobs: Sequence[Knob], theta: np.ndarray, nominal: np.ndarray
) -> TreeNumbers:
    """Return the tree at parameter values `theta` (p,), one a knob; `nominal` (p,) are the robot file's."""
    joints = list(shape.joints)
    vectors = np.zeros((len(joints), 3))
    points = np.array([end.local for end in shape.ends]).reshape(-1, 3)
    tool = shape.tool.local.copy()
    gain, offset = shape.robot.drive_scale, np.zeros(len(shape.active))
    for knob, value, before in zip(knobs, theta, nominal, strict=True):
        if knob.kind == "gain":
            gain[knob.at] = value
        elif knob.kind == "offset":
            offset[knob.at] = value
        elif knob.kind == "rotation":
            vectors[knob.at] += value * knob.direction
        elif value != before and knob.kind == "origin":
            joint = joints[knob.at]
            joints[knob.at] = joint._replace(offset=joint.offset + (value - before) * knob.direction)
        elif value != before and knob.kind == "tool":
            tool += (value - before) * knob.direction
        elif value != before:
            points[knob.at] += (value - before) * knob.direction
    key = np.asarray(theta, float).tobytes()
    for k in np.flatnonzero(vectors.any(axis=1)):
        joints[k] = joints[k]._replace(rotation=joints[k].rotation @ pin.exp3(vectors[k]))
    return TreeNumbers(joints, [np.asarray(pin.Jexp3(v)) for v in vectors], points, tool, gain, offset, key)


def _carriers(model: pin.Model, joint: int) -> tuple[int, ...]:
    return tuple(model.supports[joint].tolist()[1:])


def _anchor(model: pin.Model, link: str, point: np.ndarray) -> Anchor:
    body = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
    joint = body.parentJoint
    return Anchor(link, joint, body.placement.act(point), body.placement.rotation.copy(), _carriers(model, joint))


def _parent_links(robot: Robot, joints: Sequence[Joint]) -> tuple[pin.SE3, ...]:
    """Return the placement of each joint's parent link in the parent joint's frame: not the origin after a fixed joint."""
    parents = {e.get("name", ""): _parent(e) for e in fromstring(robot.urdf).findall("joint")}
    model = robot.model
    return tuple(
        pin.SE3(model.frames[model.getFrameId(parents[model.names[j.index]], pin.FrameType.BODY)].placement)
        for j in joints
    )


def _parent(joint: Element) -> str:
    parent = joint.find("parent")
    return parent.get("link", "") if parent is not None else ""


_ALIGNED = 1 - 1e-9  # cosine from which two directions are one
PRIORITY = {"length": 0, "offset": 0, "origin": 1, "rotation": 1, "anchor": 1, "gain": 2, "tool": 3}
"""Among parameters that depend on each other, kinds with smaller numbers are kept; in one kind those that poses determine best.
Placements are equal: an order among them would keep combinations that are distinguished only by the deviation of this machine's
axes from parallel."""


class TreeParameter(NamedTuple):
    """A parameter and its effect."""

    parameter: Parameter
    knob: Knob


def build_rows(shape: TreeShape) -> list[TreeParameter]:
    """Return all geometric parameters of a tree at the robot file's values: joints, then the loops' points, then the tool."""
    rows = [row for k in range(len(shape.joints)) for row in _joint_rows(shape, k)]
    rows += [row for k in range(len(shape.ends)) for row in _end_rows(shape, k)]
    return rows + _tool_rows(shape)


def _joint_rows(shape: TreeShape, k: int) -> list[TreeParameter]:
    joint, name = shape.joints[k], shape.names[k]
    actuated = joint.v in shape.active
    compound = _in_universal(shape, joint)
    place = shape.within[k].actInv(joint.offset)
    rows = []
    if actuated:
        a = int(np.flatnonzero(shape.active == joint.v)[0])
        unit = "m" if joint.slides else "rad"
        rows.append(TreeParameter(Parameter(f"{name}.offset", 0.0, unit), Knob("offset", a, joint.axis)))
    along = joint.rotation @ joint.axis
    for i, axis in enumerate(AXES):
        way = shape.within[k].rotation[:, i]
        free = not compound and not (joint.slides and abs(way @ along) > _ALIGNED)
        rows.append(
            TreeParameter(Parameter(f"{name}.origin_{axis}", float(place[i]), "m", free=free), Knob("origin", k, way))
        )
    for i, axis in enumerate(AXES):
        own = not joint.slides and abs(joint.axis[i]) > _ALIGNED
        parameter = Parameter(f"{name}.r{axis}", 0.0, "rad", free=not compound and not own)
        rows.append(TreeParameter(parameter, Knob("rotation", k, np.eye(3)[i])))
    if actuated:
        a = int(np.flatnonzero(shape.active == joint.v)[0])
        gain = Parameter(f"{name}.gain", float(shape.robot.drive_scale[a]), "1", free=False)
        rows.append(TreeParameter(gain, Knob("gain", a, joint.axis)))
    return rows


def _end_rows(shape: TreeShape, k: int) -> list[TreeParameter]:
    end = shape.ends[k]
    if is_rod(shape, k):
        length = float(np.linalg.norm(end.local))
        owner = end.link.removesuffix("_link")
        return [
            TreeParameter(Parameter(f"{owner}.length", length, "m", lower=0.0), Knob("length", k, end.local / length))
        ]
    value, name = end.axes.T @ end.local, _anchor_name(shape, k)
    value = value - end.axes.T @ _link_origin(shape, end.link)
    return [
        TreeParameter(Parameter(f"{end.link}.{name}_{axis}", float(value[i]), "m"), Knob("anchor", k, end.axes[:, i]))
        for i, axis in enumerate(AXES)
    ]


def _link_origin(shape: TreeShape, link: str) -> np.ndarray:
    model = shape.robot.model
    return model.frames[model.getFrameId(link)].placement.translation


def _tool_rows(shape: TreeShape) -> list[TreeParameter]:
    value = shape.tool.local
    return [
        TreeParameter(Parameter(f"tool.origin_{axis}", float(value[i]), "m", free=False), Knob("tool", 0, np.eye(3)[i]))
        for i, axis in enumerate(AXES)
    ]


def is_rod(shape: TreeShape, k: int) -> bool:
    """Whether a loop's point is the end of a rod: a link that carries no other link, on passive turns that meet in a point."""
    end = shape.ends[k]
    if sum(other.joint == end.joint for other in shape.ends) > 1 or end.joint in shape.tool.carriers:
        return False
    if end.joint == 0 or any(j.parent == end.joint for j in shape.joints) or not end.local.any():
        return False
    return _turns_passively(shape, shape.joints[end.joint - 1])


def _turns_passively(shape: TreeShape, joint: Joint) -> bool:
    return not joint.slides and joint.v not in shape.active


def _in_universal(shape: TreeShape, joint: Joint) -> bool:
    """Whether a joint is the second or third turn of a universal or spherical joint, whose axes meet by construction."""
    if joint.parent == 0 or joint.offset.any() or not _turns_passively(shape, joint):
        return False
    return _turns_passively(shape, shape.joints[joint.parent - 1])


def _anchor_name(shape: TreeShape, k: int) -> str:
    """Return `anchor`, or `anchor_<other link>` where a link carries several points, numbered where that is not enough."""
    mine = [j for j, end in enumerate(shape.ends) if end.link == shape.ends[k].link]
    if len(mine) == 1:
        return "anchor"
    others = [shape.ends[j ^ 1].link.removesuffix("_link") for j in mine]
    other = shape.ends[k ^ 1].link.removesuffix("_link")
    if others.count(other) == 1:
        return f"anchor_{other}"
    before: Sequence[str] = others[: mine.index(k) + 1]
    return f"anchor_{other}_{before.count(other)}"
