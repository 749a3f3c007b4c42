"""What cyclic effects share: sine and cosine of the position, the periods worth trying, and their amplitude in words.

The motion sees a period only where it travels some of them, and a low-pass leaves it only where the slowest usable speed
brings it below the cutoff: `v / period < cutoff`. A scan in steps of a quarter of `1 / range` cannot miss a line.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter

MIN_PERIODS = 4.0
"""Of a force of the position alone: fewer of them are any smooth dependence on the place."""
MAX_PERIODS = 500.0  # periods within the range; finer ones are below an encoder's resolution
_STEPS = 4.0  # frequencies per resolution cell, so that no peak falls between two


class PeriodicEffect(JointwiseEffect):
    """A sum of sines and cosines of the position, `harmonics` of them.

    Attributes:
        wave: What its amplitudes are called and the letter of their unit.
    """

    wave: ClassVar[tuple[str, str]]
    quantities = ()
    defaults = {"period": 0.02, "harmonics": 1}
    setting_units = {"period": "Q"}
    positive = ("period",)
    whole = ("harmonics",)
    refined = ("period",)
    open_ends = {"period": "high"}
    grows = "harmonics"
    dense = True

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """Sine and cosine amplitude of each harmonic: `name_sin`, `name_cos`, then `name_sin_2`, ..."""
        name, unit = self.wave
        ends = ["" if k == 1 else f"_{k}" for k in range(1, int(self.settings["harmonics"]) + 1)]
        return tuple((f"{name}_{wave}{end}", unit) for end in ends for wave in ("sin", "cos"))

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return sine and cosine of each harmonic."""
        return build_waves(joint.q, self.settings["period"], int(self.settings["harmonics"]))

    def sizes(self, values: Mapping[str, Parameter]) -> tuple[str, str]:
        """Return the first harmonic's amplitude, and what is to be said of the others' after it."""
        p = list(values.values())
        sizes = [format_amount(compute_amplitude(p[k], p[k + 1])) for k in range(0, len(p), 2)]
        return sizes[0], f", with harmonics of {', '.join(sizes[1:])}" if len(sizes) > 1 else ""


def build_waves(q: np.ndarray, period: float, harmonics: int) -> list[np.ndarray]:
    """Return sine and cosine of `2 pi k q / period` for k = 1 .. harmonics, in pairs, each in the shape of `q`."""
    phase = 2 * np.pi * q / period
    return [wave(k * phase) for k in range(1, harmonics + 1) for wave in (np.sin, np.cos)]


def list_periods(scene: Scene, joint: str, fewest: float = MIN_PERIODS) -> list[dict[str, float]]:
    """Return the periods [m or rad] worth trying, the longest first, of which the range holds `fewest`.

    There are none where the joint hardly moves.
    """
    k = scene.index(joint)
    travel, slow = float(scene.high[k] - scene.low[k]), float(scene.slow[k])
    if travel <= 0:
        return []
    highest = MAX_PERIODS / travel
    if slow > 0:
        highest = min(highest, scene.cutoff_hz / (2 * slow))
    lines = np.arange(fewest / travel, highest, 1 / (_STEPS * travel))
    return [{"period": float(1 / line)} for line in lines]


def compute_amplitude(sine: Parameter, cosine: Parameter) -> Parameter:
    """Return the amplitude `hypot(sine, cosine)` as a parameter; its error is first order in theirs, taken as independent."""
    size = float(np.hypot(sine.value, cosine.value))
    known = sine.stderr is not None and cosine.stderr is not None and size > 0
    error = (
        float(np.hypot(sine.value * (sine.stderr or 0), cosine.value * (cosine.stderr or 0)) / size) if known else None
    )
    return Parameter("amplitude", size, sine.unit, stderr=error)
