r"""A cart that yields to the force its rod puts across its guideway.

    u = guideway_compliance F,     F the force across the guideway (3,) [N]

`F` comes from the model's masses (`Mechanism.guide_force`), so it turns and changes with the tool's place; the cart's own
weight is constant and belongs to the guideway's position. One compliance in all directions across. Reference: Dressler 2012,
4.2 and 5.3: carts shift by up to 100 um with the angles of the links, which a model of straight guideways leaves.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.cart_shift import SENSITIVITY, CartShift
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameter, Parameters

SIDE_FORCE = "side_force"
"""Signal (N, na, 3) [N]: the force across each prismatic joint's axis, in base axes."""


class GuidewayCompliance(CartShift):
    """Displacement across the guideway in proportion to the load across it."""

    name = "guideway_compliance"
    cause = True
    equation = "cart displaced by u = guideway_compliance F, F the rod's force across the guideway"
    reference = "Dressler 2012, 4.2 and 5.3"
    reveals = (
        "tool positions measured over the whole workspace, with the links at many angles, and once with a known payload"
    )
    mistaken_for = ("cart_tilt", "guideway_not_straight", "rod_length")
    # Linear guides have 0.01 to 2 um/N; a light frame yields ten times more
    plausible = (PlausibleRange("guideway_compliance", 0.0, 2e-5, "m/N"),)
    needs = (SENSITIVITY, SIDE_FORCE)
    nonnegative = True

    @property
    def parameters(self) -> Parameters:
        """One compliance a cart, at zero."""
        names = (f"{joint}.guideway_compliance{self.label}" for joint in self.joints)
        return Parameters(Parameter(name, 0.0, "m/N", 0.0, origin=self.name) for name in names)

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
