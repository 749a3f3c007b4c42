"""Drag that grows with the square of the speed: churning grease, fans, air.

    tau += quadratic_drag v |v|

Reference: Hoerner 1965 (turbulent drag); Armstrong-Helouvry, Dupont & Canudas de Wit 1994 for its place beside viscous friction.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter


class QuadraticDrag(JointwiseEffect):
    """A force against the motion, of the speed squared."""

    name = "quadratic_drag"
    cause = True
    equation = "tau += quadratic_drag v |v|"
    reference = "Hoerner 1965; Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = "constant-speed strokes up to the highest speed, in both directions"
    mistaken_for = ("stribeck", "viscous_asymmetry", "thermal_drift")
    # At full speed drag reaches a few times the other friction, as in fans and oil baths
    plausible = (PlausibleRange("quadratic_drag", 0.0, 3.0, of="drag"),)
    quantities = (("quadratic_drag", "F/(V)^2"),)
    nonnegative = True
    speed_law = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return `v |v|`."""
        return [joint.v * np.abs(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the coefficient."""
        return f"a drag of {format_amount(values['quadratic_drag'])} times the speed squared"
