"""Causes that the equations of a walking robot can show, whose ground forces are eliminated.

A joint's friction and drive are in these equations as they are in those of a fixed base. A law of the force that a joint
transmits, such as load friction or a spring, is not: the ground adds to that force. Such causes are listed as untestable.

Gravity may be turned against the world of the log, as on a slope that counts as level (`gravity_direction`), or against the
base, by an IMU that is mounted at an angle (`imu_misalignment`; `legged/misalignment.py`). On one heading and at rest both are
the same: only other headings, and accelerations, which turn with the IMU and not with a slope, tell them apart.
"""

from __future__ import annotations

from tau_dyn.effects import (
    DELIVERED,
    EFFECTS,
    GRAVITY_TURN,
    NO_EXPERIMENT,
    SHIFTED_FORCE,
    Effect,
    GravityDirection,
    PlausibleRange,
    Scene,
    format_amount,
)
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

IMU_TURN = "imu_turn"
"""Signal (N, na, 2) [N/rad or N m/rad]: change of the forces per turn of the base against its logged axes, about x and y."""
_GIVEN = frozenset({"reversal", "temperature", "campaign", GRAVITY_TURN, IMU_TURN})
"""Signals of a walking robot that are not changed by forces of the ground."""
_OF_JOINTS = frozenset(
    {"force", "rigid_force", "load", "reducer_torque", "inertia", "weight_gradient", DELIVERED, SHIFTED_FORCE}
)
"""Signals of inverse dynamics, which lack the forces of the ground."""
_OF_FORCE = "its law needs the force that the joint transmits, to which forces of the ground add"
_OF_PERIOD = "its periods are searched in the equation of one joint, and these hold the forces of several"
_NOT_SEARCHED = "it is not searched in the equations of a walking robot"
_NO_JOINT = "no joint of a leg has such a part"
_ON_A_STAND = "hold the trunk on a stand, feet in the air, and diagnose the legs with a fixed base"


class ImuMisalignment(GravityDirection):
    """An orientation of a floating base that is logged at a constant angle to the base."""

    name = "imu_misalignment"
    equation = "R = R_log exp(imu), R the base's orientation"
    reference = "Featherstone 2008, ch. 5"
    reveals = "the same stance on several headings: the robot turned by a quarter turn and more"
    mistaken_for = ("gravity_direction", "torque_offset", "coulomb_asymmetry", "link_mass")
    # A bracket or a calibration of an IMU is off by some ten mrad
    plausible = (PlausibleRange("imu", -0.2, 0.2, "rad"),)
    needs = (IMU_TURN,)

    @property
    def parameters(self) -> Parameters:
        """The turns about both axes of the base, at zero."""
        return Parameters(Parameter(f"base.imu_{axis}{self.label}", 0.0, "rad", origin=self.name) for axis in "xy")

    @property
    def measured(self) -> bool:
        """The recording's, not the robot's."""
        return True

    def describe(self, parameters: Parameters) -> str:
        """Return the turns."""
        x, y = parameters.select(self.parameters.names)
        return (
            f"the base is turned by {format_amount(x)} and {format_amount(y)} about its x and y axes against its logged "
            "orientation: the IMU is mounted at an angle"
        )


def list_walking_causes(robot: Robot) -> tuple[type[Effect], ...]:
    """Return the causes of a walking robot's residual; untestable ones give the reason."""
    causes = [cls for cls in EFFECTS.values() if cls.cause]
    return (*(_adapt(cls, robot.driven) for cls in causes), ImuMisalignment)


def _adapt(cls: type[Effect], driven: tuple[str, ...]) -> type[Effect]:
    """Return a cause on driven joints, or on all coordinates together; untestable if forces of the ground change its law."""
    refusal = _OF_PERIOD if cls.dense else _OF_FORCE if _OF_JOINTS & set(cls.needs) else ""
    known = set(cls.needs) <= _GIVEN

    def groups(_: type[Effect], scene: Scene) -> list[tuple[str, ...]]:
        return [group for group in cls.groups(scene) if set(group) <= set(driven) or group == scene.joints]

    def untestable(own: type[Effect], scene: Scene) -> tuple[str, str] | None:
        if not own.groups(scene):
            return _NO_JOINT, NO_EXPERIMENT
        if refusal:
            return refusal, _ON_A_STAND
        return cls.untestable(scene) or (None if known else (_NOT_SEARCHED, _ON_A_STAND))

    own = {"groups": classmethod(groups), "untestable": classmethod(untestable)}
    return type(cls.__name__, (cls,), {**own, "__doc__": cls.__doc__})
