"""Friction of the drives as a law of the joint's own speed: Coulomb and viscous, one-sided, and curves over the speed.

A one-sided friction is half the difference of both directions' coefficients; that of Coulomb friction is a constant force, so
data never distinguish it from `torque_offset`. If the sign is smoothed, the two directions' laws are mixed in proportion. A
Stribeck power is 1 in some texts and 2 in others; here it is a setting. The viscous curvature is proportional to the speed well
below the knee and to its `power` well above it: the Carreau law of a shear-thinning lubricant (power below 1; at 0 it levels
off) or of drag that sets in (power 1.5). If the knee is beyond the measured speeds, the law is a parabola. Reference: Dressler
2012, (6.8)-(6.9) and Table 6.1; Khalil & Dombre 2002, 9.6; Stribeck 1902; Armstrong-Helouvry, Dupont & Canudas de Wit 1994;
Carreau 1972; Bair & Winer 1979 and Bittencourt & Gunnarsson 2012 for geared joints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, describe_one_sided, format_amount, format_quantity, spell_unit
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.parameters import Parameter


class SymmetricFriction(JointwiseEffect):
    """Coulomb and viscous friction, the same in both directions."""

    name = "symmetric_friction"
    equation = "tau = coulomb sign(v) + viscous v"
    quantities = (("coulomb", "F"), ("viscous", "F/(V)"))
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return `sign(v)` and `v`."""
        return [joint.sign, joint.v]


class AsymmetricFriction(JointwiseEffect):
    """Coulomb and viscous friction with separate coefficients for each direction."""

    name = "asymmetric_friction"
    equation = "tau = coulomb_pos + viscous_pos v (v > 0), -coulomb_neg + viscous_neg v (v < 0)"
    quantities = (("coulomb_pos", "F"), ("coulomb_neg", "F"), ("viscous_pos", "F/(V)"), ("viscous_neg", "F/(V)"))
    nonnegative = True

    def lower(self, quantity: str) -> float:
        """Return the lower bound of a value; -inf for a Coulomb value, whose sum with the other one is bounded instead."""
        return -np.inf if quantity.startswith("coulomb") else 0.0

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return each direction's law, weighted by the share of motion in that direction."""
        forward, backward = (1 + joint.sign) / 2, (1 - joint.sign) / 2
        return [forward, -backward, joint.v * forward, joint.v * backward]


class TorqueOffset(JointwiseEffect):
    """A constant force, such as an amplifier's or a balancer's."""

    name = "torque_offset"
    cause = True
    equation = "tau += offset"
    reference = "Dressler 2012, (6.8)-(6.9); Khalil & Dombre 2002, 9.6"
    reveals = (
        "constant-speed strokes in both directions; only a joint without gear and seals separates it from asymmetry"
    )
    mistaken_for = ("coulomb_asymmetry", "gravity_direction", "payload")
    equivalent = ("coulomb_asymmetry",)
    # Amplifier offsets are a few per cent; springs and counterweights hold up to half of the largest force
    plausible = (PlausibleRange("offset", -0.5, 0.5, of="force"),)
    quantities = (("offset", "F"),)
    sentence = "a constant force of {offset}"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return one."""
        return [np.ones_like(joint.v)]


class CoulombAsymmetry(JointwiseEffect):
    """Half the difference between the Coulomb forces of the two directions."""

    name = "coulomb_asymmetry"
    cause = True
    equation = "tau += coulomb_asymmetry, half of (Fc_pos - Fc_neg)"
    reference = "Dressler 2012, (6.8)-(6.9), Table 6.1"
    reveals = (
        "constant-speed strokes in both directions; only a joint without gear and seals separates it from an offset"
    )
    mistaken_for = ("torque_offset", "gravity_direction")
    equivalent = ("torque_offset",)
    # Beyond it one direction would be driven by its own friction
    plausible = (PlausibleRange("coulomb_asymmetry", -1.0, 1.0, of="coulomb"),)
    quantities = (("coulomb_asymmetry", "F"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return one."""
        return [np.ones_like(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the excess of Coulomb friction in one direction."""
        return describe_one_sided("Coulomb friction", values["coulomb_asymmetry"])


class ViscousAsymmetry(JointwiseEffect):
    """Half the difference between the viscous coefficients of the two directions."""

    name = "viscous_asymmetry"
    cause = True
    equation = "tau += viscous_asymmetry |v|, half of (Fv_pos - Fv_neg)"
    reference = "Dressler 2012, (6.8)-(6.9), Table 6.1"
    reveals = "constant-speed strokes at several speeds in both directions"
    mistaken_for = ("coulomb_asymmetry", "torque_offset", "thermal_drift")
    # Beyond it one direction would be driven by its own friction
    plausible = (PlausibleRange("viscous_asymmetry", -1.0, 1.0, of="viscous"),)
    quantities = (("viscous_asymmetry", "F/(V)"),)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the size of the speed."""
        return [np.abs(joint.v)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the excess of viscous friction in one direction."""
        return describe_one_sided("viscous friction", values["viscous_asymmetry"])


_POWERS = {1.0: 1.0, 2.0: 3**0.5}
"""Powers tried, each with the factor of the speed for which the peak is about as wide as with the first."""


class Stribeck(JointwiseEffect):
    """A friction peak at low speed."""

    name = "stribeck"
    cause = True
    equation = "tau += stribeck sign(v) exp(-(|v| / speed)^power)"
    reference = "Stribeck 1902; Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = "constant-speed strokes from very slow to fast, in both directions"
    mistaken_for = ("static_friction", "lugre", "quadratic_drag", "backlash")
    # Breakaway friction reaches three times the friction in motion (Armstrong-Helouvry, Dupont & Canudas de Wit 1994)
    plausible = (PlausibleRange("stribeck", 0.0, 3.0, of="coulomb"),)
    quantities = (("stribeck", "F"),)
    nonnegative = True
    speed_law = True
    defaults = {"speed": 0.02, "power": 1.0}
    refined = ("speed",)
    open_ends = {"speed": "both"}
    setting_units = {"speed": "V"}
    positive = ("speed", "power")

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the decaying sign."""
        return [joint.sign * np.exp(-((np.abs(joint.v) / self.settings["speed"]) ** self.settings["power"]))]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the peak and the speed at which 5 % of it remain."""
        gone = format_quantity(
            3 ** (1 / self.settings["power"]) * self.settings["speed"], spell_unit("V", self.units[joint])
        )
        return f"a Stribeck peak of {format_amount(values['stribeck'])}, of which 5 % are left at {gone}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return speeds from half the slowest measured one to a third of the fast ones, in factors of 1.6, with both powers.

        A law that decays with the square of the speed is equally wide at 1.7 times the speed.
        """
        k = scene.index(joints[0])
        low, high = 0.5 * scene.slow[k], scene.fast[k] / 3
        if not 0 < low < high:  # zero: a joint at rest
            return []
        count = 1 + int(np.ceil(np.log(high / low) / np.log(1.6)))
        speeds = np.geomspace(low, high, count)
        return [{"speed": float(wide * x), "power": power} for power, wide in _POWERS.items() for x in speeds]


class QuadraticDrag(JointwiseEffect):
    """A force against the motion, proportional to the speed squared."""

    name = "quadratic_drag"
    cause = True
    equation = "tau += quadratic_drag v |v|"
    reference = "Hoerner 1965; Armstrong-Helouvry, Dupont & Canudas de Wit 1994"
    reveals = "constant-speed strokes up to the highest speed, in both directions"
    mistaken_for = ("stribeck", "viscous_asymmetry", "thermal_drift")
    # At full speed drag reaches a few times the other friction, as in fans and oil baths
    plausible = (PlausibleRange("quadratic_drag", 0.0, 3.0, of="drag"),)
    quantities = (("quadratic_drag", "F/(V)^2"),)
    sentence = "a drag of {quadratic_drag} times the speed squared"
    nonnegative = True
    speed_law = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return `v |v|`."""
        return [joint.v * np.abs(joint.v)]


PARABOLA = 2.0
"""Power that denotes the law without a fitted knee: the parabola `x (2 - x)` that levels off at its knee, the top speed."""
_KNEES = {0.0: (0.04, 0.1, 0.25, 0.6), 0.5: (0.03, 0.1), 1.5: (0.1,)}
"""Power -> knees tried, as shares of the fast speeds. Beyond them the law is a straight line or a step, which the baseline
contains; a power of 0.5 with a higher knee has the same curve as power 0."""


class ViscousCurvature(JointwiseEffect):
    """Friction whose growth with speed decreases or increases."""

    name = "viscous_curvature"
    cause = True
    equation = (
        "tau += viscous_curvature sign(v) x (1 + x^2)^((power - 1) / 2), x = |v| / knee; for power 2 x (2 - x), x <= 1"
    )
    reference = "Carreau 1972; Bittencourt & Gunnarsson 2012"
    reveals = "constant-speed strokes at ten speeds or more up to the highest, in both directions"
    mistaken_for = ("quadratic_drag", "stribeck", "thermal_drift", "viscous_asymmetry")
    # The friction of geared joints at speed is less than the largest force; the viscous part is up to all of it
    plausible = (PlausibleRange("viscous_curvature", 0.0, 1.0, of="force"),)
    quantities = (("viscous_curvature", "F"),)
    nonnegative = True
    speed_law = True
    defaults = {"knee": 0.1, "power": 0.0}
    setting_units = {"knee": "V"}
    positive = ("knee",)
    refined = ("knee",)
    open_ends = {"knee": "both"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Let the friction act on these joints; see `Effect.__init__`.

        A low knee of a power other than zero is not an edge: the law then is the plain power of the speed. A parabola's knee is
        given.
        """
        super().__init__(joints, units, label=label, **settings)
        if self.settings["power"] == PARABOLA:
            self.open_ends, self.refined = {}, ()
            return
        self.open_ends = {"knee": "both" if self.settings["power"] == 0 else "high"}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the curved law."""
        x = np.abs(joint.v) / self.settings["knee"]
        if self.settings["power"] == PARABOLA:
            x = np.minimum(x, 1.0)
            return [joint.sign * x * (2 - x)]
        return [joint.sign * x * (1 + x**2) ** ((self.settings["power"] - 1) / 2)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the part of the friction that is not proportional to the speed, and the speed from which it acts."""
        how, knee = "more" if self.settings["power"] > 1 else "less", self.setting("knee", joint)
        size = format_amount(values["viscous_curvature"])
        if self.settings["power"] == PARABOLA:
            return f"viscous friction of {size} that grows less and less with speed and levels off at {knee}"
        return f"viscous friction of {size} that grows {how} than the speed does above {knee}"

    def find_limit_law(self, scene: Scene) -> ViscousCurvature | None:
        """Return the law that continues this one beyond its highest knee; None at the lowest.

        A power of 0.5 with a high knee has the curve of power 0. Power 0 ends in the parabola that levels off at the fast
        speeds: `-v |v|` and viscous friction, growing over all speeds.
        """
        fast, power = float(scene.fast[scene.index(self.joints[0])]), self.settings["power"]
        knees = _KNEES.get(power, ())
        if power >= 1 or not fast > 0 or self.settings["knee"] < np.sqrt(knees[0] * knees[-1]) * fast:
            return None
        if power == 0:
            return self.with_settings(power=PARABOLA, knee=fast)
        return self.with_settings(power=0.0)

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return knees below the fast speeds for each power; an empty list for a joint at rest."""
        fast = float(scene.fast[scene.index(joints[0])])
        return [{"knee": share * fast, "power": p} for p, shares in _KNEES.items() for share in shares if fast > 0]
