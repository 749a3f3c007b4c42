"""An encoder whose scale is off: a pinion of another diameter, a spindle of another pitch.

    encoder - load = pinion_scale q

Forces see masses scaled by it, which a refit of the masses absorbs; only lengths measured otherwise show it.
Reference: Dressler 2012, (4.13) and (5.6).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.jointwise_displacement import JointwiseDisplacement
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_percent
from tau_dyn.parameters import Parameter


class PinionScale(JointwiseDisplacement):
    """Positions that are read too long or too short by a factor."""

    name = "pinion_scale"
    cause = True
    equation = "encoder - load = pinion_scale q"
    reference = "Dressler 2012, (4.13) and (5.6)"
    reveals = "the tool or the load side measured over the whole range"
    mistaken_for = ("guideway_nonparallel", "rod_length", "link_mass")
    # A pinion or belt pitch off by 1 % is a wrong part
    plausible = (PlausibleRange("pinion_scale", -0.01, 0.01),)
    quantities = (("pinion_scale", "1"),)
    hidden = "a scale of the positions acts on forces as scaled masses do; the refit absorbs it"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the position."""
        return [joint.q]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the scale's error in percent."""
        return f"positions read too long by {format_percent(values['pinion_scale'])}"
