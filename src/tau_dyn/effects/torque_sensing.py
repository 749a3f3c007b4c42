r"""Reported forces that differ from the true ones: the drive's constant decreases with the force, or other drives leak in.

A motor's iron saturates: the current grows faster than the torque, and a force that is logged as current times a constant is
too large at high force. To the lowest odd order

    tau_log = tau + torque_saturation tau (tau / largest)^2,

with the joint's largest force as a setting, so that the amplitude is the share that the log adds to it. Friction proportional
to the load (`load_friction`) has the sign of the speed; this effect has the sign of the force in both directions of motion.

Cross-talk of current sensors, or of strain gauges in one housing, adds a share of another joint's force:

    tau_log_i = tau_i + torque_crosstalk tau_k.

A motor that two joints share (`reducer_coupling`) loads both of them equally, with its own inertia and friction only;
cross-talk also carries gravity, into one of them. Both forces here are those of the fitted model and not the measured ones,
whose noise would be in the column and in the residual. Reference: Gautier & Briot 2014; Hughes & Drury 2013, ch. 3; Gautier &
Venture 2013.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from tau_dyn.effects.effect import NO_EXPERIMENT, Effect, PlausibleRange, format_percent
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters

DELIVERED = "delivered_force"
"""Signal (N, na) [N or N m]: force that the drives deliver, by a model refitted together with a saturation of all of them."""


class ForceReading(Effect):
    """An effect that distorts the force in the log; the robot receives the true force."""

    @property
    def measured(self) -> bool:
        """The recording's, not the robot's."""
        return True


class TorqueSaturation(ForceReading, JointwiseEffect):
    """A force that is reported too large by a term proportional to its cube."""

    name = "torque_saturation"
    cause = True
    equation = "tau_log = tau + torque_saturation tau (tau / largest)^2"
    reference = "Gautier & Briot 2014; Hughes & Drury 2013, ch. 3"
    reveals = "motion up to the largest force, slow and fast, with a weighed payload"
    mistaken_for = ("load_friction", "lugre", "friction_change", "drive_gain", "directional_efficiency")
    # Servo motors lose up to a third of their constant at peak torque
    plausible = (PlausibleRange("torque_saturation", 0.0, 0.5),)
    needs = (DELIVERED,)
    quantities = (("torque_saturation", "1"),)
    nonnegative = True
    defaults = {"largest": 1.0}
    setting_units = {"largest": "F"}
    positive = ("largest",)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force times the square of its share of the largest."""
        force = joint.signal(DELIVERED)
        return [force * (force / self.settings["largest"]) ** 2]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the share at the largest force."""
        share = format_percent(values["torque_saturation"])
        return f"a torque constant that falls with torque: at {self.setting('largest', joint)} the log shows {share} too much"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the joint's largest force."""
        own = scene.scales.get(joints[0], {})
        largest = own.get("delivered", own.get("force", 0.0))
        return [{"largest": largest}] if largest > 0 else []


class TorqueCrosstalk(ForceReading):
    """A share of another joint's force in the force of a joint."""

    name = "torque_crosstalk"
    cause = True
    equation = "tau_log_i = tau_i + torque_crosstalk tau_k"
    reference = "Gautier & Venture 2013"
    reveals = "motion of the other joint alone, the first one held still at several places"
    mistaken_for = ("reducer_coupling", "link_mass", "gravity_direction", "joint_zero")
    # Sensors are decoupled to a few per cent; a third means a decoupling matrix that was never applied
    plausible = (PlausibleRange("torque_crosstalk", -0.3, 0.3),)
    needs = ("force",)

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Let the force of the second joint leak into the first one's; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if len(self.joints) != 2:
            raise InputError("invalid_value", f"torque_crosstalk joins two joints, not {len(self.joints)}")

    @property
    def parameters(self) -> Parameters:
        """The share, named after the joint whose log shows it and the other one."""
        into, source = self.joints
        name = f"{into}.torque_crosstalk_{source}{self.label}"
        return Parameters([Parameter(name, 0.0, "1", origin=self.name)])

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all ordered pairs of joints with one force unit."""
        kinds = list(zip(scene.joints, scene.units, strict=True))
        return [(i, k) for i, one in kinds for k, other in kinds if i != k and one == other]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that there is no other joint of the same kind, if so."""
        return (
            super().untestable(scene) if cls.groups(scene) else ("no two joints have forces of one kind", NO_EXPERIMENT)
        )

    def columns(self, motion: Motion) -> np.ndarray:
        """Return the other joint's force in the first one's (N, na, 1)."""
        into, source = self._indices(motion)
        out = np.zeros((*motion.v.shape, 1))
        out[:, into, 0] = motion.signal("force")[:, source]
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the joint whose force leaks, and the joint in whose log it appears."""
        (share,) = parameters.select(self.parameters.names)
        return f"{format_percent(share)} of the force of {self.joints[1]} in the logged force of {self.joints[0]}"
