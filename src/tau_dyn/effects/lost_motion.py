"""What comes between an encoder and its load: play, a bristle, a spring.

Play is a play operator: the encoder travels it before the load follows. The play and the `travel` that closes it are one length
physically; `travel` only shapes the few micrometres after a reversal, which most filters hide, so it is a setting of its own.

A bristle's state z swings from one side to the other over `distance` after a reversal. As a force (setting `displaced` 0) it
stands beside Coulomb friction, of which a part then builds up over the distance; as a displacement (1) it is a loop of the
deflection. Along a recording z obeys `dz/dq = (1 - z sign(v)) / distance`, which covers reversals before it has swung; single
states are taken to have swung.

A spring carries the force of the model without it, or, where the joint's friction acts on the motor's side of it (setting
`friction` 0), that of its rigid bodies. A quasi-static law: it holds well below the resonance of load and spring, which is
`structural_compliance`. Reference: Nordin & Gutman 2002; Dahl 1968; Ruderman et al. 2009; Spong 1987; Dressler 2012, 4.2 and 6.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

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

_PLAYS = (1e-5, 1e-4, 1e-3)


class Backlash(JointwiseDisplacement):
    """A gap that the drive crosses at each reversal."""

    name = "backlash"
    cause = True
    equation = "encoder - load = (backlash / 2) sign(v) min(1, 2 x / travel - 1), x the distance since the reversal"
    reference = "Nordin & Gutman 2002; Dressler 2012, 4.2"
    reveals = "the tool or the load side measured at the same places, approached from both directions"
    mistaken_for = ("joint_compliance", "hysteresis", "coulomb_asymmetry")
    # Gears of machine tools stay below 0.1 mm and 1 mrad; worn or hobby servos reach 1 mm and 1 degree (Nordin & Gutman 2002)
    plausible = tuple(build_slide_and_hinge_ranges("backlash", "Q", (0.0, 0.0), (1e-3, 2e-2)))
    needs = (*JointwiseDisplacement.needs, "reversal")
    nonnegative = True
    quantities = (("backlash", "Q"),)
    sentence = "a play of {backlash} between encoder and load"
    defaults = {"travel": 5e-5}
    setting_units = {"travel": "Q"}
    positive = ("travel",)
    hidden = "play shows in forces only at reversals, and those samples are left out because the sign of the speed is uncertain"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return half the play's side: -1/2 or 1/2 once it is closed."""
        closed = np.minimum(1.0, 2 * joint.signal("reversal") / self.settings["travel"] - 1)
        return [0.5 * joint.sign * closed]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return plays that close at once, soon and late on the way travelled."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        return [{"travel": share * way} for share in _PLAYS] if way > 0 else []


_DISTANCES = (1e-3, 0.1)
_N_TRIALS = 8  # distances tried, a factor of about two apart; refinement does the rest
_PIECE = 30.0  # exponents of a stretch that is integrated at once; exp(30) leaves half of the digits
STATE = "presliding"
"""Signal (N, na) that replaces z where somebody follows it from sample to sample, as the simulator does."""


class Hysteresis(JointwiseDisplacement):
    """A bristle's friction force, or the loop that it leaves between encoder and load."""

    name = "hysteresis"
    cause = True
    equation = "tau += hysteresis (z - sign(v)); encoder - load = lost_motion z; z = sign(v) (1 - 2 exp(-x / distance))"
    reference = "Dahl 1968; Ruderman et al. 2009"
    reveals = "short slow strokes back and forth, with the load side or the tool measured"
    mistaken_for = ("stribeck", "backlash", "joint_compliance")
    # Presliding cannot hold more than friction; lost motion is that of gears (see backlash)
    plausible = (
        PlausibleRange("hysteresis", 0.0, 1.5, of="coulomb"),
        *build_slide_and_hinge_ranges("lost_motion", "Q", (0.0, 0.0), (1e-3, 2e-2)),
    )
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
        """Only the displacement is the encoder's."""
        if self.settings["displaced"] not in (0, 1):
            raise InputError(
                "invalid_value", "setting displaced of effect hysteresis is 0 (a force) or 1 (a displacement)"
            )
        return self.settings["displaced"] == 1

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return z, less the sign for a force."""
        z = joint.signals.get(STATE)
        if z is None:
            z = self._along(joint)
        return [z if self.measured else z - joint.sign]

    def _along(self, joint: JointMotion) -> np.ndarray:
        """Return z (N,) along a recording, or as if it had always swung where samples are in no order."""
        x = joint.signal("reversal")
        if joint.t is None:
            return joint.sign * (1 - 2 * np.exp(-x / self.settings["distance"]))
        return integrate_bristle(joint.q, self.settings["distance"])

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        if self.measured:
            return DisplacementEffect.columns(self, motion)
        return JointwiseEffect.columns(self, motion)

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p); none for a force."""
        made = super().displacement(motion)
        return made if self.measured else np.zeros_like(made)

    def followed(self, z: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the state z (...) after moving by `dq` (...) [m or rad]."""
        sign = np.sign(dq)
        return np.where(sign == 0, z, sign - (sign - z) * np.exp(-np.abs(dq) / self.settings["distance"]))

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the loop and the distance that it takes."""
        way = self.setting("distance", joint)
        if self.measured:
            return f"a loop of {format_amount(values['lost_motion'])} to either side between encoder and load, entered over {way}"
        return f"{format_amount(values['hysteresis'])} of the friction that builds up over {way} after a reversal"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return distances from a thousandth to a tenth of the way travelled; displacements where they can be seen."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        if way <= 0:
            return []
        displaced = float(bool(SEEN_DIRECTLY & scene.signals))
        return [{"distance": float(x) * way, "displaced": displaced} for x in np.geomspace(*_DISTANCES, _N_TRIALS)]


def follow_reversal(travel: np.ndarray, heading: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the way since the last reversal [m or rad] and the direction of motion, each (...), after moving by `dq` (...)."""
    sign = np.sign(dq)
    return np.abs(dq) + np.where(sign * heading < 0, 0.0, travel), np.where(sign == 0, heading, sign)


def integrate_bristle(q: np.ndarray, distance: float) -> np.ndarray:
    """Return z (N,) along positions (N,) in order, exact where a joint does not turn between two samples.

    It starts from the other side, as if it had just turned. With x the way travelled over `distance`,
    `z e^x` grows by `sign (e^x_{k+1} - e^x_k)`, which is summed over pieces short enough for the exponential.
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


class JointCompliance(JointwiseDisplacement):
    """A spring between encoder and load."""

    name = "joint_compliance"
    cause = True
    equation = "encoder - load = compliance F, F the force that the spring carries"
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "changing forces of known size at one place, with the load side or the tool measured"
    mistaken_for = ("backlash", "hysteresis", "structural_compliance", "delay")
    # Drives from 1e5 N/m and, for small harmonic drives, from 100 N m/rad up
    plausible = tuple(build_slide_and_hinge_ranges("compliance", "Q/F", (0.0, 0.0), (1e-5, 1e-2)))
    needs = (*JointwiseDisplacement.needs, "force", "rigid_force")
    nonnegative = True
    quantities = (("compliance", "Q/F"),)
    defaults = {"friction": 1}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force that the spring carries."""
        if self.settings["friction"] not in (0, 1):
            raise InputError(
                "invalid_value",
                "setting friction of effect joint_compliance is 1 (the spring carries it) or 0 (it does not)",
            )
        return [joint.signal("force" if self.settings["friction"] else "rigid_force")]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return a spring before and one behind the joint's friction, the latter where the rigid bodies' force is known."""
        return [{"friction": x} for x in (1.0, 0.0) if x or "rigid_force" in scene.signals]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return what the logs lack; the whole force is enough."""
        return super().untestable(replace(scene, signals=scene.signals | {"rigid_force"}))

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return compliance and stiffness."""
        p, unit = values["compliance"], spell_unit("F/Q", self.units[joint])
        stiff = ""
        if p.value > 0:
            stiff = f", a stiffness of {format_quantity(1 / p.value, unit, None if p.stderr is None else p.stderr / p.value**2)}"
        return f"a drive that yields by {format_amount(p)}{stiff}"
