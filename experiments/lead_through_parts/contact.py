"""An arm, a hand, two force sensors and a work in one loop: lead-through programming before a robot is touched.

    sensors -> law(handle wrench, tool wrench, pose) -> tool velocity -> servos -> pose -> contact and hand -> sensors

The law is anything callable with a `sample_time`; `control.LeadThrough` is one. Forces follow from the pose alone, since a
position-controlled arm does not give way, so the loop needs no integration of its own; they are also looked at between
the samples, where peaks hide. Each joint follows its velocity command with a bandwidth, `q'' = w (u - q')`, in closed form, so
no step is too long; commands may come some samples late.

The hand is a spring and a damper towards where the operator wants the tool. It sees roughly where the tool is, not what it
presses: its wish strays by some millimetres below 1 Hz and trembles a little near 9 Hz (postural tremor, 8-12 Hz: Elble &
Koller 1990). It never pushes harder than its strength.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin

from lead_through_parts.contact_work import ContactWorkpiece
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import Robot

_TREMOR_HZ = 9.0  # Hz, physiological tremor of the hand (8 to 12 Hz)
_WAVES = 12  # sines that make a hand's wander


@dataclass(frozen=True, eq=False)
class Hand:
    """What the operator does.

    Attributes:
        times: Times of the way points (n,) [s].
        points: Where the tool is wanted, from its start (n, 3) [m]; between them a smooth step of zero end speed.
        stiffness: Of arm and hand [N/m].
        damping: [N s/m].
        wander: Standard deviation of the stray, per axis [m].
        tremor: Amplitude of the tremor, per axis [m].
        strength: Largest force [N].
    """

    times: Sequence[float]
    points: np.ndarray
    stiffness: float = 300.0
    damping: float = 10.0
    wander: float = 0.0
    tremor: float = 0.0
    strength: float = 15.0

    def __post_init__(self) -> None:
        """Refuse way points out of order."""
        times, points = np.asarray(self.times, float), np.asarray(self.points, float)
        if points.shape != (len(times), 3) or len(times) < 1 or np.any(np.diff(times) <= 0):
            raise InputError("wrong_shape", "a hand's way points are rising times (n,) and points (n, 3)")
        object.__setattr__(self, "points", points)

    def path(self, t: np.ndarray, seed: int) -> np.ndarray:
        """Return where the hand wants the tool at times (N,), from its start (N, 3) [m], stray included."""
        rng = np.random.default_rng(seed)
        out = np.array([np.interp(t, self.times, column) for column in self.points.T]).T
        for k in range(len(self.times) - 1):
            inside = (t >= self.times[k]) & (t <= self.times[k + 1])
            s = (t[inside, None] - self.times[k]) / (self.times[k + 1] - self.times[k])
            out[inside] = self.points[k] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (self.points[k + 1] - self.points[k])
        hz, phase = rng.uniform(0.1, 0.8, (_WAVES, 3)), rng.uniform(0, 2 * np.pi, (_WAVES + 1, 3))
        stray = np.sin(2 * np.pi * t[:, None, None] * hz + phase[:_WAVES]).sum(axis=1) * np.sqrt(2 / _WAVES)
        return out + self.wander * stray + self.tremor * np.sin(2 * np.pi * _TREMOR_HZ * t[:, None] + phase[-1])

    def force(self, wanted: np.ndarray, moving: np.ndarray, at: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the hand's force (3,) [N] from the wish and its rate, and the tool's place and speed, each (3,)."""
        force = self.stiffness * (wanted - at) + self.damping * (moving - speed)
        size = float(np.linalg.norm(force))
        return force * (self.strength / size) if size > self.strength else force


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
        jacobian = (
            pin.computeFrameJacobian(
                self._model, self._data, self._all, self._frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )[:, self._columns]
            * self.robot.drive_scale
        )
        base = self._data.oMf[self._frame]
        self._jacobian = jacobian
        arm = at.translation - base.translation
        if arm.any():
            self._jacobian[:3] -= pin.skew(arm) @ jacobian[3:]

    def _placement(self) -> pin.SE3:
        self._all[self._columns] = self.robot.drive_scale * self.q
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


Reading = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A wrench at the tool point in world axes (6,) and the tool's rotation to what a sensor shows, as `ForceSensor.reading`."""


class LeadThroughLaw(Protocol):
    """A lead-through controller."""

    in_contact: bool
    normal: np.ndarray

    @property
    def sample_time(self) -> float:
        """Time between calls [s]."""
        ...

    def __call__(
        self, handle_wrench: np.ndarray, tool_wrench: np.ndarray, pose: ContactPose, time: float | None = None
    ) -> np.ndarray:
        """Return the tool velocity to command (6,)."""
        ...


@dataclass(frozen=True)
class ContactSensors:
    """Two force sensors and their white noise.

    Attributes:
        force_noise: Standard deviation of each force axis [N].
        torque_noise: Of each torque axis [N m].
        tool: Turns a wrench into the tool sensor's reading; None for one at the tool point in tool axes.
        handle: The same for the handle.
    """

    force_noise: float = 0.0
    torque_noise: float = 0.0
    tool: Reading | None = None
    handle: Reading | None = None


@dataclass(frozen=True, eq=False)
class ContactRun:
    """What happened, each row a moment; `fine` moments a sample.

    Attributes:
        t: Times (N,) [s].
        position: Tool point (N, 3) [m].
        rotation: Tool axes (N, 3, 3).
        tool_wrench: The work's wrench on the tool (N, 6), world axes, without noise.
        hand_force: The hand's force (N, 3) [N].
        command: The tool velocity commanded (N, 6).
        contact: What the law took for contact (N,).
        normal: What it took for the normal (N, 3).
    """

    t: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    tool_wrench: np.ndarray
    hand_force: np.ndarray
    command: np.ndarray
    contact: np.ndarray
    normal: np.ndarray

    @property
    def tool_force(self) -> np.ndarray:
        """Size of the force on the tool (N,) [N]."""
        return np.linalg.norm(self.tool_wrench[:, :3], axis=1)

    def between(self, start: float, end: float) -> ContactRun:
        """Return the run from `start` to `end` [s]."""
        keep = (self.t >= start) & (self.t < end)
        return ContactRun(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def run_contact(
    arm: ServoArm,
    law: LeadThroughLaw,
    work: ContactWorkpiece,
    hand: Hand,
    duration: float,
    *,
    dt: float = 0.004,
    sensors: ContactSensors | None = None,
    fine: int = 2,
    seed: int = 0,
    gone: float = np.inf,
) -> ContactRun:
    """Run the loop from where the arm stands.

    Args:
        arm: The arm; it is moved.
        law: The controller.
        work: What the tool touches.
        hand: The operator.
        duration: [s].
        dt: The robot controller's sample time [s].
        sensors: Noise and places of the sensors; by default none, at the tool point.
        fine: Moments recorded a sample.
        seed: Of the noise and of the hand's stray.
        gone: A force on the tool at which the run ends, for a test of stability [N].

    Raises:
        InputError: The law is for another sample time than the robot's, or the arm leaves its workspace.
    """
    if abs(law.sample_time - dt) > 1e-9:
        raise InputError(
            "mismatch",
            f"the lead-through law is for samples of {law.sample_time * 1e3:g} ms, the robot takes commands "
            f"every {dt * 1e3:g} ms; its gains and stability limits hold for its own sampling alone",
        )
    sensors, n = sensors or ContactSensors(), round(duration / dt)
    rng = np.random.default_rng(seed)
    start, wish = arm.pose.position, hand.path(dt * np.arange(n + 1), seed)
    noise = rng.standard_normal((n, 2, 6)) * np.repeat([sensors.force_noise, sensors.torque_noise], 3)
    work.reset()
    rows: list[tuple] = []
    load = work.wrench(*arm.pose, arm.twist, 0.0)
    for k in range(n):
        push = hand.force(start + wish[k], (wish[k + 1] - wish[k]) / dt, arm.pose.position, arm.twist[:3])
        held = np.concatenate([push, np.zeros(3)])
        shown = _shown(held, load, arm.pose.rotation, sensors)
        twist = law(shown[0] + noise[k, 0], shown[1] + noise[k, 1], arm.pose, k * dt)
        arm.command(twist)
        for i in range(fine):
            rows.append((k * dt + i * dt / fine, *arm.pose, load, push, twist, law.in_contact, law.normal))
            arm.advance(dt / fine)
            load = work.wrench(*arm.pose, arm.twist, dt / fine)
        if np.linalg.norm(load[:3]) > gone:
            break
    return ContactRun(*(np.array(column) for column in zip(*rows, strict=True)))


def _shown(hand: np.ndarray, load: np.ndarray, rotation: np.ndarray, sensors: ContactSensors) -> tuple:
    handle, tool = sensors.handle or _plain, sensors.tool or _plain
    return handle(hand, rotation), tool(load, rotation)


def _plain(wrench: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.concatenate([rotation.T @ wrench[:3], rotation.T @ wrench[3:]])
