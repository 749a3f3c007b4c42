"""Friction that differs along the way: a tight guideway, a worn stretch of a rack.

    tau += sign(v) sum_k position_friction_k P_k(x),     x = (q - middle) / half,   k = 1 .. degree

with Legendre polynomials P_k, nearly independent of each other where the joint visits its range evenly; P_0 is Coulomb friction
itself. Beyond the range (|x| > 1) the friction stays as at its end. Amplitudes are changes, of either sign, of a friction that
stays positive as a whole. Reference: Dressler 2012, 6.2 (place on the guideway); Khalil & Dombre 2002, 9.6.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.polynomial import legendre

from tau_dyn.effects.effect import Effect, PlausibleRange
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.effects.words import format_quantity, spell_unit
from tau_dyn.parameters import Parameter

_DEGREES = (2, 5, 8, 12)
_SECONDS = 3.0
"""Motion that each term needs, to see its part of the way in both directions more than once."""


class PositionFriction(JointwiseEffect):
    """Coulomb friction as a polynomial of the position."""

    name = "position_friction"
    cause = True
    equation = "tau += sign(v) sum_k position_friction_k P_k((q - middle) / half), k = 1 .. degree"
    reference = "Dressler 2012, 6.2; Khalil & Dombre 2002, 9.6"
    reveals = "slow constant-speed strokes over the whole range, in both directions"
    mistaken_for = ("load_friction", "thermal_drift", "cyclic_ripple", "passive_joint_friction")
    # Friction stays positive at each place
    plausible = (PlausibleRange("position_friction", -1.0, 1.0, of="coulomb"),)
    quantities = ()
    defaults = {"middle": 0.0, "half": 1.0, "degree": 2}
    setting_units = {"middle": "Q", "half": "Q"}
    positive = ("half",)
    whole = ("degree",)

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One amplitude a degree, from one up."""
        return tuple((f"position_friction_{k}", "F") for k in range(1, int(self.settings["degree"]) + 1))

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the sign times each polynomial."""
        P = self._polynomials(joint.q)
        return [joint.sign * P[:, k] for k in range(P.shape[1])]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return where friction is lowest and highest, relative to its mean over the range."""
        q = self.settings["middle"] + self.settings["half"] * np.linspace(-1, 1, 201)
        friction = self._polynomials(q) @ np.array([p.value for p in values.values()])
        force, place = self.units[joint], spell_unit("Q", self.units[joint])
        low, high = int(np.argmin(friction)), int(np.argmax(friction))
        return (
            f"friction {format_quantity(float(friction[high] - friction[low]), force)} higher at "
            f"{format_quantity(float(q[high]), place)} than at {format_quantity(float(q[low]), place)}"
        )

    def lookalikes(self) -> list[Effect]:
        """Return viscous friction that differs along the way in the same manner: `v` in place of `sign(v)`."""
        return [_PositionDrag(self.joints, self.units.values(), label=self.label, **self.settings)]

    def _polynomials(self, q: np.ndarray) -> np.ndarray:
        x = np.clip((q - self.settings["middle"]) / self.settings["half"], -1, 1)
        return legendre.legvander(x, int(self.settings["degree"]))[:, 1:]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return laws from a parabola to one with three waves over the range that is often travelled.

        Where the joint hardly ever was, a polynomial of its own would say anything.
        """
        low, high = scene.range_of(joints[0])
        if not low < high:
            return []
        degrees = [n for n in _DEGREES if n == _DEGREES[0] or n * _SECONDS <= scene.duration]
        return [{"middle": (low + high) / 2, "half": (high - low) / 2, "degree": n} for n in degrees]


class _PositionDrag(PositionFriction):
    """Viscous friction as a polynomial of the position; too rare to be a cause, and a look-alike of one."""

    name = "position_drag"
    cause = False
    equation = "tau += v sum_k position_friction_k P_k((q - middle) / half), k = 1 .. degree"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the speed times each polynomial."""
        P = self._polynomials(joint.q)
        return [joint.v * P[:, k] for k in range(P.shape[1])]
