"""An arm, a hand, two force sensors and a work in one loop: lead-through programming before a robot is touched.

    sensors -> law(handle wrench, tool wrench, pose) -> tool velocity -> servos -> pose -> contact and hand -> sensors

The law is anything callable with a `sample_time`; `control.LeadThrough` is one. Forces follow from the pose alone, since a
position-controlled arm does not give way, so the loop needs no integration of its own; they are also looked at between
the samples, where peaks hide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.simulate.contact_arm import ContactPose, ServoArm
from tau_dyn.simulate.contact_hand import Hand
from tau_dyn.simulate.contact_work import ContactWorkpiece

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
