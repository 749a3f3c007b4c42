"""Where every shape is at given actuated positions, loops closed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import Robot
from tau_dyn.view.shapes import Shape

Placed = list[tuple[np.ndarray, np.ndarray]]
"""Position (3,) [m] and quaternion (4,) w x y z in the world, of each shape."""


class Placer:
    """Places a robot's shapes."""

    def __init__(self, robot: Robot, shapes: Sequence[Shape]) -> None:
        """Prepare for a robot and its shapes."""
        self.robot, self.shapes = robot, tuple(shapes)
        self._solver = LoopSolver(robot)
        self._local = [s.local for s in self.shapes]

    def __call__(self, q: np.ndarray) -> Placed:
        """Return where each shape is at actuated positions (na,).

        Raises:
            LoopClosureError: The robot cannot reach these positions.
        """
        model, data = self.robot.model, self._solver.data
        pin.forwardKinematics(model, data, self._solver.close(q))
        pin.updateFramePlacements(model, data)
        return [convert_pose(data.oMi[s.joint] * local) for s, local in zip(self.shapes, self._local, strict=True)]

    @property
    def tool(self) -> pin.SE3 | None:
        """The tool's pose at the last call, or None for a robot without a tool."""
        frame = self.robot.tool_frame
        return None if frame is None else pin.SE3(self._solver.data.oMf[frame])

    def at(self, joint: str) -> np.ndarray:
        """Return where a joint is at the last call (3,) [m]."""
        return self._solver.data.oMi[self.robot.model.getJointId(joint)].translation.copy()

    def moved_by(self, joint: str) -> list[int]:
        """Return which shapes a joint carries itself: up to the next actuated joint, to show where it is."""
        model, mine = self.robot.model, self.robot.model.getJointId(joint)
        others = {model.getJointId(j) for j in self.robot.actuated} - {mine}
        carried = {mine}
        for child in range(1, model.njoints):
            if model.parents[child] in carried and child not in others:
                carried.add(child)
        return [k for k, s in enumerate(self.shapes) if s.joint in carried]

    def carried_by(self, part: str) -> list[int]:
        """Return the shapes of a joint, link or rod of this name; none where the robot has no such part."""
        model = self.robot.model
        if part in self.robot.actuated:
            return self.moved_by(part)
        links = [name for name in (part, f"{part}_link") if model.existFrame(name, pin.FrameType.BODY)]
        joint = model.frames[model.getFrameId(links[0], pin.FrameType.BODY)].parentJoint if links else None
        if joint is None and model.existJointName(part):
            joint = model.getJointId(part)
        return [k for k, s in enumerate(self.shapes) if s.joint == joint]


def convert_pose(place: pin.SE3) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose as position (3,) and quaternion (4,) w x y z."""
    return place.translation.copy(), convert_to_wxyz(pin.Quaternion(place.rotation))


def convert_to_wxyz(turn: pin.Quaternion) -> np.ndarray:
    """Return a quaternion's numbers (4,) w x y z, the order of viser."""
    x, y, z, w = turn.coeffs()
    return np.array([w, x, y, z])
