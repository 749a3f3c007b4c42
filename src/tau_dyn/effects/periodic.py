"""Cyclic effects of the position: a force that repeats (teeth, cogging), an encoder that alternately leads and lags its load.

    cyclic_ripple        tau            += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period)
    transmission_error   encoder - load  = sum_k error_sin_k sin(2 pi k q / period) + error_cos_k cos(2 pi k q / period)

for k = 1 .. harmonics; the amplitude is `hypot(sin, cos)`. A motion excites a period only if it covers several of them, and a
low-pass keeps it only if the slowest usable speed brings it below the cutoff: `v / period < cutoff`. A scan in steps of a
quarter of `1 / range` cannot miss a line. In the force channel an error changes the load's acceleration, so its force grows
with the speed squared, whereas a ripple has the same size at all speeds. Without a sensor on the load side an encoder's own
error (`resolver_error`) is indistinguishable. Reference: Dressler 2012, 4.2; Holtz & Springob 1996 (cogging); Ozguven & Houser
1988.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, build_slide_and_hinge_ranges, format_amount
from tau_dyn.effects.jointwise import JointwiseDisplacement, JointwiseEffect, subtract_load_force
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.parameters import Parameter

MIN_PERIODS = 4.0
"""Least periods of a force of the position alone: fewer of them resemble any smooth dependence on the position."""
MAX_PERIODS = 500.0  # periods within the range; finer ones are below an encoder's resolution
_STEPS = 4.0  # frequencies per resolution cell, so that no peak falls between two


class PeriodicEffect(JointwiseEffect):
    """A sum of sines and cosines of the position, `harmonics` of them.

    Attributes:
        wave: Name of its amplitudes and the letter of their unit.
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
        """Return the first harmonic's amplitude, and a phrase with the amplitudes of the others."""
        p = list(values.values())
        sizes = [format_amount(compute_amplitude(p[k], p[k + 1])) for k in range(0, len(p), 2)]
        return sizes[0], f", with harmonics of {', '.join(sizes[1:])}" if len(sizes) > 1 else ""


def build_waves(q: np.ndarray, period: float, harmonics: int) -> list[np.ndarray]:
    """Return sine and cosine of `2 pi k q / period` for k = 1 .. harmonics, in pairs, each in the shape of `q`."""
    phase = 2 * np.pi * q / period
    return [wave(k * phase) for k in range(1, harmonics + 1) for wave in (np.sin, np.cos)]


def list_periods(scene: Scene, joint: str, fewest: float = MIN_PERIODS) -> list[dict[str, float]]:
    """Return the periods [m or rad] to try, the longest first; the range holds at least `fewest` of each.

    The list is empty if the joint hardly moves.
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
    """Return the amplitude `hypot(sine, cosine)` as a parameter; its error is first order in theirs, assumed independent."""
    size = float(np.hypot(sine.value, cosine.value))
    known = sine.stderr is not None and cosine.stderr is not None and size > 0
    error = (
        float(np.hypot(sine.value * (sine.stderr or 0), cosine.value * (cosine.stderr or 0)) / size) if known else None
    )
    return Parameter("amplitude", size, sine.unit, stderr=error)


class CyclicRipple(PeriodicEffect):
    """A periodic force of the position."""

    name = "cyclic_ripple"
    cause = True
    equation = "tau += sum_k ripple_sin_k sin(2 pi k q / period) + ripple_cos_k cos(2 pi k q / period)"
    reference = "Dressler 2012, 4.2; Holtz & Springob 1996"
    reveals = "slow strokes at several constant speeds over many periods"
    mistaken_for = ("cogging", "transmission_error", "resolver_error", "position_friction")
    # Cogging and tooth meshing are a few per cent of the largest force, 20 % in hobby gears
    plausible = (PlausibleRange("ripple", -0.2, 0.2, of="force"),)
    wave = ("ripple", "F")

    def local_frequency(self, motion: Motion) -> np.ndarray:
        """Return the frequency (N, na) [Hz] of the first harmonic at each sample."""
        return np.abs(motion.v) / self.settings["period"]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and period, and the harmonics' amplitudes after them."""
        size, more = self.sizes(values)
        return f"a force of {size} that repeats every {self.setting('period', joint)}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return periods from a quarter of the range down to the shortest that speed and low-pass resolve."""
        return list_periods(scene, joints[0])


_MIN_ERROR_PERIODS = 1.5
"""Least periods in the range: a force that depends on the speed squared and the acceleration is distinguishable at any
wavelength."""


class TransmissionError(PeriodicEffect, JointwiseDisplacement):
    """A periodic difference between encoder and load."""

    name = "transmission_error"
    cause = True
    equation = "encoder - load = sum_k error_sin_k sin(2 pi k q / period) + error_cos_k cos(2 pi k q / period)"
    reference = "Dressler 2012, 4.2; Ozguven & Houser 1988"
    reveals = "strokes at several constant speeds, the fastest as fast as the drive allows; or a load-side encoder"
    mistaken_for = ("resolver_error", "cyclic_ripple")
    equivalent = ("resolver_error",)
    # Pinions and spindles stay below 0.1 mm, geared joints below 2 mrad (Dressler 2012, 4.2)
    plausible = tuple(build_slide_and_hinge_ranges("error", "Q", (-1e-4, -2e-3), (1e-4, 2e-3)))
    wave = ("error", "Q")

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p), differentiated analytically: samples do not resolve short periods."""
        n, (N, na) = len(self.terms), motion.v.shape
        force = np.zeros((na, n * len(self.joints), N))
        w = 2 * np.pi * np.repeat(np.arange(1, n // 2 + 1), 2) / self.settings["period"]
        for place, index in enumerate(self._indices(motion)):
            joint = JointMotion.of(motion, index)
            waves = self.per_joint(joint)
            slope = [
                sign * x
                for sine, cosine in zip(waves[::2], waves[1::2], strict=True)
                for sign, x in ((1, cosine), (-1, sine))
            ]
            moved = [f * (x * joint.a - f * d * joint.v**2) for f, d, x in zip(w, waves, slope, strict=True)]
            speed = [f * x * joint.v for f, x in zip(w, slope, strict=True)]
            mine = force[:, n * place : n * (place + 1)]
            subtract_load_force(mine, motion, index, *(np.stack(x).T for x in (waves, speed, moved)))
        return force.transpose(2, 0, 1)

    def local_frequency(self, motion: Motion) -> np.ndarray:
        """Return the frequency (N, na) [Hz] of the first harmonic at each sample, also where other joints move."""
        index = self._indices(motion)
        fastest = np.max(np.abs(motion.v[:, index]), axis=1, keepdims=True) / self.settings["period"]
        return np.repeat(fastest, motion.v.shape[1], axis=1)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and period, and the harmonics' amplitudes after them."""
        size, more = self.sizes(values)
        return f"an error of {size} between encoder and load that repeats every {self.setting('period', joint)}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return periods from two thirds of the range down to the shortest that speed and low-pass resolve."""
        return list_periods(scene, joints[0], _MIN_ERROR_PERIODS)
