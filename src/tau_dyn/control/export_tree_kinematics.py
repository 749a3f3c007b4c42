"""The tool of a tree on expressions, with its loops' gaps and all derivatives by the joints that move."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.control.export_loops import Loops, spread_over_joints
from tau_dyn.control.export_tree import Tree, remove_rounding
from tau_dyn.control.expression_arrays import compute_cross_product
from tau_dyn.robot import Robot


class ToolOnTree(NamedTuple):
    """The tool's place (3,) [m], rotation (3, 3) and twist by drives and solved joints (6, na + np), linear first."""

    p: np.ndarray
    R: np.ndarray
    twist: np.ndarray


class TreeKinematics:
    """A tree's joints in the order of the export: drives first, then the passive joints that are solved for.

    Attributes:
        loops: The loops, or None.
        passive: Places of the solved joints in the tree.
    """

    def __init__(self, robot: Robot) -> None:
        """Choose the equations that close the loops at home."""
        self.robot, self.tree = robot, Tree(robot)
        self.loops = Loops(robot, self.tree) if robot.loops else None
        self.active = [self.tree.index(name) for name in robot.actuated]
        self.passive = [] if self.loops is None else self.loops.passive
        assert robot.tool_frame is not None
        self._frame: pin.Frame = robot.model.frames[robot.tool_frame]

    def place(self, q: Any, z: Any) -> list[Any]:
        """Return one position a joint of the tree."""
        rest = [0.0] * len(self.tree.joints) if self.loops is None else list(self.loops.home)
        return spread_over_joints(rest, (self.active, q), (self.passive, z))

    def gaps(self, q: Any, z: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the solved equations' gaps (np,) [m] and their derivatives (np, na + np)."""
        assert self.loops is not None
        closure = self.loops.closure(self.place(q, z))
        return closure.gap[self.loops.rows], closure.jacobian[np.ix_(self.loops.rows, [*self.active, *self.passive])]

    def tool(self, q: Any, z: Any) -> ToolOnTree:
        """Return the tool's pose and twist."""
        tree, still = self.tree, [0.0] * len(self.tree.joints)
        places = tree.places(tree.motions(self.place(q, z), still, still, np.zeros(3)))
        k = self._frame.parentJoint - 1
        R, p = places[k] if k >= 0 else (np.eye(3), np.zeros(3))
        at, order = p + R @ remove_rounding(self._frame.placement.translation), [*self.active, *self.passive]
        twist = np.zeros((6, len(order)), dtype=object)
        for j in set(tree.chain(k)) & set(order):
            axis, column = places[j][0] @ tree.joints[j].axis, order.index(j)
            slides = tree.joints[j].slides
            twist[:3, column] = axis if slides else compute_cross_product(axis, at - places[j][1])
            twist[3:, column] = 0.0 if slides else axis
        return ToolOnTree(at, R @ remove_rounding(self._frame.placement.rotation), twist)
