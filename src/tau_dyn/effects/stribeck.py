"""Friction that falls with speed just after breaking away.

    tau = stribeck sign(v) exp(-|v| / speed)

added to Coulomb and viscous friction. The exponent's power (1 here, 2 in other texts) is a choice of form: data hardly
tell them apart, and the speed of one is about twice that of the other. Reference: Stribeck 1902; Armstrong-Helouvry,
Dupont & Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import JointMotion, JointwiseEffect, Scene
from tau_dyn.effects.words import amount, quantity
from tau_dyn.parameters import Parameter


class Stribeck(JointwiseEffect):
    """A friction peak at low speed."""

    name = "stribeck"
    cause = True
    equation = "tau += stribeck sign(v) exp(-|v| / speed)"
    reference = "Stribeck 1902; Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = "constant-speed strokes from very slow to fast, in both directions"
    mistaken_for = ("hysteresis", "quadratic_drag", "backlash")
    plausible = "from zero up to the joint's Coulomb friction; speed below a third of the fast ones"
    quantities = (("stribeck", "F"),)
    nonnegative = True
    defaults = {"speed": 0.02}
    refined = ("speed",)
    setting_units = {"speed": "V"}
    positive = ("speed",)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the decaying sign."""
        return [joint.sign * np.exp(-np.abs(joint.v) / self.settings["speed"])]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the peak and where it has gone, at three times the speed of decay."""
        gone = quantity(3 * self.settings["speed"], "m/s" if self.units[joint] == "N" else "rad/s")
        return f"friction {amount(values['stribeck'])} higher at standstill than in motion, gone above {gone}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return speeds from half the slowest that is seen up to a third of the fast ones, a factor 1.6 apart."""
        k = scene.index(joints[0])
        low, high = 0.5 * scene.slow[k], scene.fast[k] / 3
        if not low < high:
            return []
        count = 1 + int(np.ceil(np.log(high / low) / np.log(1.6)))
        return [{"speed": float(x)} for x in np.geomspace(low, high, count)]
