"""Friction that grows with the load that a guide or reducer carries.

    tau = load_friction |load| sign(v)

For a cart, `load` is the force that its rod puts across the guideway, whichever way it points; for a hinge, the rigid-body
torque that its reducer transmits (`Mechanism.guide_load`). The model's masses give the load, not the data. Coulomb friction
beside it keeps what does not depend on the load. Reference: Hamon, Gautier & Garrec 2010, dry friction that depends on load
and velocity; suspected by Dressler 2012, 6.2.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_percent
from tau_dyn.parameters import Parameter


class LoadFriction(JointwiseEffect):
    """Coulomb friction in proportion to the load."""

    name = "load_friction"
    cause = True
    equation = "tau += load_friction |load| sign(v)"
    reference = "Hamon, Gautier & Garrec 2010"
    reveals = "the same strokes in both directions at places and accelerations where the load differs much"
    mistaken_for = ("position_friction", "coulomb_asymmetry", "payload")
    # 0.1 to 1 % in rolling guides, 20 % in sliding ones; a reducer of 65 % efficiency loses half of what it transmits
    plausible = (PlausibleRange("load_friction", 0.0, 0.5),)
    needs = ("load",)
    quantities = (("load_friction", "1"),)
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the load's size against the motion."""
        return [np.abs(joint.signal("load")) * joint.sign]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the coefficient."""
        return f"friction of {format_percent(values['load_friction'])} of the load that its guide or reducer carries"
