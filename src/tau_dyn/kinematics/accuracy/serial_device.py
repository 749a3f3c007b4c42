"""A serial arm, or any mechanism that is not rods, with errors of its actuators: the same questions through the whole tree."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.error_bounds import ErrorBounds
from tau_dyn.kinematics.accuracy.rod_device import Moved, State
from tau_dyn.mechanism import Poses, forward_kinematics, jacobian
from tau_dyn.robot import Robot


class SerialDevice:
    """A mechanism known by its tree alone; each actuator errs within an interval along its own motion."""

    def __init__(self, robot: Robot, errors: ErrorBounds) -> None:
        """Prepare.

        Raises:
            InputError: An error is asked of a rod, or across a joint's motion.
        """
        if errors.rods:
            raise InputError(
                "unsupported",
                f"{robot.source}: no rods between chains and a plate are known here; give errors of actuators only",
            )
        for joint, error in errors.actuators.items():
            if error.axes is not None:
                raise InputError(
                    "unsupported",
                    f"{joint}: x, y and z are for carts that carry rods; give one number, its own motion's",
                )
        self.robot = robot
        self.along = np.array([errors.actuators[j].along if j in errors.actuators else 0.0 for j in robot.actuated])
        erring = np.flatnonzero(self.along)
        self.labels = tuple(robot.actuated[j] for j in erring)
        self.m, self.balls = len(erring), tuple(slice(k, k + 1) for k in range(len(erring)))
        self._actuator = np.zeros((robot.na, self.m))
        self._actuator[erring, range(self.m)] = self.along[erring]

    def state(self, q: np.ndarray, tool: Poses) -> State:
        """Return the state at actuated positions (N, na) and the tool's poses there."""
        return State(q, tool.position, tool.rotation, tool)

    def by_actuators(self, state: State) -> np.ndarray:
        """Return `d(tool) / dq` (N, 3 or 6, na)."""
        return jacobian(self.robot, state.q, Poses(state.position, state.rotation))

    def sensitivity(self, state: State, plate: Poses | None = None, e: np.ndarray | None = None) -> np.ndarray:
        """Return `d(tool) / de` (N, 3 or 6, m)."""
        if e is None:
            return self.by_actuators(state) @ self._actuator
        return jacobian(self.robot, state.q + e @ self._actuator.T, plate) @ self._actuator

    def closed(self, state: State, e: np.ndarray) -> Moved:
        """Return where errors `e` (N, m) put the tool."""
        start = Poses(state.position, state.rotation)
        found = forward_kinematics(self.robot, state.q + e @ self._actuator.T, start=start)
        change = found.poses.rotation @ state.rotation.transpose(0, 2, 1)
        ok = np.asarray(found.ok)
        turn = np.full((len(e), 3), np.nan)
        turn[ok] = Rotation.from_matrix(change[ok]).as_rotvec()
        return Moved(np.where(ok[:, None], found.poses.position - state.position, np.nan), turn, found.poses, ok)
