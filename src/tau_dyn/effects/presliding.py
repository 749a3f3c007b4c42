"""Friction that deflects before it slips: LuGre's bristle as a force, or its hysteresis loop between encoder and load.

A bristle's state z changes from one side to the other over `distance` after a reversal:

    dz/dt = (v - |v| z) / distance,     z = sign(v) (1 - 2 exp(-x / distance)) after a full change,

with x the travel since the reversal.

This is LuGre's bristle, z in units of its largest deflection and with a stiffness of `lugre / distance`. Its micro-damping,
which acts over that distance alone, is left out, and its Stribeck curve is the separate effect `stribeck`. With one friction at
all speeds it is Dahl's law; springs that slip one after another (Maxwell slip) build up over about the same distance. As a
force it is added to Coulomb friction, of which a part then builds up over the distance; as a displacement, `hysteresis`, it is
a loop of the deflection. A recording is integrated, which covers reversals before z has fully changed; single states are
assumed to follow a full change.
Reference: Dahl 1968; Canudas de Wit et al. 1995; Al-Bender, Lampaert & Swevers 2005; Ruderman et al. 2009.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.effect import (
    PlausibleRange,
    build_slide_and_hinge_ranges,
    format_amount,
    format_quantity,
    spell_unit,
)
from tau_dyn.effects.jointwise import SEEN_DIRECTLY, DisplacementEffect, JointwiseDisplacement, JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter

_DISTANCES = (1e-4, 0.1)
_N_TRIALS = 11  # distances tried, in steps of a factor of about two; refinement does the rest
_PIECE = 30.0  # largest exponent of a stretch that is integrated at once; exp(30) leaves half of the digits
STATE = "presliding"
"""Signal (N, na) that replaces z if the caller tracks it from sample to sample, as the simulator does."""


class Bristle(JointwiseEffect):
    """An effect with a bristle's state z; see the module."""

    def find_state(self, joint: JointMotion) -> np.ndarray:
        """Return z (N,): the tracked one, that along a recording, or the fully changed one for unordered samples."""
        z = joint.signals.get(STATE)
        if z is not None:
            return z
        x = joint.signal("reversal")
        if joint.t is None:
            return joint.sign * (1 - 2 * np.exp(-x / self.settings["distance"]))
        return integrate_bristle(joint.q, self.settings["distance"])

    def followed(self, z: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the state z (...) after moving by `dq` (...) [m or rad]."""
        sign = np.sign(dq)
        return np.where(sign == 0, z, sign - (sign - z) * np.exp(-np.abs(dq) / self.settings["distance"]))

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return distances from a ten-thousandth to a tenth of the distance travelled."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        return [{"distance": float(x) * way} for x in np.geomspace(*_DISTANCES, _N_TRIALS)] if way > 0 else []


class Lugre(Bristle):
    """Friction that builds up over a distance after each reversal."""

    name = "lugre"
    cause = True
    equation = "tau += lugre (z - sign(v)), dz/dt = (v - |v| z) / distance"
    reference = "Canudas de Wit et al. 1995; Dahl 1968; Al-Bender, Lampaert & Swevers 2005"
    reveals = "short slow strokes back and forth, shorter than the distance over which friction builds up"
    mistaken_for = ("stribeck", "static_friction", "hysteresis", "backlash", "joint_compliance")
    equivalent = ("hysteresis",)
    # Presliding cannot hold more than friction, with the peak at rest
    plausible = (PlausibleRange("lugre", 0.0, 1.5, of="coulomb"),)
    needs = ("reversal",)
    nonnegative = True
    quantities = (("lugre", "F"),)
    defaults = {"distance": 1e-3}
    setting_units = {"distance": "Q"}
    positive = ("distance",)
    refined = ("distance",)
    open_ends = {"distance": "both"}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the bristle's force minus Coulomb friction, per unit."""
        return [self.find_state(joint) - joint.sign]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the friction, the distance and the stiffness."""
        p, way = values["lugre"], self.settings["distance"]
        stiff = format_quantity(p.value / way, spell_unit("F/Q", self.units[joint]))
        text = (
            f"{format_amount(p)} of the friction that builds up over {self.setting('distance', joint)} after a reversal"
        )
        return f"{text}, a presliding stiffness of {stiff}"


class Hysteresis(Bristle, JointwiseDisplacement):
    """The loop that a bristle leaves between encoder and load; with `displaced` 0 it is the force of `lugre`."""

    name = "hysteresis"
    cause = True
    equation = "tau += hysteresis (z - sign(v)); encoder - load = lost_motion z; z = sign(v) (1 - 2 exp(-x / distance))"
    reference = "Dahl 1968; Ruderman et al. 2009"
    reveals = "short slow strokes back and forth, with the load side or the tool measured"
    mistaken_for = ("lugre", "backlash", "joint_compliance")
    # Presliding cannot hold more than friction; lost motion is that of gears (see backlash)
    plausible = (
        PlausibleRange("hysteresis", 0.0, 1.5, of="coulomb"),
        *build_slide_and_hinge_ranges("lost_motion", "Q", (0.0, 0.0), (1e-3, 2e-2)),
    )
    hidden = "forces do not show the loop between encoder and load; the bristle's force is lugre"
    needs = (*JointwiseDisplacement.needs, "reversal")
    nonnegative = True
    quantities = ()
    defaults = {"distance": 1e-3, "displaced": 0}
    setting_units = {"distance": "Q"}
    positive = ("distance",)
    refined = ("distance",)
    open_ends = {"distance": "both"}

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One amplitude: a force, or a displacement."""
        return (("lost_motion", "Q"),) if self.measured else (("hysteresis", "F"),)

    @property
    def measured(self) -> bool:
        """Only the displacement belongs to the encoder."""
        if self.settings["displaced"] not in (0, 1):
            raise InputError(
                "invalid_value", "setting displaced of effect hysteresis is 0 (a force) or 1 (a displacement)"
            )
        return self.settings["displaced"] == 1

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return z, minus the sign for a force."""
        z = self.find_state(joint)
        return [z if self.measured else z - joint.sign]

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        if self.measured:
            return DisplacementEffect.columns(self, motion)
        return JointwiseEffect.columns(self, motion)

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p); zero for a force."""
        made = super().displacement(motion)
        return made if self.measured else np.zeros_like(made)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the loop and its distance."""
        way = self.setting("distance", joint)
        if self.measured:
            return f"a loop of {format_amount(values['lost_motion'])} to either side between encoder and load, entered over {way}"
        return f"{format_amount(values['hysteresis'])} of the friction that builds up over {way} after a reversal"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return a bristle's distances; displacements if they are observable."""
        displaced = float(bool(SEEN_DIRECTLY & scene.signals))
        return [row | {"displaced": displaced} for row in super().grid(scene, joints)]


def follow_reversal(travel: np.ndarray, heading: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the travel since the last reversal [m or rad] and the direction of motion, each (...), after a step `dq` (...)."""
    sign = np.sign(dq)
    return np.abs(dq) + np.where(sign * heading < 0, 0.0, travel), np.where(sign == 0, heading, sign)


def integrate_bristle(q: np.ndarray, distance: float) -> np.ndarray:
    """Return z (N,) along positions (N,) in order, exact if a joint does not reverse between two samples.

    It starts from the other side, as after a reversal. With x the travel divided by `distance`, `z e^x` grows by
    `sign (e^x_{k+1} - e^x_k)`, which is summed over pieces short enough for the exponential.
    """
    step = np.diff(q)
    x = np.concatenate([[0.0], np.cumsum(np.abs(step))]) / distance
    sign = np.sign(step)
    moving = sign[sign != 0]
    z = np.full(len(q), -moving[0] if moving.size else 0.0)
    edges = np.append(np.unique(np.searchsorted(x, np.arange(0, x[-1], _PIECE))), len(q) - 1)
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        grown = np.exp(np.minimum(x[a : b + 1] - x[a], 20 * _PIECE))
        z[a + 1 : b + 1] = (z[a] + np.cumsum(sign[a:b] * np.diff(grown))) / grown[1:]
    return z
