"""A position-controlled serial arm that follows tool velocities: what a force loop sees of an industrial robot.

Each joint follows its velocity command with a bandwidth, `q'' = w (u - q')`, and does not give way to forces; what gives
way is in the contact's stiffness. Between commands this has a closed form, so no step is too long. Commands may come some
samples late.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import Robot

_SINGULAR = 0.02  # smallest singular value of the Jacobian relative to the largest; less is too near a singularity
_TOOLS = ("tool", "tool0")


class ContactPose(NamedTuple):
    """Where the tool is: `position` (3,) [m] and `rotation` (3, 3) in the world."""

    position: np.ndarray
    rotation: np.ndarray


class ServoArm:
    """A serial arm behind velocity servos."""

    def __init__(
        self,
        robot: Robot,
        q: np.ndarray,
        *,
        servo_hz: float | np.ndarray = 69.0,
        delay: int = 0,
        frame: str | None = None,
        tool: pin.SE3 | None = None,
    ) -> None:
        """Stand still at `q`.

        Args:
            robot: A serial arm of six or more joints, without loops; joints that are not actuated, such as fingers, stay at zero.
            q: Joint positions at the start (na,) [rad].
            servo_hz: Bandwidth of the velocity servos [Hz], a number or one a joint.
            delay: Samples that a command is late.
            frame: The robot's frame that carries the tool; by default 'tool', 'tool0' or its last one.
            tool: The tool frame in it; by default there, turned so that its z axis points along world -z at the start.

        Raises:
            InputError: No such arm, or the start is singular.
        """
        if robot.loops or robot.na < 6 or robot.model.nq != robot.model.nv:
            raise InputError(
                "unsupported",
                f"{robot.source}: lead-through needs a serial arm of six or more joints with limits, no loops",
            )
        self.robot, self._model, self._data = robot, robot.model, robot.model.createData()
        self._frame = _frame(robot, frame)
        self._all, self._columns = pin.neutral(robot.model), robot.active_v
        self.q, self._v = np.array(q, float), np.zeros(robot.na)
        rates = 2 * np.pi * np.broadcast_to(np.asarray(servo_hz, float), (robot.na,))
        if self.q.shape != (robot.na,) or not np.isfinite(self.q).all() or not np.all(np.isfinite(rates) & (rates > 0)):
            raise InputError(
                "wrong_shape", f"{robot.source}: q must be {robot.na} finite numbers and servo_hz above zero"
            )
        self._rates = rates
        self._lower, self._upper, self._speeds = robot.lower, robot.upper, robot.velocity_limit
        self._u = np.zeros(robot.na)
        self._dt, self._share = np.nan, (self._rates, self._rates)
        self._late = deque([self._u] * delay)
        self._tool = pin.SE3.Identity()
        self._tool = _pointing_down(self._placement()) if tool is None else tool
        self._look()

    def _decay(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        if dt != self._dt:
            e = np.exp(-self._rates * dt)
            self._dt, self._share = dt, (e, (1 - e) / self._rates)
        return self._share

    def _look(self) -> None:
        at = self._placement()
        self.pose = ContactPose(at.translation.copy(), at.rotation.copy())
        jacobian = pin.computeFrameJacobian(
            self._model, self._data, self._all, self._frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )[:, self._columns]
        base = self._data.oMf[self._frame]
        self._jacobian = jacobian
        arm = at.translation - base.translation
        if arm.any():
            self._jacobian[:3] -= pin.skew(arm) @ jacobian[3:]

    def _placement(self) -> pin.SE3:
        self._all[self._columns] = self.q
        pin.forwardKinematics(self._model, self._data, self._all)
        return pin.updateFramePlacement(self._model, self._data, self._frame) * self._tool

    @property
    def twist(self) -> np.ndarray:
        """The tool's twist (6,), world axes at the tool point."""
        return self._jacobian @ self._v

    def command(self, twist: np.ndarray) -> None:
        """Take a tool velocity (6,) that holds until the next one.

        Raises:
            InputError: The arm is at a singularity, or the command is beyond its joints' speeds.
        """
        u, s, vt = np.linalg.svd(self._jacobian, full_matrices=False)
        if s[-1] < _SINGULAR * s[0]:
            raise InputError("unreachable", f"{self.robot.source}: the arm came to a singularity; start it elsewhere")
        joint = vt.T @ ((u.T @ twist) / s)
        if (np.abs(joint) > self._speeds).any():
            raise InputError(
                "unreachable",
                f"{self.robot.source}: a command of the tool is faster than the joints; lower the speed limits",
            )
        self._late.append(joint)
        self._u = self._late.popleft()

    def advance(self, dt: float) -> None:
        """Move on by `dt` [s]."""
        e, step = self._decay(dt)
        self.q = self.q + step * self._v + (dt - step) * self._u
        self._v = e * self._v + (1 - e) * self._u
        if (self.q < self._lower).any() or (self.q > self._upper).any():
            raise InputError(
                "unreachable", f"{self.robot.source}: a joint came to the end of its travel; start elsewhere"
            )
        self._look()


def _frame(robot: Robot, name: str | None) -> int:
    if name is not None and not robot.model.existFrame(name):
        raise UnknownName("frame", name, [f.name for f in robot.model.frames], robot.source)
    wanted = [name] if name is not None else [n for n in _TOOLS if robot.model.existFrame(n)]
    return robot.model.getFrameId(wanted[0]) if wanted else robot.model.nframes - 1


def _pointing_down(at: pin.SE3) -> pin.SE3:
    down = np.diag([1.0, -1.0, -1.0])
    return pin.SE3(at.rotation.T @ down, np.zeros(3))
