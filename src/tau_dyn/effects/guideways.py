"""Displacements of a cart that its encoder does not measure: the end of its rod is not on the nominal guideway.

    T = T(q) + sum_i S_i u_i @ parameters

    guideway_nonparallel   u = q (direction_y d_y + direction_z d_z), d_y, d_z two unit directions across the guideway
    guideway_compliance    u = guideway_compliance F, F the force across the guideway (3,) [N]
    cart_tilt              u = angle(q) x lever = tilt_sin sin(2 pi q / period) + tilt_cos cos(2 pi q / period)

with `u_i` the displacement of cart i [m] in base axes and `S_i` the sensitivity of the tool to it
(`Mechanism.cart_sensitivity`; only the part of `u_i` along the rod matters). Only a measured tool shows them: the change of
forces by micrometres is neglected.

A turn of a guideway about its own direction has no effect, and a scale along it is `pinion_scale`. `F` comes from the model's
masses (`Mechanism.guide_force`); the cart's own weight is constant and belongs to the guideway's position. Tool positions show
only the product of angle and lever of a tilt; a constant angle is part of the guideway's position, one that grows with q is a
skew guideway, and waves shorter than a quarter of the travel are `transmission_error`. A guideway that is not straight
displaces the rod's end in the same way: only a measured orientation of the cart, or a second rod on it, distinguishes them.
Reference: Dressler 2012, 4.1, 4.2, 5.2 and 5.3.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from tau_dyn.effects.effect import NO_EXPERIMENT, PlausibleRange, format_amount, format_quantity
from tau_dyn.effects.jointwise import DisplacementEffect, JointParameters
from tau_dyn.effects.motion import Motion, Scene
from tau_dyn.parameters import Parameters

SENSITIVITY = "cart_sensitivity"
"""Signal (N, 3, na, 3): the tool's displacement per displacement of each cart, in base axes."""


class CartShift(DisplacementEffect, JointParameters):
    """A displacement of carts in any direction, linear in its parameters."""

    needs = (SENSITIVITY,)

    @abstractmethod
    def shift(self, motion: Motion) -> np.ndarray:
        """Return each cart's displacement per unit parameter (N, na, 3, p) [m], in base axes."""

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return zeros (N, na, p): the encoder and its pinion stay together."""
        return np.zeros((*motion.q.shape, len(self.parameters)))

    def columns(self, motion: Motion) -> np.ndarray:
        """Return zeros (N, na, p): no force to first order."""
        return self.displacement(motion)

    def tool_columns(self, motion: Motion, tool_jacobian: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per unit parameter (N, 3, p) [m], in base axes."""
        return np.einsum("nxik,nikp->nxp", motion.signal(SENSITIVITY), self.shift(motion))

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return each sliding joint alone."""
        return [(joint,) for joint, unit in zip(scene.joints, scene.units, strict=True) if unit == "N"]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that a measured tool or carts are missing, if so."""
        if not cls.groups(scene):
            return "the robot has no carts", NO_EXPERIMENT
        return None if SENSITIVITY in scene.signals else ("no measured tool positions are looked at here", cls.reveals)


GUIDE_ACROSS = "guide_across"
"""Signal (N, na, 2, 3): two unit directions across each prismatic joint's axis, in base axes; zeros for a hinge."""


class GuidewayNonparallel(CartShift):
    """Displacement across the guideway proportional to the travel along it."""

    name = "guideway_nonparallel"
    cause = True
    equation = "cart displaced by u = q (direction_y d_y + direction_z d_z), d_y and d_z across the guideway"
    reference = "Dressler 2012, 4.1 and 5.2"
    reveals = "tool positions measured over each guideway's whole length, with the rods at many angles"
    mistaken_for = ("pinion_scale", "guideway_not_straight", "cart_tilt", "transmission_error", "rod_length")
    # Guideways are aligned to 0.1 to 5 mrad; 20 mrad are 2 cm in a metre, which is visible
    plausible = (PlausibleRange("direction", -0.02, 0.02, "rad"),)
    needs = (SENSITIVITY, GUIDE_ACROSS)
    quantities = (("direction_y", "rad"), ("direction_z", "rad"))
    sentence = "the guideway is off its direction by {direction_y} and {direction_z}"

    def shift(self, motion: Motion) -> np.ndarray:
        """Return the travel along both directions as that cart's displacement per unit (N, na, 3, p)."""
        across = motion.signal(GUIDE_ACROSS)
        out = np.zeros((*motion.q.shape, 3, 2 * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            for axis in range(2):
                out[:, index, :, 2 * k + axis] = motion.q[:, index, None] * across[:, index, axis]
        return out


SIDE_FORCE = "side_force"
"""Signal (N, na, 3) [N]: the force across each prismatic joint's axis, in base axes."""


class GuidewayCompliance(CartShift):
    """Displacement across the guideway proportional to the load across it."""

    name = "guideway_compliance"
    cause = True
    equation = "cart displaced by u = guideway_compliance F, F the rod's force across the guideway"
    reference = "Dressler 2012, 4.2 and 5.3"
    reveals = (
        "tool positions measured over the whole workspace, with the links at many angles, and once with a known payload"
    )
    mistaken_for = ("cart_tilt", "guideway_not_straight", "rod_length")
    # Linear guides have 0.01 to 2 um/N; a light frame has ten times more
    plausible = (PlausibleRange("guideway_compliance", 0.0, 2e-5, "m/N"),)
    needs = (SENSITIVITY, SIDE_FORCE)
    nonnegative = True
    quantities = (("guideway_compliance", "m/N"),)

    def shift(self, motion: Motion) -> np.ndarray:
        """Return the force across each guideway as that cart's displacement per unit (N, na, 3, p)."""
        force = motion.signal(SIDE_FORCE)
        out = np.zeros((*force.shape, len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            out[:, index, :, k] = force[:, index]
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the compliances in words."""
        several = len(self.joints) > 1
        rows = zip(self.joints, parameters.select(self.parameters.names), strict=True)
        each = " and ".join(format_amount(p) + (f" at {joint}" if several else "") for joint, p in rows)
        return f"the cart yields across its guideway by {each}"


_WAVES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)  # over the travel


class CartTilt(CartShift):
    """Displacement of a rod's end that varies slowly along the guideway."""

    name = "cart_tilt"
    cause = True
    equation = "rod's end displaced by angle(q) x lever = tilt_sin sin(2 pi q / period) + tilt_cos cos(2 pi q / period)"
    reference = "Dressler 2012, 4.2 and 5.3"
    reveals = "the tool's position and the cart's orientation measured along the whole guideway"
    mistaken_for = ("guideway_not_straight", "guideway_compliance", "transmission_error", "pinion_scale")
    equivalent = ("guideway_not_straight",)
    # 0.5 mrad on a lever of 0.1 m are 50 um; bent rails reach a few times that
    plausible = (PlausibleRange("tilt", -2e-4, 2e-4, "m"),)
    quantities = tuple((f"tilt_{wave}_{axis}", "m") for wave in ("sin", "cos") for axis in "xyz")
    defaults = {"period": 1.0}
    setting_units = {"period": "Q"}
    positive = ("period",)

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
        """Return the amplitude of the wave and its length."""
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
