"""Geometry that is not as the robot file says, seen by every joint: the encoder's scale, the direction of gravity.

    pinion_scale        encoder - load = pinion_scale q
    gravity_direction   tau += G(phi x g) tilt,     G(g) = tau at rest under gravity g

Forces see masses scaled by a wrong pinion, which a refit absorbs; only lengths measured otherwise show it. `phi` are two unit
axes across gravity (the base's x and y where it points along z, see `compute_perpendicular_axes`) and `tilt` [rad] the angles by
which gravity is turned about them (the base is turned the other way). `G` comes from the fitted masses
(`Mechanism.gravity_turn`). To first order in the tilt, so up to 0.2 rad; a robot on a wall is an error of the file. Where all
hinges about a horizontal axis have free first moments the refit absorbs a turn about that axis. Reference: Dressler 2012, (4.13)
and (5.6); Khalil & Dombre 2002, 9.4; Atkeson, An & Hollerbach 1986.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.displacement import JointwiseDisplacement
from tau_dyn.effects.effect import Effect, PlausibleRange
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter, Parameters


class PinionScale(JointwiseDisplacement):
    """Positions that are read too long or too short by a factor."""

    name = "pinion_scale"
    cause = True
    equation = "encoder - load = pinion_scale q"
    reference = "Dressler 2012, (4.13) and (5.6)"
    reveals = "the tool or the load side measured over the whole range"
    mistaken_for = ("guideway_nonparallel", "rod_length", "link_mass")
    # A pinion or belt pitch off by 1 % is a wrong part
    plausible = (PlausibleRange("pinion_scale", -0.01, 0.01),)
    quantities = (("pinion_scale", "1"),)
    sentence = "positions read too long by {pinion_scale}"
    hidden = "a scale of the positions acts on forces as scaled masses do; the refit absorbs it"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the position."""
        return [joint.q]


GRAVITY_TURN = "gravity_turn"
"""Signal (N, na, 2) [N/rad or N m/rad]: forces at rest per turn of gravity about each of two axes across it."""


class GravityDirection(Effect):
    """A turn of gravity against the robot's base, on all joints."""

    name = "gravity_direction"
    cause = True
    equation = "tau += G(phi x g) tilt, G(g) the forces at rest under gravity g"
    reference = "Khalil & Dombre 2002, 9.4; Atkeson, An & Hollerbach 1986"
    reveals = (
        "slow motion over the whole workspace, joints with a vertical axis included, or a spirit level on the base"
    )
    mistaken_for = ("torque_offset", "coulomb_asymmetry", "link_mass", "position_friction")
    # A floor is off by some mrad, a stand by up to 0.2 rad; more is another mounting, which is no small error
    plausible = (PlausibleRange("tilt", -0.2, 0.2, "rad"),)
    needs = (GRAVITY_TURN,)

    @property
    def parameters(self) -> Parameters:
        """The turns about both axes, at zero."""
        return Parameters(Parameter(f"base.tilt_{axis}{self.label}", 0.0, "rad", origin=self.name) for axis in "xy")

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together."""
        return [scene.joints]

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per radian of each turn (N, na, 2)."""
        out, turned = np.zeros((*motion.v.shape, 2)), motion.signal(GRAVITY_TURN)
        for k in self._indices(motion):
            out[:, k] = turned[:, k]
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the turns."""
        x, y = parameters.select(self.parameters.names)
        return f"gravity turned by {format_amount(x)} and {format_amount(y)} about x and y: the base is not level"
