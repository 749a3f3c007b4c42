"""Where every shape is at given actuated positions, loops closed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from tau_dyn.kinematics import LoopSolver
from tau_dyn.robot import Robot
from tau_dyn.view.shapes import Shape


class Placer:
    """Places a robot's shapes."""

    def __init__(self, robot: Robot, shapes: Sequence[Shape]) -> None:
        """Prepare for a robot and its shapes."""
        self.robot, self.shapes = robot, tuple(shapes)
        self._solver = LoopSolver(robot)
        self._local = [pin.SE3(s.rotation, s.position) for s in self.shapes]

    def __call__(self, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position (3,) [m] and quaternion (4,) w x y z in the world, of each shape, at actuated positions (na,).

        Raises:
            LoopClosureError: The robot cannot reach these positions.
        """
        model, data = self.robot.model, self._solver.data
        pin.forwardKinematics(model, data, self._solver.close(q))
        pin.updateFramePlacements(model, data)
        placed = [data.oMi[s.joint].act(local) for s, local in zip(self.shapes, self._local, strict=True)]
        return [(p.translation, _wxyz(p.rotation)) for p in placed]

    @property
    def tool(self) -> np.ndarray | None:
        """The tool's position (3,) [m] at the last call, or None for a robot without a tool."""
        frame = self.robot.tool_frame
        return None if frame is None else self._solver.data.oMf[frame].translation.copy()

    def moved_by(self, joint: str) -> list[int]:
        """Return which shapes a joint carries itself: up to the next actuated joint, to show where it is."""
        model, mine = self.robot.model, self.robot.model.getJointId(joint)
        others = {model.getJointId(j) for j in self.robot.actuated} - {mine}
        carried = {mine}
        for child in range(1, model.njoints):
            if model.parents[child] in carried and child not in others:
                carried.add(child)
        return [k for k, s in enumerate(self.shapes) if s.joint in carried]


def _wxyz(rotation: np.ndarray) -> np.ndarray:
    x, y, z, w = pin.Quaternion(rotation).coeffs()
    return np.array([w, x, y, z])
