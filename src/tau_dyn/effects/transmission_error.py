"""An encoder that leads and lags its load periodically: eccentric pinions, tooth errors, a bent spindle.

    encoder - load = sum_k error_sin_k sin(2 pi k q / period) + error_cos_k cos(2 pi k q / period),   k = 1 .. harmonics

In the force channel the load's acceleration is missing, so the force grows with the speed squared, where a `cyclic_ripple` has
the same size at all speeds. Without a sensor on the load side an encoder's own error (`resolver_error`) is the same thing.
Reference: Dressler 2012, 4.2 (cyclic errors); Ozguven & Houser 1988.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.displacement import compute_load_force
from tau_dyn.effects.jointwise_displacement import JointwiseDisplacement
from tau_dyn.effects.motion import JointMotion, Motion
from tau_dyn.effects.periodic import PeriodicEffect, list_periods
from tau_dyn.effects.plausible import build_slide_and_hinge_ranges
from tau_dyn.effects.scene import Scene
from tau_dyn.parameters import Parameter

_MIN_PERIODS = 1.5
"""Periods in the range: a force that goes with the speed squared and the acceleration is like no other, however long its wave."""


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
        """Return force per unit parameter (N, na, p), differentiated on paper: short periods outrun a sampled derivative."""
        n = len(self.terms)
        out = np.zeros((*motion.v.shape, n * len(self.joints)))
        k = np.repeat(np.arange(1, n // 2 + 1), 2)
        w = 2 * np.pi * k / self.settings["period"]
        for place, index in enumerate(self._indices(motion)):
            joint = JointMotion.of(motion, index)
            d = np.stack(self.per_joint(joint), axis=1)
            slope = w * np.stack([d[:, 1::2], -d[:, ::2]], axis=2).reshape(d.shape)
            acceleration = slope * joint.a[:, None] - w**2 * d * joint.v[:, None] ** 2
            only = np.zeros((3, *motion.v.shape, n))
            only[:, :, index] = d, slope * joint.v[:, None], acceleration
            out[:, :, n * place : n * (place + 1)] = compute_load_force(motion, [index], *only)
        return out

    def local_frequency(self, motion: Motion) -> np.ndarray:
        """Return at which frequency each sample feels the first harmonic (N, na) [Hz], also where other joints move."""
        index = self._indices(motion)
        fastest = np.max(np.abs(motion.v[:, index]), axis=1, keepdims=True) / self.settings["period"]
        return np.repeat(fastest, motion.v.shape[1], axis=1)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return amplitude and period, and the harmonics' amplitudes after them."""
        size, more = self.sizes(values)
        return f"an error of {size} between encoder and load that repeats every {self.setting('period', joint)}{more}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return periods from two thirds of the range down to what speed and low-pass still show."""
        return list_periods(scene, joints[0], _MIN_PERIODS)
