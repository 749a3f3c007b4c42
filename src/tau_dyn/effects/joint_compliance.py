"""A drive that yields: the load stays behind the encoder in proportion to the force.

    encoder - load = compliance F

with F what the spring carries: the force of the model without this effect, or, where the joint's friction acts on the motor's
side of the spring (setting `friction` 0), that of its rigid bodies. A quasi-static law: it holds well below the resonance of
load and spring, which is `structural_compliance`. Reference: Spong 1987; Dressler 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tau_dyn.effects.displacement import JointwiseDisplacement
from tau_dyn.effects.effect import build_slide_and_hinge_ranges
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.effects.words import format_amount, format_quantity, spell_unit
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter


class JointCompliance(JointwiseDisplacement):
    """A spring between encoder and load."""

    name = "joint_compliance"
    cause = True
    equation = "encoder - load = compliance F, F the force that the spring carries"
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "changing forces of known size at one place, with the load side or the tool measured"
    mistaken_for = ("backlash", "hysteresis", "structural_compliance", "delay")
    # Drives from 1e5 N/m and, for small harmonic drives, from 100 N m/rad up
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
        """Return a spring before and one behind the joint's friction, the latter where the rigid bodies' force is known."""
        return [{"friction": x} for x in (1.0, 0.0) if x or "rigid_force" in scene.signals]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return what the logs lack; the whole force is enough."""
        return super().untestable(replace(scene, signals=scene.signals | {"rigid_force"}))

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return compliance and stiffness."""
        p, unit = values["compliance"], spell_unit("F/Q", self.units[joint])
        stiff = ""
        if p.value > 0:
            stiff = f", a stiffness of {format_quantity(1 / p.value, unit, None if p.stderr is None else p.stderr / p.value**2)}"
        return f"a drive that yields by {format_amount(p)}{stiff}"
