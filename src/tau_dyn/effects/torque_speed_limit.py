"""A motor's torque-speed line, where the log holds the torque that was asked for and not the one that was delivered.

A motor on a given supply delivers less torque the faster it turns: in the direction of motion at most

    limit(v) = stall (1 - |v| / no_load),     nothing beyond no_load.

Logged is what the controller asked for. Of it `excess = sign(v) max(0, sign(v) tau_log - limit(v))` never reached the joint, so
`tau_log = model + excess`. The logged force stands in its own column, whose noise would pass for a little of the effect: only a
share near one of the excess is the cause. Reference: Hughes & Drury 2013, ch. 3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, format_percent
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, JointScales, Scene
from tau_dyn.parameters import Parameter, Parameters

REPORTED = "reported_force"
"""Signal (N, na) [N or N m]: the force that the log holds, low-passed as positions are."""
_STALLS = tuple(np.geomspace(0.35, 5.0, 24))
"""Stall forces tried, as shares of the largest force logged: 12 % apart, since a line that is 10 % off cuts other samples."""
_NO_LOADS = (1.2, 1.5, 2.0, 3.0, 6.0)
"""No-load speeds tried, as shares of the fast speeds; the last is nearly a plain limit of the force."""
_OFF = 0.3
"""Distance of the lost share from one within which it is the cause: a line fitted to noise loses a few per cent of its excess."""


class TorqueSpeedLimit(JointwiseEffect):
    """Force asked for beyond a motor's torque-speed line."""

    name = "torque_speed_limit"
    cause = True
    equation = "tau_log = tau + lost sign(v) max(0, sign(v) tau_log - stall (1 - |v| / no_load))"
    reference = "Hughes & Drury 2013, ch. 3"
    reveals = "accelerations at speed that ask for more than the motor gives, with the asked force in the log"
    mistaken_for = ("drive_gain", "quadratic_drag", "viscous_curvature", "drive_lag")
    # All of what lies beyond the line is lost
    plausible = (PlausibleRange("lost", 1 - _OFF, 1 + _OFF),)
    needs = (REPORTED,)
    quantities = (("lost", "1"),)
    nonnegative = True
    defaults = {"stall": 1.0, "no_load": 1.0}
    refined = ("stall", "no_load")
    setting_units = {"stall": "F", "no_load": "V"}
    positive = ("stall", "no_load")

    @property
    def measured(self) -> bool:
        """The log holds what was asked for; the robot gets less."""
        return True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force beyond the line."""
        limit = np.maximum(0.0, self.settings["stall"] * (1 - np.abs(joint.v) / self.settings["no_load"]))
        return [joint.sign * np.maximum(0.0, joint.sign * joint.signal(REPORTED) - limit)]

    def find_implausible(self, parameters: Parameters, scales: JointScales, margin: float = 1.0) -> str:
        """Return that the lost share is far from one, in the search as well: there is no wide range of it."""
        return super().find_implausible(parameters, scales)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the line and what is lost beyond it."""
        stall, no_load = self.setting("stall", joint), self.setting("no_load", joint)
        lost = format_percent(values["lost"])
        return f"a force limit from {stall} at rest to 0 at {no_load}; of the logged force beyond it {lost} are lost"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return lines around the largest force and the fast speeds."""
        force = scene.scales.get(joints[0], {}).get("force", 0.0)
        fast = float(scene.fast[scene.index(joints[0])])
        return [
            {"stall": s * force, "no_load": n * fast}
            for s in map(float, _STALLS)
            for n in _NO_LOADS
            if force > 0 and fast > 0
        ]
