"""Viscous friction that does not grow in proportion to the speed.

    tau += viscous_curvature sign(v) x (1 + x^2)^((power - 1) / 2),     x = |v| / knee

in proportion to the speed well below the knee and to its `power` well above it: the Carreau law of a lubricant that thins (power
below 1; at 0 it levels off) or of drag that sets in (power 1.5). It stands beside Coulomb and viscous friction; with an amplitude
from zero up the whole stays dissipative. A drag of the speed's square is `quadratic_drag`; a peak at low speeds, which falls with
speed, is `stribeck`. Reference: Carreau 1972; Bair & Winer 1979 and Bittencourt & Gunnarsson 2012 for geared joints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter

_MEMORY_PERIODS = 4.0
"""Periods of the low-pass' cutoff over which a step is smeared, two to each side."""
_KNEE_AT_SPEED = 0.2
"""Share of the fast speeds from which a knee is seen at speed, whatever happens at starts and reversals."""
_KNEES = {0.0: (0.04, 0.1, 0.25, 0.6), 0.5: (0.03, 0.1), 1.5: (0.1,)}
"""Power -> knees tried, as shares of the fast speeds. Beyond them the law is a straight line or a step, which the baseline has;
of a power 0.5 with a knee further up the curve is that of power 0."""


class ViscousCurvature(JointwiseEffect):
    """Friction whose growth with speed levels off or speeds up."""

    name = "viscous_curvature"
    cause = True
    equation = "tau += viscous_curvature sign(v) x (1 + x^2)^((power - 1) / 2), x = |v| / knee"
    reference = "Carreau 1972; Bittencourt & Gunnarsson 2012"
    reveals = "constant-speed strokes at ten speeds or more up to the highest, in both directions"
    mistaken_for = ("quadratic_drag", "stribeck", "thermal_drift", "viscous_asymmetry")
    # Of geared joints at speed all friction is less than the largest force; the viscous part is up to all of it
    plausible = (PlausibleRange("viscous_curvature", 0.0, 1.0, of="force"),)
    quantities = (("viscous_curvature", "F"),)
    nonnegative = True
    speed_law = True
    defaults = {"knee": 0.1, "power": 0.0}
    setting_units = {"knee": "V"}
    positive = ("knee",)
    refined = ("knee",)
    open_ends = {"knee": "both"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Let the friction act on these joints; see `Effect.__init__`.

        A low knee of a power other than zero is no edge: below it the law is the plain power.
        """
        super().__init__(joints, units, label=label, **settings)
        self.open_ends = {"knee": "both" if self.settings["power"] == 0 else "high"}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the curved law."""
        x = np.abs(joint.v) / self.settings["knee"]
        return [joint.sign * x * (1 + x**2) ** ((self.settings["power"] - 1) / 2)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the part of the friction that is not in proportion to the speed, and from which speed."""
        how, knee = "more" if self.settings["power"] > 1 else "less", self.setting("knee", joint)
        size = format_amount(values["viscous_curvature"])
        return f"viscous friction of {size} that grows {how} than the speed does above {knee}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return knees below the fast speeds for each power; none for a joint that stands still.

        Friction that levels off to a constant (power 0) at a low knee differs from Coulomb friction at starts and reversals
        alone. Where those pass it within the low-pass' memory, it is not told from their own transient.
        """
        k = scene.index(joints[0])
        fast, least = float(scene.fast[k]), 0.0
        if scene.hard is not None and np.isfinite(scene.cutoff_hz):
            least = min(_MEMORY_PERIODS * float(scene.hard[k]) / scene.cutoff_hz, _KNEE_AT_SPEED * fast)
        rows = [{"knee": share * fast, "power": p} for p, shares in _KNEES.items() for share in shares if fast > 0]
        return [row for row in rows if row["power"] != 0 or row["knee"] > least]
