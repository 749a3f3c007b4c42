"""Coulomb and viscous friction of the drives, the same in both directions or not, and constant forces.

    symmetric    tau = Fc sign(v) + Fv v
    asymmetric   tau = +Fc_pos + Fv_pos v for v > 0,   -Fc_neg + Fv_neg v for v < 0

As causes beside symmetric friction: `coulomb_asymmetry = (Fc_pos - Fc_neg) / 2` and `viscous_asymmetry = (Fv_pos - Fv_neg) / 2`,
which multiplies `|v|`. The first is a constant force, so data never tell it from `torque_offset`. Where the sign is smoothed,
the two directions' laws are mixed in proportion. Reference: Dressler 2012, (6.8)-(6.9) and Table 6.1; Khalil & Dombre 2002, 9.6.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.words import describe_one_sided
from tau_dyn.parameters import Parameter


class SymmetricFriction(JointwiseEffect):
    """Coulomb and viscous friction, the same in both directions."""

    name = "symmetric_friction"
    equation = "tau = coulomb sign(v) + viscous v"
    quantities = (("coulomb", "F"), ("viscous", "F/(V)"))
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return `sign(v)` and `v`."""
        return [joint.sign, joint.v]


class AsymmetricFriction(JointwiseEffect):
    """Coulomb and viscous friction with coefficients of its own in each direction."""

    name = "asymmetric_friction"
    equation = "tau = coulomb_pos + viscous_pos v (v > 0), -coulomb_neg + viscous_neg v (v < 0)"
    quantities = (("coulomb_pos", "F"), ("coulomb_neg", "F"), ("viscous_pos", "F/(V)"), ("viscous_neg", "F/(V)"))
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return each direction's law, weighted by how much the joint moves that way."""
        forward, backward = (1 + joint.sign) / 2, (1 - joint.sign) / 2
        return [forward, -backward, joint.v * forward, joint.v * backward]


class TorqueOffset(JointwiseEffect):
    """A constant force, such as an amplifier's or a balancer's."""

    name = "torque_offset"
    cause = True
    equation = "tau += offset"
    reference = "Dressler 2012, (6.8)-(6.9); Khalil & Dombre 2002, 9.6"
    reveals = "constant-speed strokes in both directions; only a joint without gear and seals tells it from asymmetry"
    mistaken_for = ("coulomb_asymmetry", "gravity_direction", "payload")
    equivalent = ("coulomb_asymmetry",)
    # Amplifier offsets are a few per cent; springs and counterweights hold up to half of the largest force
    plausible = (PlausibleRange("offset", -0.5, 0.5, of="force"),)
    quantities = (("offset", "F"),)
    sentence = "a constant force of {offset}"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return one."""
        return [np.ones_like(joint.v)]


class CoulombAsymmetry(JointwiseEffect):
    """Half the difference between the Coulomb forces of the two directions."""

    name = "coulomb_asymmetry"
    cause = True
    equation = "tau += coulomb_asymmetry, half of (Fc_pos - Fc_neg)"
    reference = "Dressler 2012, (6.8)-(6.9), Table 6.1"
    reveals = "constant-speed strokes in both directions; only a joint without gear and seals tells it from an offset"
    mistaken_for = ("torque_offset", "gravity_direction")
    equivalent = ("torque_offset",)
    # Beyond it one direction would be driven by its own friction
    plausible = (PlausibleRange("coulomb_asymmetry", -1.0, 1.0, of="coulomb"),)
    quantities = (("coulomb_asymmetry", "F"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return one."""
        return [np.ones_like(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return how much more Coulomb friction one direction has."""
        return describe_one_sided("Coulomb friction", values["coulomb_asymmetry"])


class ViscousAsymmetry(JointwiseEffect):
    """Half the difference between the viscous coefficients of the two directions."""

    name = "viscous_asymmetry"
    cause = True
    equation = "tau += viscous_asymmetry |v|, half of (Fv_pos - Fv_neg)"
    reference = "Dressler 2012, (6.8)-(6.9), Table 6.1"
    reveals = "constant-speed strokes at several speeds in both directions"
    mistaken_for = ("coulomb_asymmetry", "torque_offset", "thermal_drift")
    # Beyond it one direction would be driven by its own friction
    plausible = (PlausibleRange("viscous_asymmetry", -1.0, 1.0, of="viscous"),)
    quantities = (("viscous_asymmetry", "F/(V)"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the size of the speed."""
        return [np.abs(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return how much more viscous friction one direction has."""
        return describe_one_sided("viscous friction", values["viscous_asymmetry"])
