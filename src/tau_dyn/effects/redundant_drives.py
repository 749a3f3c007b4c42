"""Friction and rotors of drives beyond the robot's freedoms, which follow the actuated joints through the loops.

A redundant drive moves with `w = B v`, `B` (r, na) from the loops (`Mechanism.redundant_motion`). By virtual work its own force
`f(w)` adds `B' f(w)` to the generalised forces of the actuated joints, in which the force inside the mechanism has no part:

    B' tau = Y theta + B' f(w),   B = [1; B_redundant].

The columns of a friction law are those of the drive's own motion, projected. Reference: Khalil & Dombre 2002, ch. 10 (virtual
work); Mueller 2005, on redundantly actuated robots.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.effect import Effect
from tau_dyn.effects.friction import AsymmetricFriction, SymmetricFriction, TorqueOffset
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion
from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot

REDUNDANT = "redundant"
"""Signal (N, r, na + 2): speed of each redundant drive per actuated speed (na), its speed and its acceleration."""


def read_redundant_motion(motion: Motion) -> tuple[np.ndarray, list[JointMotion]]:
    """Return speeds of redundant drives per actuated speed (N, r, na), and each drive's own motion, without positions.

    A smoothed sign (feedforward) fades with the fastest joint's.
    """
    signal = motion.signal(REDUNDANT)
    fading = np.max(np.abs(motion.sign), axis=1)
    drives = []
    for k in range(signal.shape[1]):
        v, a = signal[:, k, -2], signal[:, k, -1]
        drives.append(JointMotion(np.full_like(v, np.nan), v, a, np.sign(v) * fading, motion.t))
    return signal[:, :, :-2], drives


class _AtRedundantDrives(JointwiseEffect):
    """A law of each redundant drive's own motion; its joints are all redundant drives, in the robot's order."""

    needs = (REDUNDANT,)
    cause = False
    equivalent = ()

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p), projected on the actuated joints."""
        rates, drives = read_redundant_motion(motion)
        if len(drives) != len(self.joints):
            raise InputError(
                "invalid_value", f"effect {self.name} acts on all redundant drives; there are {len(drives)}"
            )
        columns = [rates[:, k] * x[:, None] for k, drive in enumerate(drives) for x in self.per_joint(drive)]
        return np.stack(columns, axis=2)

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return each drive's speed, converted to the joints' speed that causes it: `w / |B|`; its friction acts on all."""
        rates, drives = read_redundant_motion(motion)
        joints = list(range(motion.v.shape[1]))
        sizes = np.linalg.norm(rates, axis=2)
        return [
            (np.divide(drive.v, size, out=np.zeros_like(size), where=size > 0), joints)
            for drive, size in zip(drives, sizes.T, strict=True)
        ]


class RedundantSymmetricFriction(_AtRedundantDrives, SymmetricFriction):
    """Coulomb and viscous friction of redundant drives, the same in both directions."""

    name = "redundant_symmetric_friction"
    equation = "tau = B' (coulomb sign(w) + viscous w) at redundant drives, w = B v"


class RedundantAsymmetricFriction(_AtRedundantDrives, AsymmetricFriction):
    """Coulomb and viscous friction of redundant drives, with separate coefficients for each direction."""

    name = "redundant_asymmetric_friction"
    equation = (
        "tau = B' (coulomb_pos + viscous_pos w (w > 0), -coulomb_neg + viscous_neg w (w < 0)) at redundant drives"
    )


class RedundantTorqueOffset(_AtRedundantDrives, TorqueOffset):
    """A constant force of redundant drives."""

    name = "redundant_torque_offset"
    equation = "tau += B' offset at redundant drives"


class RedundantArmature(_AtRedundantDrives):
    """Reflected rotor inertia of redundant drives.

    A rotor about an axis that is fixed to the base is part of its link's inertia, so its value is fixed unless asked for.
    """

    name = "redundant_armature"
    equation = "tau += B' armature dw/dt at redundant drives"
    quantities = (("armature", "F s^2/Q"),)
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the acceleration."""
        return [joint.a]


_OF_MODEL: dict[str, tuple[type[Effect], ...]] = {
    "rigid": (),
    "symmetric": (RedundantSymmetricFriction, RedundantTorqueOffset),
    "asymmetric": (RedundantAsymmetricFriction,),
}


def build_redundant_effects(friction: str, robot: Robot) -> tuple[Effect, ...]:
    """Return rotor inertia and friction of a robot's redundant drives, by a friction model's name; empty without such drives."""
    if not robot.redundant_joints:
        return ()
    kinds = (RedundantArmature, *_OF_MODEL[friction])
    return tuple(kind(robot.redundant_joints, robot.redundant_units) for kind in kinds)
