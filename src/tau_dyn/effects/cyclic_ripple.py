"""A force that repeats along the way: a pinion's teeth, a motor's cogging, a spindle's turns.

    tau += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period),   k = 1 .. harmonics

The amplitude is `hypot(ripple_sin, ripple_cos)`. Reference: Dressler 2012, 4.2 (cyclic errors); Holtz & Springob 1996 (cogging).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.motion import Motion
from tau_dyn.effects.periodic import PeriodicEffect, list_periods
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.parameters import Parameter


class CyclicRipple(PeriodicEffect):
    """A periodic force of the position."""

    name = "cyclic_ripple"
    cause = True
    equation = "tau += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period)"
    reference = "Dressler 2012, 4.2; Holtz & Springob 1996"
    reveals = "slow strokes at several constant speeds over many periods"
    mistaken_for = ("transmission_error", "resolver_error", "position_friction")
    # Cogging and tooth meshing are a few per cent of the largest force, 20 % in hobby gears
    plausible = (PlausibleRange("ripple", -0.2, 0.2, of="force"),)
    wave = ("ripple", "F")

    def local_frequency(self, motion: Motion) -> np.ndarray:
        """Return at which frequency each sample feels the first harmonic (N, na) [Hz]."""
        return np.abs(motion.v) / self.settings["period"]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and period, and the harmonics' amplitudes after them."""
        size, more = self.sizes(values)
        return f"a force of {size} that repeats every {self.setting('period', joint)}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return periods from a quarter of the range down to what speed and low-pass still show."""
        return list_periods(scene, joints[0])
