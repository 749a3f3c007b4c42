"""A force that repeats along the way: a pinion's teeth, a motor's cogging, a spindle's turns.

    tau += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period),   k = 1 .. harmonics

The amplitude is `hypot(ripple_sin, ripple_cos)`. Reference: Dressler 2012, 4.2 (cyclic errors); Holtz & Springob 1996 (cogging).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import JointMotion, JointwiseEffect, Motion, Scene
from tau_dyn.effects.periodic import amplitude, periods, wave_terms, waves
from tau_dyn.effects.words import amount
from tau_dyn.parameters import Parameter


class CyclicRipple(JointwiseEffect):
    """A periodic force of the position."""

    name = "cyclic_ripple"
    cause = True
    equation = "tau += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period)"
    reference = "Dressler 2012, 4.2; Holtz & Springob 1996"
    reveals = "slow strokes at several constant speeds over many periods"
    mistaken_for = ("transmission_error", "resolver_error", "position_friction")
    plausible = "up to a few per cent of the drive's largest force; at least 4 periods in the range travelled"
    quantities = ()
    defaults = {"period": 0.02, "harmonics": 1}
    setting_units = {"period": "Q"}
    positive = ("period",)
    whole = ("harmonics",)
    refined = ("period",)
    grows = "harmonics"
    dense = True

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """Sine and cosine amplitude of each harmonic."""
        return wave_terms("ripple", "F", int(self.settings["harmonics"]))

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return sine and cosine of each harmonic."""
        return waves(joint.q, self.settings["period"], int(self.settings["harmonics"]))

    def local_frequency(self, motion: Motion) -> np.ndarray:
        """Return at which frequency each sample feels the first harmonic (N, na) [Hz]."""
        return np.abs(motion.v) / self.settings["period"]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and period, and the harmonics' amplitudes after them."""
        p = list(values.values())
        sizes = [amount(amplitude(p[k], p[k + 1])) for k in range(0, len(p), 2)]
        more = f", with harmonics of {', '.join(sizes[1:])}" if len(sizes) > 1 else ""
        return f"a force of {sizes[0]} that repeats every {self.setting('period', joint)}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return periods from a quarter of the range down to what speed and low-pass still show."""
        return periods(scene, joints[0])
