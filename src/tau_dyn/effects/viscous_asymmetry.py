"""Viscous friction that differs between the two directions.

    tau += viscous_asymmetry |v|,     viscous_asymmetry = (Fv_pos - Fv_neg) / 2

beside symmetric viscous friction `(Fv_pos + Fv_neg) / 2`. Reference: Dressler 2012, (6.8)-(6.9) and Table 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import describe_one_sided
from tau_dyn.parameters import Parameter


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
