"""Drives and geometry that differ from the robot file: rotors, torque constants, a shared motor, encoders' scales, gravity.

If a drive's inertia is not given, the baseline estimates it (`identify/fitted_model.py`); if the file gives it, the square of
the gear ratio may be missing in it. A gain scales all masses and all friction equally, so only a mass known by other means
determines it. Robot wrists often share a motor (joints 5 and 6 of the Staubli TX40), which turns with the sum of two joints.
A wrong pinion scales the masses in forces, which a refit absorbs; only lengths measured by other means show it.

Gravity is turned about two unit axes across it (the base's x and y where it points along z, see `compute_perpendicular_axes`)
by small angles [rad]; the base is turned the other way. Its forces are computed from the fitted masses
(`Mechanism.gravity_turn`), to first order, therefore up to 0.2 rad; a robot on a wall is an error of the file. If all hinges
about a horizontal axis have free first moments, the refit absorbs a turn about that axis. Reference: Gautier & Khalil 1990;
Gautier & Briot 2014; Gautier & Venture 2013; Dressler 2012, (4.13) and (5.6); Khalil & Dombre 2002, 9.4; Atkeson, An &
Hollerbach 1986.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tau_dyn.effects.effect import NO_EXPERIMENT, Effect, PlausibleRange, format_amount, spell_unit
from tau_dyn.effects.jointwise import JointwiseDisplacement, JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion, Scene, list_joint_pairs
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


class Armature(JointwiseEffect):
    """Reflected rotor inertia in addition to the robot file's."""

    name = "armature"
    cause = True
    confirmed_as = "parameter"
    equation = "tau += armature_error a"
    reference = "Gautier & Khalil 1990"
    reveals = "quick accelerations of each joint alone, at poses where its load's inertia differs"
    mistaken_for = ("link_mass", "payload", "reducer_coupling", "joint_compliance")
    # A rotor counts by its gear ratio's square: it is up to all of a joint's inertia, or several times the file's value
    plausible = (PlausibleRange("armature_error", -1.0, 5.0, of="inertia"),)
    quantities = (("armature_error", "F s^2/Q"),)
    sentence = "a drive inertia that differs from the robot file's by {armature_error}"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the acceleration."""
        return [joint.a]


class DriveGain(JointwiseEffect):
    """A force that is reported too large or too small by a factor."""

    name = "drive_gain"
    cause = True
    equation = "tau_log = (1 + gain_error) tau"
    reference = "Gautier & Briot 2014"
    reveals = "one motion without and with a weighed payload, its mass fixed by --fix"
    mistaken_for = ("payload", "link_mass")
    # Torque constants scatter by 10 % and decrease by 20 % with warm magnets
    plausible = (PlausibleRange("gain_error", -0.3, 0.3),)
    needs = ("force",)
    quantities = (("gain_error", "1"),)
    sentence = "a drive whose reported force is off by {gain_error}"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force of the model without this effect."""
        return [joint.signal("force")]


class ReducerCoupling(Effect):
    """Drive inertia and friction of a motor that turns with the sum of two joints."""

    name = "reducer_coupling"
    equation = "tau_i, tau_j += inertia (a_i + a_j) + viscous (v_i + v_j) + coulomb sign(v_i + v_j)"
    cause = True
    reference = "Gautier & Venture 2013"
    reveals = "motion in which the two joints turn together, against each other, and each alone"
    mistaken_for = ("link_mass", "passive_joint_friction")
    # The shared motor is as large as the joints' own motors
    plausible = (
        PlausibleRange("inertia", 0.0, 1.0, of="inertia"),
        PlausibleRange("viscous", 0.0, 2.0, of="viscous"),
        PlausibleRange("coulomb", 0.0, 2.0, of="coulomb"),
    )
    nonnegative = True

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all pairs of joints with one force unit."""
        return list_joint_pairs(scene)

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that no motor can drive two joints, if no joints are neighbours."""
        return (
            super().untestable(scene) if list_joint_pairs(scene) else ("no two joints can share a motor", NO_EXPERIMENT)
        )

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Couple exactly two joints, whose forces are in these units."""
        super().__init__(joints, units, label=label, **settings)
        if len(self.joints) != 2:
            raise InputError("invalid_value", f"reducer_coupling joins two joints, not {len(self.joints)}")

    @property
    def parameters(self) -> Parameters:
        """Return inertia, viscous and Coulomb friction of the shared motor, named after both joints."""
        owner = "+".join(self.joints)
        unit = self.units[self.joints[0]]
        place = spell_unit("Q", unit)
        return Parameters(
            Parameter(f"{owner}.{quantity}{self.label}", 0.0, text, 0.0, origin=self.name)
            for quantity, text in (
                ("inertia", f"{unit} s^2/{place}"),
                ("viscous", f"{unit}/({place}/s)"),
                ("coulomb", unit),
            )
        )

    def describe(self, parameters: Parameters) -> str:
        """Return the shared motor's inertia and friction."""
        inertia, viscous, coulomb = (format_amount(p) for p in parameters.select(self.parameters.names))
        return (
            f"a motor shared by {' and '.join(self.joints)}, with inertia {inertia}, viscous friction {viscous} and "
            f"Coulomb friction {coulomb}"
        )

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return the shared motor's speed, whose sign its friction follows."""
        i, j = self._indices(motion)
        return [(motion.v[:, i] + motion.v[:, j], [i, j])]

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, 3)."""
        i, j = self._indices(motion)
        v = motion.v[:, i] + motion.v[:, j]
        # a given (smoothed) sign is each joint's own; the motor's is that of the summed speed
        force = np.stack([motion.a[:, i] + motion.a[:, j], v, np.sign(v)], axis=1)
        out = np.zeros_like(motion.v, shape=(*motion.v.shape, 3))
        out[:, i], out[:, j] = force, force
        return out


class PinionScale(JointwiseDisplacement):
    """Positions that are read too long or too short by a factor."""

    name = "pinion_scale"
    cause = True
    equation = "encoder - load = pinion_scale q"
    reference = "Dressler 2012, (4.13) and (5.6)"
    reveals = "the tool or the load side measured over the whole range"
    mistaken_for = ("guideway_nonparallel", "rod_length", "link_mass")
    # A pinion or belt pitch wrong by 1 % is a wrong part
    plausible = (PlausibleRange("pinion_scale", -0.01, 0.01),)
    quantities = (("pinion_scale", "1"),)
    sentence = "positions read too long by {pinion_scale}"
    hidden = "a scale of the positions acts on forces as scaled masses do; the refit absorbs it"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the position."""
        return [joint.q]


GRAVITY_TURN = "gravity_turn"
"""Signal (N, na, 2) [N/rad or N m/rad]: forces at rest per turn of gravity about each of two axes across it."""


class GravityDirection(Effect):
    """A turn of gravity against the robot's base, on all joints."""

    name = "gravity_direction"
    cause = True
    equation = "tau += G(phi x g) tilt, G(g) the forces at rest under gravity g"
    reference = "Khalil & Dombre 2002, 9.4; Atkeson, An & Hollerbach 1986"
    reveals = (
        "slow motion over the whole workspace, joints with a vertical axis included, or a spirit level on the base"
    )
    mistaken_for = ("torque_offset", "coulomb_asymmetry", "link_mass", "position_friction")
    # A floor is off by some mrad, a support by up to 0.2 rad; more is another mounting, which is no small error
    plausible = (PlausibleRange("tilt", -0.2, 0.2, "rad"),)
    needs = (GRAVITY_TURN,)

    @property
    def parameters(self) -> Parameters:
        """The turns about both axes, at zero."""
        return Parameters(Parameter(f"base.tilt_{axis}{self.label}", 0.0, "rad", origin=self.name) for axis in "xy")

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together."""
        return [scene.joints]

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per radian of each turn (N, na, 2)."""
        turned = motion.signal(self.needs[0])
        out = np.zeros_like(turned)
        for k in self._indices(motion):
            out[:, k] = turned[:, k]
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the turns."""
        x, y = parameters.select(self.parameters.names)
        return f"gravity turned by {format_amount(x)} and {format_amount(y)} about x and y: the base is not level"
