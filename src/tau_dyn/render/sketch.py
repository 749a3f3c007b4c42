"""Line drawings of robots and of points in space, from the robot's tree alone.

A link is drawn through its connections to other links: its own joint, its children's joints and its loops' ends. Two points
make a rod, more make a plate. All drawings share one orthographic view, from the front right and above; z is up, the drawing's
y is down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from markupsafe import Markup
from scipy.spatial import ConvexHull, QhullError

from tau_dyn.exceptions import TauDynError
from tau_dyn.mechanism import LoopSolver
from tau_dyn.render.chart import draw_svg, format_path, format_tag
from tau_dyn.results import RobotPicture, VectorPicture
from tau_dyn.robot import Robot

WIDTH, HEIGHT, MARGIN = 380, 290, 34
_AZIMUTH, _ELEVATION = np.deg2rad(-62.0), np.deg2rad(18.0)
_CA, _SA, _CE, _SE = np.cos(_AZIMUTH), np.sin(_AZIMUTH), np.cos(_ELEVATION), np.sin(_ELEVATION)
_SCREEN = np.array([[-_SA, _CA, 0.0], [_CA * _SE, _SA * _SE, -_CE], [_CA * _CE, _SA * _CE, _SE]])
"""Rows: right, down, towards the viewer."""
BOX_EDGES = tuple((i, i | 1 << a) for i in range(8) for a in range(3) if not i >> a & 1)
"""Pairs of corners, in the numbering of `compute_box_corners`."""


def project(points: np.ndarray) -> np.ndarray:
    """Return screen coordinates (n, 2) [m], right and down."""
    return np.atleast_2d(points) @ _SCREEN[:2].T


def project_with_depth(points: np.ndarray) -> np.ndarray:
    """Return screen coordinates, right and down, and the distance towards the viewer (n, 3) [m]."""
    return np.atleast_2d(points) @ _SCREEN.T


class Projection(NamedTuple):
    """Maps points of space to a drawing.

    Attributes:
        scale: Drawing units per metre.
        shift: Position of the origin (2,).
    """

    scale: float
    shift: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, width: float, height: float, margin: float) -> Projection:
        """Return the view in which points (n, 3) [m] fill a drawing up to its margins."""
        flat, sheet = project(points), np.array([width, height])
        low, high = flat.min(axis=0), flat.max(axis=0)
        scale = float(np.min((sheet - 2 * margin) / np.maximum(high - low, 1e-3)))
        return cls(scale, sheet / 2 - scale * (low + high) / 2)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Return points (n, 3) [m] on the drawing (n, 2)."""
        return self.scale * project(points) + self.shift


def compute_hull(flat: np.ndarray) -> np.ndarray | None:
    """Return the indices of the points (n, 2) on the convex hull, in order; None if all are on one line."""
    try:
        return ConvexHull(flat).vertices
    except (QhullError, ValueError):
        return None


def draw_outline(flat: np.ndarray) -> str:
    """Return the path around points (n, 2) of the drawing, or through them if they are on one line."""
    around = compute_hull(flat)
    return format_path(flat) if around is None else format_path(flat[around], closed=True)


def compute_box_corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box; bit `a` of a corner's number is 1 at the upper end of axis `a`."""
    return np.array([[(lower, upper)[k >> a & 1][a] for a in range(3)] for k in range(8)])


def draw_triad(x: float, y: float, length: float) -> Markup:
    """Return a small coordinate triad at a point of the drawing."""
    origin, pieces = np.array([x, y]), []
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        way = project(axis)[0]
        pieces.append(format_tag("path", d=format_path(np.array([origin, origin + length * way])), class_="triad"))
        at = origin + (length + 9) * way
        pieces.append(
            format_tag("text", name, x=float(at[0]), y=float(at[1]) + 3, text_anchor="middle", class_="triad-name")
        )
    return Markup("").join(pieces)


def draw_robot(picture: RobotPicture) -> Markup:
    """Return the drawing with the named joints in another colour; empty if the robot cannot reach home."""
    robot = picture.robot
    try:
        solver = LoopSolver(robot)
        q = solver.close(robot.home)
    except TauDynError:
        return Markup("")
    data = solver.data
    pin.computeJointJacobians(robot.model, data, q)
    pin.updateFramePlacements(robot.model, data)
    return _drawing(robot, data, _shapes(robot, data), _guideways(robot, data), picture.named)


def _shapes(robot: Robot, data: pin.Data) -> list[np.ndarray]:
    """Return the points (n, 3) of every link that has an extent."""
    model = robot.model
    shapes = []
    for joint in range(1, model.njoints):
        points = [data.oMi[joint].translation]
        points += [data.oMi[c].translation for c in range(1, model.njoints) if model.parents[c] == joint]
        ends = [end for loop in robot.loops for end in (loop.frame_a, loop.frame_b)]
        ends += [] if robot.tool_frame is None else [robot.tool_frame]
        points += [data.oMf[f].translation for f in ends if model.frames[f].parentJoint == joint]
        points = np.unique(np.round(points, 6), axis=0)
        if len(points) > 1:
            shapes.append(points)
    if robot.loops:
        return shapes
    kinds = zip(map(model.getJointId, robot.actuated), robot.joint_kinds, strict=True)
    feet = [data.oMi[j].translation for j, kind in kinds if kind == "revolute" and model.parents[j] == 0]
    return shapes + [np.array([np.zeros(3), place]) for place in feet if np.any(place)]


def _guideways(robot: Robot, data: pin.Data) -> dict[str, np.ndarray]:
    """Return both ends (2, 3) of every actuated prismatic joint's travel."""
    rails = {}
    for k, (name, kind) in enumerate(zip(robot.actuated, robot.joint_kinds, strict=True)):
        joint = robot.model.getJointId(name)
        if kind == "prismatic":
            axis = np.reshape(data.J, (6, -1))[:3, robot.model.joints[joint].idx_v]
            travel = np.array([robot.lower[k], robot.upper[k]]) - robot.home[k]
            travel = np.where(np.isfinite(travel), travel, [-0.5, 0.5])
            rails[name] = data.oMi[joint].translation + travel[:, None] * axis
    return rails


def _drawing(
    robot: Robot, data: pin.Data, shapes: list[np.ndarray], rails: dict[str, np.ndarray], named: tuple[str, ...]
) -> Markup:
    joints = [data.oMi[robot.model.getJointId(j)].translation for j in robot.actuated]
    view = Projection.of(np.concatenate([*shapes, *rails.values(), np.array(joints)]), WIDTH, HEIGHT, MARGIN)
    place = view.place
    pieces = [
        format_tag("path", d=format_path(place(rail)), class_="rail" + " named" * (name in named))
        for name, rail in rails.items()
    ]
    pieces += [_link(place(points)) for points in sorted(shapes, key=len, reverse=True)]
    spots = np.array([place(at)[0] for at in joints])
    kinds = zip(robot.joint_kinds, robot.actuated, spots, strict=True)
    pieces += [_joint(kind, float(x), float(y), name in named) for kind, name, (x, y) in kinds]
    tops = [min([s[1], *(place(p)[:, 1].min() for p in shapes if len(p) > 2 and _touches(p, at))])
            for s, at in zip(spots, joints, strict=True)]  # fmt: skip
    pieces += _labels(build_joint_labels(robot), spots, np.array(tops))
    if robot.tool_frame is not None and robot.loops:
        x, y = (float(c) for c in place(data.oMf[robot.tool_frame].translation)[0])
        pieces.append(format_tag("path", d=f"M{x - 9:.1f} {y:.1f}l9 -8l9 8l-9 8Z", class_="plate"))
        pieces.append(format_tag("text", "tool", x=x, y=y + 24, text_anchor="middle", class_="joint-name"))
    text = f"{robot.name} at its home position"
    return draw_svg(text, (WIDTH, HEIGHT), "robot", *pieces, draw_triad(26, HEIGHT - 22, 18))


def _link(points: np.ndarray) -> Markup:
    path = format_path(points) if len(points) == 2 else draw_outline(points)
    return format_tag("path", d=path, class_="plate" if path.endswith("Z") else "rod")


def build_joint_labels(robot: Robot) -> list[str]:
    """Return the labels of the actuated joints in the drawing: their names if they are short, else numbers."""
    fits = robot.na <= 4 and all(len(name) <= 8 for name in robot.actuated)
    return list(robot.actuated) if fits else [str(k + 1) for k in range(robot.na)]


def _touches(points: np.ndarray, at: np.ndarray) -> bool:
    return bool(np.any(np.all(np.isclose(points, at, atol=1e-5), axis=1)))


def _joint(kind: str, x: float, y: float, named: bool) -> Markup:
    class_ = "cart named" if named else "cart"
    if kind == "prismatic":
        return format_tag("rect", x=x - 8, y=y - 6, width=16, height=12, rx=2, class_=class_)
    return format_tag("circle", cx=x, cy=y, r=6, class_=class_)


def _labels(names: list[str], spots: np.ndarray, tops: np.ndarray) -> list[Markup]:
    """Return a label above each joint; joints drawn on top of each other share one."""
    pieces, done = [], np.zeros(len(spots), bool)
    for k, spot in enumerate(spots):
        near = ~done & (np.linalg.norm(spots - spot, axis=1) < 15)
        if not done[k]:
            text = ", ".join(names[i] for i in np.flatnonzero(near))
            y = float(tops[near].min()) - 11
            pieces.append(format_tag("text", text, x=float(spot[0]), y=y, text_anchor="middle", class_="joint-name"))
            done |= near
    return pieces


def draw_vectors(picture: VectorPicture) -> Markup:
    """Return vectors at points in space, a box around the points, and the axes' names at its lower corner."""
    low, high = picture.places.min(axis=0), picture.places.max(axis=0)
    corners = compute_box_corners(low, high)
    ends = picture.places + picture.times * picture.vectors
    view = Projection.of(corners, 520, 430, 60)
    starts, tips, box = view.place(picture.places), view.place(ends), view.place(corners)
    strokes = "".join(format_path(np.array(pair)) for pair in zip(starts, tips, strict=True))
    edges = "".join(format_path(box[list(pair)]) for pair in BOX_EDGES)
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in starts)
    names = [
        format_tag("text", "xyz"[a], x=float(box[1 << a][0]), y=float(box[1 << a][1]) - 4, class_="axis-name")
        for a in range(3)
    ]
    pieces = [format_tag("path", d=d, class_=ink) for d, ink in ((strokes, "error"), (dots, "spot"))]
    box_drawn = format_tag("path", d=edges, class_="box")
    return draw_svg("error vectors at unseen poses", (520, 430), "chart vectors", box_drawn, *names, *pieces)
