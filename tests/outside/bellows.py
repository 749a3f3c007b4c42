"""A bellows over a guideway pulls its cart back to the middle, as a spring does."""

import sys

from tau_dyn.cli import main
from tau_dyn.effects import JointwiseEffect, PlausibleRange, register


@register
class Bellows(JointwiseEffect):
    """A spring between a cart and the middle of its guideway."""

    name = "bellows"
    cause = True
    equation = "tau += bellows q"
    reveals = "slow strokes over the whole guideway"
    plausible = (PlausibleRange("bellows", 0.0, 1e5, "N/m"),)
    quantities = (("bellows", "F/Q"),)
    nonnegative = True

    def per_joint(self, joint):
        """Return the force per unit stiffness (N,), for a joint's positions (N,)."""
        return [1.0 * joint.q]


if __name__ == "__main__":
    sys.exit(main())
