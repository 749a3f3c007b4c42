r"""A guideway that points elsewhere than the robot file says.

    u = q (direction_y d_y + direction_z d_z)

with `d_y`, `d_z` two unit directions across the guideway (y and z of one along x, see `compute_perpendicular_axes`). Angles
[rad] from the
guideway's origin. A turn along itself is none, and a scale along it is `pinion_scale`. Reference: Dressler 2012, 4.1 and 5.2
(guideways that are not parallel, calibrated by a laser tracker).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.cart_shift import SENSITIVITY, CartShift
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter, Parameters

GUIDE_ACROSS = "guide_across"
"""Signal (N, na, 2, 3): two unit directions across each prismatic joint's axis, in base axes; zeros for a hinge."""


class GuidewayNonparallel(CartShift):
    """Displacement across the guideway in proportion to the way along it."""

    name = "guideway_nonparallel"
    cause = True
    equation = "cart displaced by u = q (direction_y d_y + direction_z d_z), d_y and d_z across the guideway"
    reference = "Dressler 2012, 4.1 and 5.2"
    reveals = "tool positions measured over each guideway's whole length, with the rods at many angles"
    mistaken_for = ("pinion_scale", "guideway_not_straight", "cart_tilt", "transmission_error", "rod_length")
    # Guideways are laid to 0.1 to 5 mrad; 20 mrad are 2 cm in a metre, which an eye sees
    plausible = (PlausibleRange("direction", -0.02, 0.02, "rad"),)
    needs = (SENSITIVITY, GUIDE_ACROSS)

    @property
    def parameters(self) -> Parameters:
        """Two angles a cart, at zero."""
        names = (f"{joint}.direction_{axis}{self.label}" for joint in self.joints for axis in "yz")
        return Parameters(Parameter(name, 0.0, "rad", origin=self.name) for name in names)

    def shift(self, motion: Motion) -> np.ndarray:
        """Return the way along both directions as that cart's displacement per unit (N, na, 3, p)."""
        across = motion.signal(GUIDE_ACROSS)
        out = np.zeros((*motion.q.shape, 3, 2 * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            for axis in range(2):
                out[:, index, :, 2 * k + axis] = motion.q[:, index, None] * across[:, index, axis]
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return both angles."""
        said = []
        for k, joint in enumerate(self.joints):
            names = self.parameters.names[2 * k : 2 * k + 2]
            y, z = (format_amount(parameters[name]) for name in names)
            said.append(
                f"the guideway is off its direction by {y} and {z}" + (f" at {joint}" if len(self.joints) > 1 else "")
            )
        return "; ".join(said)
