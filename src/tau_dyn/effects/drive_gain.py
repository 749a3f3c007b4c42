"""A drive whose reported force is off by a factor: a wrong torque constant, a warm magnet.

    tau_log = (1 + gain_error) tau

where `tau` is the force of the model without this effect. Scaling the force scales all masses and all friction alike, so only a
mass that is known by other means (a weighed payload) tells the cause. Reference: Gautier & Briot 2014 (drive gains).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_percent
from tau_dyn.parameters import Parameter


class DriveGain(JointwiseEffect):
    """A force that is reported too large or too small by a factor."""

    name = "drive_gain"
    cause = True
    equation = "tau_log = (1 + gain_error) tau"
    reference = "Gautier & Briot 2014"
    reveals = "one motion without and with a weighed payload, its mass fixed by --fix"
    mistaken_for = ("payload", "link_mass")
    # Torque constants scatter by 10 % and fall by 20 % with warm magnets
    plausible = (PlausibleRange("gain_error", -0.3, 0.3),)
    needs = ("force",)
    quantities = (("gain_error", "1"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force of the model without this effect."""
        return [joint.signal("force")]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the gain's error in percent."""
        return f"a drive whose reported force is off by {format_percent(values['gain_error'])}"
