"""Play between motor and load: after a reversal the encoder travels the play before the load follows.

    encoder - load = (backlash / 2) s,    s = sign(v) min(1, 2 x / travel - 1)

with x the encoder's distance since the joint reversed (a play operator). The play and the `travel` that closes it are one length
physically; `travel` only shapes the few micrometres after a reversal, which most filters hide, so it is a setting of its own.
Reference: Nordin & Gutman 2002; Dressler 2012, 4.2.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.displacement import JointwiseDisplacement
from tau_dyn.effects.effect import build_slide_and_hinge_ranges
from tau_dyn.effects.motion import JointMotion, Scene

_SHARES = (1e-5, 1e-4, 1e-3)


class Backlash(JointwiseDisplacement):
    """A gap that the drive crosses at each reversal."""

    name = "backlash"
    cause = True
    equation = "encoder - load = (backlash / 2) sign(v) min(1, 2 x / travel - 1), x the distance since the reversal"
    reference = "Nordin & Gutman 2002; Dressler 2012, 4.2"
    reveals = "the tool or the load side measured at the same places, approached from both directions"
    mistaken_for = ("joint_compliance", "hysteresis", "coulomb_asymmetry")
    # Gears of machine tools stay below 0.1 mm and 1 mrad; worn or hobby servos reach 1 mm and 1 degree (Nordin & Gutman 2002)
    plausible = tuple(build_slide_and_hinge_ranges("backlash", "Q", (0.0, 0.0), (1e-3, 2e-2)))
    needs = (*JointwiseDisplacement.needs, "reversal")
    nonnegative = True
    quantities = (("backlash", "Q"),)
    sentence = "a play of {backlash} between encoder and load"
    defaults = {"travel": 5e-5}
    setting_units = {"travel": "Q"}
    positive = ("travel",)
    hidden = "play shows in forces only at reversals, and those samples are left out because the sign of the speed is uncertain"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return half the play's side: -1/2 or 1/2 once it is closed."""
        closed = np.minimum(1.0, 2 * joint.signal("reversal") / self.settings["travel"] - 1)
        return [0.5 * joint.sign * closed]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return plays that close at once, soon and late on the way travelled."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        return [{"travel": share * way} for share in _SHARES] if way > 0 else []
