r"""Effects that move a cart where its encoder does not look: the end of its rod is not where the guideway says.

    T = T(q) + sum_i S_i u_i @ parameters

with `u_i` the displacement of cart i [m] in base axes and `S_i` what the tool makes of it (`Mechanism.cart_sensitivity`; of
`u_i` only the part along the rod counts). Only a measured tool shows them: what micrometres change of forces is left out.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.scene import Scene

SENSITIVITY = "cart_sensitivity"
"""Signal (N, 3, na, 3): the tool's displacement per displacement of each cart, in base axes."""


class CartShift(DisplacementEffect):
    """A displacement of carts in any direction, linear in its parameters."""

    needs = (SENSITIVITY,)

    @abstractmethod
    def shift(self, motion: Motion) -> np.ndarray:
        """Return each cart's displacement per unit parameter (N, na, 3, p) [m], in base axes."""

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return zeros (N, na, p): the encoder and its pinion stay together."""
        return np.zeros((*motion.q.shape, len(self.parameters)))

    def columns(self, motion: Motion) -> np.ndarray:
        """Return zeros (N, na, p): no force to first order."""
        return self.displacement(motion)

    def tool_columns(self, motion: Motion, tool_jacobian: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per unit parameter (N, 3, p) [m], in base axes."""
        return np.einsum("nxik,nikp->nxp", motion.signal(SENSITIVITY), self.shift(motion))

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return each sliding joint alone."""
        return [(joint,) for joint, unit in zip(scene.joints, scene.units, strict=True) if unit == "N"]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that a measured tool is missing, or carts, where so."""
        if not cls.groups(scene):
            return "the robot has no carts", cls.reveals
        return None if SENSITIVITY in scene.signals else ("no measured tool positions are looked at here", cls.reveals)
