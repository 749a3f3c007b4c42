"""Names, nominal values and freedom of a tree's geometric parameters.

Left out of a fit unless asked for (`free=False`): what another parameter does just as well (a turn of a revolute joint
about its own axis is its offset, a shift of a slide along itself likewise), the axes of a universal joint, gear ratios,
the tool's place (the fit has `tool.x` .. of its own), and what does not reach the tool at all, such as where the six
joints sit that stand for a free plate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.tree_shape import AXES, Knob, TreeShape
from tau_dyn.mechanism import Joint
from tau_dyn.parameters import Parameter

_ALIGNED = 1 - 1e-9  # cosine from which two directions are one
PRIORITY = {"length": 0, "offset": 0, "origin": 1, "rotation": 1, "anchor": 1, "gain": 2, "tool": 3}
"""Of parameters that depend on each other, kinds with smaller numbers are kept; among equals those that poses show best.
Placements are equals: an order among them would keep combinations that are told apart only by how far the axes of this
one machine are from parallel."""


class TreeParameter(NamedTuple):
    """A parameter and what it does."""

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
        rows.append(TreeParameter(Parameter(f"{name}.gain", 1.0, "1", free=False), Knob("gain", a, joint.axis)))
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
    """Whether a loop's point is the end of a rod: a link that carries nothing else, on passive turns that meet in a point."""
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
