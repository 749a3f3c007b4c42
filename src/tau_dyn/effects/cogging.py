"""A motor's cogging: a force that repeats a whole number of times in each turn of the motor.

With the gear ratio n of the robot file (motor turns per turn of the joint, or radians per metre of a slide), order k has the
period `2 pi / (n k)` of the joint. Orders are whole: pole pairs, slots, or their least common multiple. So the period is known
exactly, whereas `cyclic_ripple` searches for it; without a gear ratio a cogging motor is reported as `cyclic_ripple`.
Reference: Holtz & Springob 1996.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, format_quantity
from tau_dyn.effects.motion import Scene
from tau_dyn.effects.periodic import CyclicRipple, list_periods
from tau_dyn.parameters import Parameter

_MAX_ORDER = 84
"""Largest order tried: 12 slots and 14 poles of small motors have 84 as their least common multiple."""


class Cogging(CyclicRipple):
    """A periodic force of the motor's angle."""

    name = "cogging"
    equation = (
        "tau += sum_k cogging_sin_k sin(k order ratio q) + cogging_cos_k cos(k order ratio q), order a whole number"
    )
    reference = "Holtz & Springob 1996"
    reveals = "slow strokes at several constant speeds over many motor turns, with the gear ratio in the robot file"
    mistaken_for = ("cyclic_ripple", "transmission_error", "resolver_error")
    # Of the largest force, as a ripple
    plausible = (PlausibleRange("cogging", -0.2, 0.2, of="force"),)
    wave = ("cogging", "F")
    defaults = {"period": 0.02, "harmonics": 1, "ratio": 0.0}
    refined = ()
    open_ends = {}

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and order."""
        size, more = self.sizes(values)
        ratio, period = self.settings["ratio"], self.settings["period"]
        order = f", {format_quantity(2 * np.pi / (ratio * period), '')} times a motor turn" if ratio else ""
        return f"a cogging force of {size} that repeats every {self.setting('period', joint)}{order}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the orders whose periods the motion shows."""
        ratio, seen = scene.ratios.get(joints[0], 0.0), [row["period"] for row in list_periods(scene, joints[0])]
        if not ratio or not seen:
            return []
        periods = [2 * np.pi / (ratio * order) for order in range(1, _MAX_ORDER + 1)]
        return [{"period": x, "ratio": ratio} for x in periods if min(seen) <= x <= max(seen)]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that no gear ratio is known, if so."""
        why = "the robot file gives no gear ratio, so a period of the motor is one of the joint: cyclic_ripple names it"
        return None if any(scene.ratios.get(j) for j in scene.joints) else (why, cls.reveals)
