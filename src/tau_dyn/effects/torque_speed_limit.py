"""A motor's torque-speed line, for logs that hold the commanded torque instead of the delivered one.

A motor on a given supply delivers less torque the faster it turns: in the direction of motion at most

    limit(v) = stall (1 - |v| / no_load),     zero beyond no_load.

The log holds the command of the controller. Its part `excess = sign(v) max(0, sign(v) tau_log - limit(v))` never reached the
joint, so `tau_log = model + excess`. The column depends on the logged force: a line within the noise of a steady force would
remove half of that noise. So the line is not searched for; it is that of the robot file's effort and velocity limits. Beyond a
line that is not the motor's, only a few per cent of the excess are lost, so a share near one confirms the cause. Reference:
Hughes & Drury 2013, ch. 3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, format_percent
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, JointScales, Scene
from tau_dyn.parameters import Parameter, Parameters

REPORTED = "reported_force"
"""Signal (N, na) [N or N m]: the logged force, low-passed like positions."""
_OFF = 0.3
"""Distance of the lost share from one within which it is the cause: a line fitted to noise loses a few per cent of its excess."""


class TorqueSpeedLimit(JointwiseEffect):
    """Commanded force beyond a motor's torque-speed line."""

    name = "torque_speed_limit"
    cause = True
    equation = "tau_log = tau + lost sign(v) max(0, sign(v) tau_log - stall (1 - |v| / no_load))"
    reference = "Hughes & Drury 2013, ch. 3"
    reveals = (
        "accelerations at speed beyond the motor's range, its stall force and no-load speed in the robot file as limits"
    )
    mistaken_for = ("drive_gain", "quadratic_drag", "viscous_curvature", "drive_lag")
    # All torque beyond the line is lost
    plausible = (PlausibleRange("lost", 1 - _OFF, 1 + _OFF),)
    needs = (REPORTED,)
    quantities = (("lost", "1"),)
    nonnegative = True
    defaults = {"stall": 1.0, "no_load": 1.0}
    setting_units = {"stall": "F", "no_load": "V"}
    positive = ("stall", "no_load")

    @property
    def measured(self) -> bool:
        """The log holds the command; the robot receives less."""
        return True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force beyond the line."""
        limit = np.maximum(0.0, self.settings["stall"] * (1 - np.abs(joint.v) / self.settings["no_load"]))
        return [joint.sign * np.maximum(0.0, joint.sign * joint.signal(REPORTED) - limit)]

    def find_implausible(self, parameters: Parameters, scales: JointScales, margin: float = 1.0) -> str:
        """Return that the lost share is far from one; the search does not widen this range."""
        return super().find_implausible(parameters, scales)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the line and the loss beyond it."""
        stall, no_load = self.setting("stall", joint), self.setting("no_load", joint)
        lost = format_percent(values["lost"])
        return f"a force limit from {stall} at rest to 0 at {no_load}; of the logged force beyond it {lost} are lost"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the line of the robot file, if it gives one."""
        line = scene.limits.get(joints[0])
        return [{"stall": line[0], "no_load": line[1]}] if line else []

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that the robot file gives no line, if so."""
        missing = ("the robot file gives no effort and velocity limits, which are the line's ends", cls.reveals)
        return super().untestable(scene) if any(joint in scene.limits for joint in scene.joints) else missing
