"""Coulomb friction that differs between the two directions.

    tau += coulomb_asymmetry,     coulomb_asymmetry = (Fc_pos - Fc_neg) / 2

beside symmetric Coulomb friction `(Fc_pos + Fc_neg) / 2`. What is left after that symmetric part is a constant, so data never
tell this cause from `torque_offset`. Reference: Dressler 2012, (6.8)-(6.9) and Table 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import describe_one_sided
from tau_dyn.parameters import Parameter


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
