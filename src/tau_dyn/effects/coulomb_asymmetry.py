"""Coulomb friction that differs between the two directions.

    tau += coulomb_asymmetry,     coulomb_asymmetry = (Fc_pos - Fc_neg) / 2

beside symmetric Coulomb friction `(Fc_pos + Fc_neg) / 2`. What is left after that symmetric part is a constant, so data never
tell this cause from `torque_offset`. Reference: Dressler 2012, (6.8)-(6.9) and Table 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import JointMotion, JointwiseEffect
from tau_dyn.effects.words import quantity
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
    plausible = "up to the joint's Coulomb friction, either sign"
    quantities = (("coulomb_asymmetry", "F"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return one."""
        return [np.ones_like(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return how much more Coulomb friction one direction has."""
        p = values["coulomb_asymmetry"]
        way = "forward" if p.value >= 0 else "backward"
        more = quantity(2 * abs(p.value), p.unit, None if p.stderr is None else 2 * p.stderr)
        return f"Coulomb friction {more} higher when moving {way} than the other way"
