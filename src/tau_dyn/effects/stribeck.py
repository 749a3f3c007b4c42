"""Friction that falls with speed just after breaking away.

    tau = stribeck sign(v) exp(-(|v| / speed)^power)

added to Coulomb and viscous friction. The exponent's power is 1 in some texts and 2 in others; a setting here.
Reference: Stribeck 1902; Armstrong-Helouvry, Dupont & Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_amount, format_quantity, spell_unit
from tau_dyn.parameters import Parameter

_POWERS = {1.0: 1.0, 2.0: 3**0.5}
"""Powers tried, and how many times the speed makes the peak about as wide as with the first."""


class Stribeck(JointwiseEffect):
    """A friction peak at low speed."""

    name = "stribeck"
    cause = True
    equation = "tau += stribeck sign(v) exp(-(|v| / speed)^power)"
    reference = "Stribeck 1902; Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = "constant-speed strokes from very slow to fast, in both directions"
    mistaken_for = ("hysteresis", "quadratic_drag", "backlash")
    # Breakaway friction reaches three times the friction in motion (Armstrong-Helouvry, Dupont & Canudas de Wit 1994)
    plausible = (PlausibleRange("stribeck", 0.0, 3.0, of="coulomb"),)
    quantities = (("stribeck", "F"),)
    nonnegative = True
    speed_law = True
    defaults = {"speed": 0.02, "power": 1.0}
    refined = ("speed",)
    open_ends = {"speed": "both"}
    setting_units = {"speed": "V"}
    positive = ("speed", "power")

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the decaying sign."""
        return [joint.sign * np.exp(-((np.abs(joint.v) / self.settings["speed"]) ** self.settings["power"]))]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the peak and where 5 % of it are left."""
        gone = format_quantity(
            3 ** (1 / self.settings["power"]) * self.settings["speed"], spell_unit("V", self.units[joint])
        )
        return f"a Stribeck peak of {format_amount(values['stribeck'])}, of which 5 % are left at {gone}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return speeds from half the slowest that is seen up to a third of the fast ones, a factor 1.6 apart, with both powers.

        What decays with the square of the speed is as wide at 1.7 times the speed.
        """
        k = scene.index(joints[0])
        low, high = 0.5 * scene.slow[k], scene.fast[k] / 3
        if not 0 < low < high:  # zero: a joint that stands still
            return []
        count = 1 + int(np.ceil(np.log(high / low) / np.log(1.6)))
        speeds = np.geomspace(low, high, count)
        return [{"speed": float(wide * x), "power": power} for power, wide in _POWERS.items() for x in speeds]
