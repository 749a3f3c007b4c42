"""The robot at home as a line drawing: guideways, carts, rods, plate, or the chain of an arm; from its tree alone.

A link is drawn through the points where it meets others: its own joint, its children's joints and its loops' ends. Two
points make a rod, more make a plate. The view is that of `projection.py`.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pinocchio as pin
from markupsafe import Markup

from tau_dyn.exceptions import TauDynError
from tau_dyn.mechanism import LoopSolver
from tau_dyn.report.projection import View, draw_outline, draw_triad
from tau_dyn.report.svg import format_path, format_tag
from tau_dyn.robot import Robot

WIDTH, HEIGHT, MARGIN = 380, 290, 34


def draw_robot_picture(robot: Robot, named: Collection[str] = ()) -> Markup:
    """Return the drawing, the named joints in another colour, or nothing where the robot cannot be put at home."""
    try:
        solver = LoopSolver(robot)
        q = solver.close(robot.home)
    except TauDynError:
        return Markup("")
    data = solver.data
    pin.computeJointJacobians(robot.model, data, q)
    pin.updateFramePlacements(robot.model, data)
    return _drawing(robot, data, _shapes(robot, data), _guideways(robot, data), named)


def _shapes(robot: Robot, data: pin.Data) -> list[np.ndarray]:
    """Return the points (n, 3) of every link that reaches from somewhere to somewhere else."""
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
    robot: Robot, data: pin.Data, shapes: list[np.ndarray], rails: dict[str, np.ndarray], named: Collection[str]
) -> Markup:
    joints = [data.oMi[robot.model.getJointId(j)].translation for j in robot.actuated]
    view = View.of(np.concatenate([*shapes, *rails.values(), np.array(joints)]), WIDTH, HEIGHT, MARGIN)
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
    return format_tag(
        "svg",
        format_tag("title", text),
        *pieces,
        draw_triad(26, HEIGHT - 22, 18),
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        role="img",
        class_="robot",
    )


def _link(points: np.ndarray) -> Markup:
    path = format_path(points) if len(points) == 2 else draw_outline(points)
    return format_tag("path", d=path, class_="plate" if path.endswith("Z") else "rod")


def build_joint_labels(robot: Robot) -> list[str]:
    """Return what the drawing calls the actuated joints: short names as they are, numbers where they would not fit."""
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
