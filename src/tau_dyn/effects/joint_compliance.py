"""A drive that yields: the load stays behind the encoder in proportion to the force.

    encoder - load = compliance tau

with tau the force of the model without this effect, a quasi-static law: it holds well below the resonance of load and spring.
Reference: Spong 1987; Dressler 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import JointMotion
from tau_dyn.effects.jointwise_displacement import JointwiseDisplacement
from tau_dyn.effects.words import amount, quantity
from tau_dyn.parameters import Parameter


class JointCompliance(JointwiseDisplacement):
    """A spring between encoder and load."""

    name = "joint_compliance"
    cause = True
    equation = "encoder - load = compliance tau"
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "changing forces of known size at one place, with the load side or the tool measured"
    mistaken_for = ("backlash", "hysteresis", "structural_compliance", "delay")
    plausible = "from zero to 1e-6 m/N or 1e-4 rad/(N m)"
    needs = ("inertia", "force")
    nonnegative = True
    quantities = (("compliance", "Q/F"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force."""
        return [joint.signal("force")]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return compliance and stiffness."""
        p, unit = values["compliance"], "N/m" if self.units[joint] == "N" else "N m/rad"
        stiff = ""
        if p.value > 0:
            stiff = (
                f", a stiffness of {quantity(1 / p.value, unit, None if p.stderr is None else p.stderr / p.value**2)}"
            )
        return f"a drive that yields by {amount(p)}{stiff}"
