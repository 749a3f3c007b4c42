"""Friction that holds until a drive's own compensation sets in: static friction separate from kinetic friction.

Drives that compensate friction do so while their joint moves. Below the speed at which that sets in, the torque contains the
whole friction, and above it the uncompensated part. A Stribeck peak decreases as its lubricant film grows; this law keeps its
height and ends within some 20 % of one speed. At rest the joint holds up to Coulomb and static friction together. A log whose
slow samples are left out cannot show a speed below them. Reference: Armstrong-Helouvry, Dupont & Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, format_amount
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.parameters import Parameter

_POWER = 8
"""Power of the speed's share: 95 % remain at 0.69 of the speed and 5 % at 1.15 of it."""
_FIRST = 1.2
"""Lowest speed tried, over the slowest usable one: below it hardly any sample is affected by the law."""
_STEP = 1.25
"""Ratio of neighbouring speeds tried, about the width of the law's end."""


class StaticFriction(JointwiseEffect):
    """Friction at low speed that a drive's compensation removes above it."""

    name = "static_friction"
    cause = True
    equation = "tau += static_friction sign(v) exp(-(|v| / speed)^8)"
    reference = "Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = (
        "torque ramps from rest, and constant-speed strokes below and above the speed at which compensation sets in"
    )
    mistaken_for = ("stribeck", "lugre", "viscous_curvature")
    # Compensated drives keep a tenth of their static friction in motion; it is below the largest force, else no joint moves
    plausible = (PlausibleRange("static_friction", 0.0, 1.0, of="force"),)
    quantities = (("static_friction", "F"),)
    nonnegative = True
    speed_law = True
    defaults = {"speed": 0.02}
    refined = ("speed",)
    open_ends = {"speed": "both"}
    setting_units = {"speed": "V"}
    positive = ("speed",)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the sign at low speed."""
        return [joint.sign * np.exp(-((np.abs(joint.v) / self.settings["speed"]) ** _POWER))]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the amount and the limit speed."""
        return (
            f"static friction of {format_amount(values['static_friction'])} that ends at {self.setting('speed', joint)}"
        )

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return speeds from above the slowest measured one to a third of the fast ones."""
        k = scene.index(joints[0])
        low, high = _FIRST * scene.slow[k], scene.fast[k] / 3
        if not 0 < low < high:
            return []
        count = 1 + int(np.ceil(np.log(high / low) / np.log(_STEP)))
        return [{"speed": float(x)} for x in np.geomspace(low, high, count)]
