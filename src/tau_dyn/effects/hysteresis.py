"""Friction inside the drive that gives way like a spring before it slips.

    force     tau += hysteresis (z - sign(v))
    encoder   encoder - load = lost_motion z,        z = sign(v) (1 - 2 exp(-x / distance))

with x the distance since the joint reversed: z swings from one side to the other over `distance`. The first line stands beside
Coulomb friction, of which it takes a part `hysteresis` that builds up with x instead of at once. The second is a loop of the
deflection. Which one an instance means is its setting `displaced`, 0 or 1. Along a recording z obeys
`dz/dq = (1 - z sign(v)) / distance`, which covers reversals before it has swung; the line above, which takes it to have swung, is
for single states. Reference: Dahl 1968; Ruderman et al. 2009.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects.displacement import SEEN_DIRECTLY, DisplacementEffect, JointwiseDisplacement
from tau_dyn.effects.effect import PlausibleRange, build_slide_and_hinge_ranges
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter

_SHARES = (1e-3, 0.1)
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
        return [{"distance": float(x) * way, "displaced": displaced} for x in np.geomspace(*_SHARES, _N_TRIALS)]


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
