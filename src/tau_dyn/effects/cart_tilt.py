r"""A cart that turns a little as it travels, and carries the end of its rod along on a lever.

    u = angle(q) x lever = tilt_sin sin(2 pi q / period) + tilt_cos cos(2 pi q / period)

Tool positions show only the product of angle and lever, so its two amplitude vectors (3,) [m], in base axes, are the
parameters. A constant angle is part of the guideway's place, one that grows evenly with q is a scale or a skew guideway: what is
left to a tilt is the wave, half a wave to four waves over the travel (shorter ones along the way are `transmission_error`). A
crooked guideway displaces the rod's end just so: only a measured orientation of the cart, or a second rod on it, tells them
apart. Reference: Dressler 2012, 4.2 (orientation was not measured) and 5.3 (0.03 degrees on D1).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.cart_shift import CartShift
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_quantity
from tau_dyn.parameters import Parameter, Parameters

_AXES = ("x", "y", "z")
_WAVES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)  # over the travel


class CartTilt(CartShift):
    """Displacement of a rod's end that waves slowly along the guideway."""

    name = "cart_tilt"
    cause = True
    equation = "rod's end displaced by angle(q) x lever = tilt_sin sin(2 pi q / period) + tilt_cos cos(2 pi q / period)"
    reference = "Dressler 2012, 4.2 and 5.3"
    reveals = "the tool's position and the cart's orientation measured along the whole guideway"
    mistaken_for = ("guideway_not_straight", "guideway_compliance", "transmission_error", "pinion_scale")
    equivalent = ("guideway_not_straight",)
    # 0.5 mrad on a lever of 0.1 m are 50 um; bent rails reach a few times that
    plausible = (PlausibleRange("tilt", -2e-4, 2e-4, "m"),)
    defaults = {"period": 1.0}
    setting_units = {"period": "Q"}
    positive = ("period",)

    @property
    def parameters(self) -> Parameters:
        """Sine and cosine amplitude along each base axis, cart by cart, at zero."""
        terms = [f"tilt_{wave}_{axis}" for wave in ("sin", "cos") for axis in _AXES]
        names = (f"{joint}.{term}{self.label}" for joint in self.joints for term in terms)
        return Parameters(Parameter(name, 0.0, "m", origin=self.name) for name in names)

    def shift(self, motion: Motion) -> np.ndarray:
        """Return sine and cosine along each axis as that cart's displacement per unit (N, na, 3, p)."""
        out = np.zeros((*motion.q.shape, 3, 6 * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            phase = 2 * np.pi * motion.q[:, index] / self.settings["period"]
            for axis in range(3):
                out[:, index, axis, 6 * k + axis] = np.sin(phase)
                out[:, index, axis, 6 * k + 3 + axis] = np.cos(phase)
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the size of the wave and its length."""
        period = format_quantity(self.settings["period"], "m")
        said = []
        for joint in self.joints:
            values = [p.value for p in parameters if p.name.startswith(f"{joint}.tilt_") and p.name in self.parameters]
            size = format_quantity(float(np.linalg.norm(values)), "m")
            where = f" at {joint}" if len(self.joints) > 1 else ""
            said.append(
                f"the rod's end is carried off its line by {size}{where}, in a wave of {period} along the guideway"
            )
        return "; ".join(said)

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return waves from half to a quarter of the range travelled."""
        k = scene.index(joints[0])
        travel = float(scene.high[k] - scene.low[k])
        return [{"period": travel / waves} for waves in _WAVES] if travel > 0 else []
