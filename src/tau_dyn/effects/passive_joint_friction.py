r"""Friction in the joints that no motor drives, felt by the motors through the mechanism.

A passive bearing turns with `w = P v`, `P` from the loops (`Mechanism.passive_rates`); by virtual work the motors add

    tau = sum over bearings P' (viscous w + coulomb w / |w|)

with one pair of coefficients for all bearings. `w / |w|` reverses with the bearing, not with a joint: when all carts move
alike, no rod turns. There the direction is noise; identification leaves such samples out (`other_speeds`), a smoothed sign
(feedforward) fades with the fastest joint's, and the simulator takes the force at the current speed, so that it brakes but
cannot hold. Reference: Khalil & Dombre 2002, ch. 10 (virtual work); suspected by Dressler 2012, 6.2.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.effect import Effect, PlausibleRange
from tau_dyn.effects.motion import Motion, Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter, Parameters


class PassiveJointFriction(Effect):
    """Viscous and Coulomb friction of all passive bearings, which share their coefficients."""

    name = "passive_joint_friction"
    cause = True
    equation = "tau += sum over passive bearings P' (viscous w + coulomb w / |w|), w = P v"
    reference = "Khalil & Dombre 2002, ch. 10"
    reveals = "motions in which the rods turn much beside ones in which all carts move alike, in both directions"
    mistaken_for = ("viscous_asymmetry", "coulomb_asymmetry", "load_friction")
    # From instrument bearings to preloaded cardan joints
    plausible = (PlausibleRange("coulomb", 0.0, 10.0, "N m"), PlausibleRange("viscous", 0.0, 30.0, "N m/(rad/s)"))
    needs = ("passive",)
    nonnegative = True

    @property
    def parameters(self) -> Parameters:
        """The coefficients that all bearings share, at zero."""
        rows = (("viscous", "N m/(rad/s)"), ("coulomb", "N m"))
        return Parameters(Parameter(f"passive.{key}{self.label}", 0.0, u, 0.0, origin=self.name) for key, u in rows)

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together: bearings load every one of them."""
        return [scene.joints] if "passive" in scene.signals else []

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that there are no passive joints, where so."""
        return None if "passive" in scene.signals else ("the robot has no loops and so no passive joints", cls.reveals)

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, 2)."""
        self._indices(motion)
        P = motion.signal("passive")
        w = np.einsum("nbxa,na->nbx", P, motion.v)
        speed = np.sqrt(np.sum(w**2, axis=2, keepdims=True))
        fading = np.max(np.abs(motion.sign), axis=1)[:, None, None]
        direction = np.divide(w, speed, out=np.zeros_like(w), where=speed > 0) * fading
        return np.stack([np.einsum("nbxa,nbx->na", P, x) for x in (w, direction)], axis=2)

    def describe(self, parameters: Parameters) -> str:
        """Return both coefficients in words."""
        viscous, coulomb = (format_amount(p) for p in parameters.select(self.parameters.names))
        return f"friction of {coulomb} and {viscous} in every joint without a motor"

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return each bearing's speed as the joints' speeds that would turn it so: `|w| / |P|`.

        A bearing with one axis has a sign to lose. With more, the direction is unsure where `|w|` is within the noise.
        """
        found = []
        joints = list(range(motion.v.shape[1]))
        for P in np.moveaxis(motion.signal("passive"), 1, 0):
            size = np.sqrt(np.sum(P**2, axis=(1, 2)))
            w = np.einsum("nxa,na->nx", P, motion.v)
            rate = np.sqrt(np.sum(w**2, axis=1)) if P[:, 1:].any() else w[:, 0]
            found.append((np.divide(rate, size, out=np.zeros_like(rate), where=size > 0), joints))
        return found
