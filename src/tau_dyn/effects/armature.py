"""A drive inertia that is another than the robot file gives.

    tau += armature_error a

Where nobody gives a drive's inertia the baseline estimates it, or holds it within a body's, and this has nothing to explain
(`identify/fitted_model.py`); where the file gives it, the file may be wrong: a gear ratio forgotten in its square, a brake left
out. Reference: Gautier & Khalil 1990.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter


class Armature(JointwiseEffect):
    """Reflected rotor inertia beyond the robot file's."""

    name = "armature"
    cause = True
    confirmed_as = "parameter"
    equation = "tau += armature_error a"
    reference = "Gautier & Khalil 1990"
    reveals = "quick accelerations of each joint alone, at poses where its load's inertia differs"
    mistaken_for = ("link_mass", "payload", "reducer_coupling", "joint_compliance")
    # A rotor counts by its gear ratio's square: it is up to all of a joint's inertia, or several times what a file has
    plausible = (PlausibleRange("armature_error", -1.0, 5.0, of="inertia"),)
    quantities = (("armature_error", "F s^2/Q"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the acceleration."""
        return [joint.a]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the difference."""
        p = values["armature_error"]
        return f"a drive inertia that differs from the robot file's by {format_amount(p)}"
