"""Any robot file as a geometry for calibration: joint placements, offsets, rod lengths and loop points are the parameters.

A serial arm, a tree with ball constraints (Delta, H4, Stewart) or a planar linkage; `mechanism` closes the loops and computes
their derivatives at any dimensions. Planar loops are closed only in their plane; the gap out of the plane remains, as in the
clearance of real bearings, and `left_open` returns its size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.calibrate.geometry import Geometry, Predicted
from tau_dyn.calibrate.robot_file import format_corrected_tree
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


@dataclass(frozen=True, eq=False)
class TreeGeometry(Geometry):
    """A tree, with or without loops, whose placements are parameters; build it with `build_tree_geometry`.

    Attributes:
        tree: The robot with variable dimensions.
        parameters: Nominal values, those of the robot file.
        knobs: Dimension that each parameter changes.
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
        return format_corrected_tree(self.shape, self._numbers(theta))

    @property
    def shape(self) -> TreeShape:
        """Topology and dimensions of the robot."""
        return self.tree.shape

    @property
    def robot(self) -> Robot:
        """The robot file."""
        return self.shape.robot

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

    def passive(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return the positions (N, k) of passive joints that close the loops, nan where they cannot be closed."""
        closed = self.tree.loops.close(self._numbers(theta), require_positions(self.shape.robot, q))
        return np.where(closed.ok[:, None], closed.x[self.shape.passive[self._find_passive(joints)]].T, np.nan)

    def passive_by_parameter(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per parameter (N, k, p), loops kept closed."""
        return self._passive_rates(theta, q, self.knobs, joints)[0]

    def passive_by_joint(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per actuated joint (N, k, na), loops kept closed."""
        return self._passive_rates(theta, q, (), joints)[1]

    def _passive_rates(
        self, theta: np.ndarray, q: np.ndarray, knobs: Sequence[Knob], joints: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        q = require_positions(self.shape.robot, q)
        return self.tree.passive_rates(self._numbers(theta), q, knobs, self._find_passive(joints))

    def _find_passive(self, joints: Sequence[str]) -> list[int]:
        """Return the indices of joints among the passive ones (k,).

        Raises:
            UnknownName: A joint is actuated or does not exist.
        """
        column = {j.v: name for j, name in zip(self.shape.joints, self.shape.names, strict=True)}
        names = [column[v] for v in self.shape.passive.tolist()]
        for joint in joints:
            if joint not in names:
                raise UnknownName("passive joint", joint, names)
        return [names.index(joint) for joint in joints]

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
