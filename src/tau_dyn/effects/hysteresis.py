"""Friction inside the drive that gives way like a spring before it slips.

    force     tau += hysteresis (z - sign(v))
    encoder   encoder - load = lost_motion z,        z = sign(v) (1 - 2 exp(-x / distance))

with x the distance since the joint reversed: z swings from one side to the other over `distance`. The first line stands beside
Coulomb friction, of which it takes a part `hysteresis` that builds up with x instead of at once. The second is a loop of the
deflection. Which one an instance means is its setting `displaced`, 0 or 1. Moved sample by sample, z obeys
`dz/dq = (1 - z sign(v)) / distance`, which covers reversals before it has swung. Reference: Dahl 1968; Ruderman et al. 2009.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.effects.effect import JointMotion, JointwiseEffect, Motion, Scene
from tau_dyn.effects.jointwise_displacement import SEEN_DIRECTLY, JointwiseDisplacement
from tau_dyn.effects.words import amount
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter

_SHARES = (1e-3, 0.1)
_TRIES = 8
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
    plausible = "from zero up to the Coulomb friction, or to 0.2 mm or 2 mrad"
    needs = ("inertia", "reversal")
    nonnegative = True
    quantities = ()
    defaults = {"distance": 1e-3, "displaced": 0}
    setting_units = {"distance": "Q"}
    positive = ("distance",)
    refined = ("distance",)

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One amplitude: a force, or a displacement."""
        return (("lost_motion", "Q"),) if self.measured else (("hysteresis", "F"),)

    @property
    def measured(self) -> bool:
        """Only the displacement is the encoder's."""
        if self.settings["displaced"] not in (0, 1):
            raise InputError("setting displaced of effect hysteresis is 0 (a force) or 1 (a displacement)")
        return self.settings["displaced"] == 1

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return z, less the sign for a force."""
        z = joint.signals.get(STATE)
        if z is None:
            z = joint.sign * (1 - 2 * np.exp(-joint.signal("reversal") / self.settings["distance"]))
        return [z if self.measured else z - joint.sign]

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
            return (
                f"a loop of {amount(values['lost_motion'])} to either side between encoder and load, entered over {way}"
            )
        return f"{amount(values['hysteresis'])} of the friction that builds up over {way} after a reversal"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return distances from a thousandth to a tenth of the way travelled; displacements where they can be seen."""
        k = scene.index(joints[0])
        way = float(scene.high[k] - scene.low[k])
        if way <= 0:
            return []
        displaced = float(bool(SEEN_DIRECTLY & scene.signals))
        return [{"distance": float(x) * way, "displaced": displaced} for x in np.geomspace(*_SHARES, _TRIES)]
