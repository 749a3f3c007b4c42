"""Friction that is another one in one campaign: after a service, a change of grease, a year.

    tau += [campaign = number] (coulomb_change sign(v) + viscous_change v)

A campaign is one log, numbered from zero in the order given. Reference: Dressler 2012, 6.2 (friction a year apart).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter


class FrictionChange(JointwiseEffect):
    """Coulomb and viscous friction that one log has beyond the others."""

    name = "friction_change"
    cause = True
    equation = "tau += [campaign = number] (coulomb_change sign(v) + viscous_change v)"
    reference = "Dressler 2012, 6.2"
    reveals = "the same motion in two or more logs, recorded at the same temperature"
    mistaken_for = ("thermal_drift", "drive_gain")
    # A service or a cold start at most halves friction, or triples it
    plausible = (
        PlausibleRange("coulomb_change", -1.0, 2.0, of="coulomb"),
        PlausibleRange("viscous_change", -1.0, 3.0, of="viscous"),
    )
    needs = ("campaign",)
    quantities = (("coulomb_change", "F"), ("viscous_change", "F/(V)"))
    defaults = {"number": 1.0}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return sign and speed in the campaign, zero elsewhere."""
        here = joint.signal("campaign") == self.settings["number"]
        return [joint.sign * here, joint.v * here]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return what changed in which log."""
        coulomb, viscous = values["coulomb_change"], values["viscous_change"]
        return (
            f"friction in log {1 + int(self.settings['number'])} that differs from the others' by "
            f"{format_amount(coulomb)} and {format_amount(viscous)}"
        )

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return each log; of two, the second, since the first differs from it by as much."""
        first = 0 if scene.campaigns > 2 else 1
        return [{"number": float(k)} for k in range(first, scene.campaigns)]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that one log has nothing to differ from."""
        return ("there is only one log", cls.reveals) if scene.campaigns < 2 else super().untestable(scene)
