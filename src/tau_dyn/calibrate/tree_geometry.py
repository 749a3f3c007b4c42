r"""Any robot file as a geometry for calibration: joint placements, offsets, rod lengths and loop points are the parameters.

A serial arm, a tree with ball constraints (Delta, H4, Stewart) or a planar linkage: the tree is placed at the
parameters' values (`tree_shape.py`), the loops are closed by Newton (`tree_closure.py`), derivatives are analytic
(`loop_derivatives.py`).

    geometry = tree_geometry(load_robot("arm.urdf"))
    fit(geometry, poses)

Of planar loops only what lies in the plane can be closed; what does not stays open, as in the clearance of real
bearings, and `left_open` says how much.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tau_dyn.calibrate.geometry import Predicted, WithoutClosure
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import (
    PRIORITY,
    ClosedConfigurations,
    Knob,
    Poses,
    TreeClosure,
    TreeDimensions,
    TreeNumbers,
    TreeShape,
    compute_dimensions_at,
    compute_frames,
    compute_open_rates,
    get_shape,
    multiply_by_rotation,
    propagate_twists,
    require_positions,
    transform_point,
)
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot


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
    tree = TreeDimensions(get_shape(robot, tool))
    return TreeGeometry(tree.shape, tree.parameters, tree.knobs)
