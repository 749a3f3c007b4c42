"""Lost motion between an encoder and its load: play, a spring. A bristle's loop is in `presliding.py`.

Play is the play operator: the encoder travels the play before the load follows. The play and the `travel` that closes it are
one length physically; `travel` only shapes the few micrometres after a reversal, which most filters hide, so it is a setting of
its own.

A spring carries the force of the model without it, or, if the joint's friction acts on the motor's side of it (setting
`friction` 0), that of its rigid bodies. The law is quasi-static: it holds well below the resonance of load and spring, which is
`structural_compliance`. Reference: Nordin & Gutman 2002; Spong 1987; Dressler 2012, 4.2 and 6.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tau_dyn.effects.effect import (
    build_slide_and_hinge_ranges,
    format_amount,
    format_quantity,
    spell_unit,
)
from tau_dyn.effects.jointwise import JointwiseDisplacement
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter

_PLAYS = (1e-5, 1e-4, 1e-3)


class Backlash(JointwiseDisplacement):
    """Play that the drive crosses at each reversal."""

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
        """Return the side of the play, halved: -1/2 or 1/2 once it is closed."""
        closed = np.minimum(1.0, 2 * joint.signal("reversal") / self.settings["travel"] - 1)
        return [0.5 * joint.sign * closed]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return plays that close at once, early and late on the distance travelled."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        return [{"travel": share * way} for share in _PLAYS] if way > 0 else []


class JointCompliance(JointwiseDisplacement):
    """A spring between encoder and load."""

    name = "joint_compliance"
    cause = True
    equation = "encoder - load = compliance F, F the force that the spring carries"
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "changing forces of known size at one place, with the load side or the tool measured"
    mistaken_for = ("backlash", "hysteresis", "structural_compliance", "delay")
    # Drives have 1e5 N/m or more, small harmonic drives 100 N m/rad or more
    plausible = tuple(build_slide_and_hinge_ranges("compliance", "Q/F", (0.0, 0.0), (1e-5, 1e-2)))
    needs = (*JointwiseDisplacement.needs, "force", "rigid_force")
    nonnegative = True
    quantities = (("compliance", "Q/F"),)
    defaults = {"friction": 1}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force that the spring carries."""
        if self.settings["friction"] not in (0, 1):
            raise InputError(
                "invalid_value",
                "setting friction of effect joint_compliance is 1 (the spring carries it) or 0 (it does not)",
            )
        return [joint.signal("force" if self.settings["friction"] else "rigid_force")]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return a spring before and one behind the joint's friction, the latter if the rigid bodies' force is known."""
        return [{"friction": x} for x in (1.0, 0.0) if x or "rigid_force" in scene.signals]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the signals that the logs lack; the whole force is enough."""
        return super().untestable(replace(scene, signals=scene.signals | {"rigid_force"}))

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return compliance and stiffness."""
        p, unit = values["compliance"], spell_unit("F/Q", self.units[joint])
        stiff = ""
        if p.value > 0:
            stiff = f", a stiffness of {format_quantity(1 / p.value, unit, None if p.stderr is None else p.stderr / p.value**2)}"
        return f"a drive that yields by {format_amount(p)}{stiff}"
