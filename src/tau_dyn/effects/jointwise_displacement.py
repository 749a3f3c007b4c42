"""A displacement between encoder and load that depends on each joint's own motion.

A subclass says the displacement per unit of each quantity for one joint (`per_joint`); forces and tool positions follow as for
every `DisplacementEffect`. Such effects distort what the encoder reads, so the simulator adds them to the recorded position.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.scene import Scene

SEEN_DIRECTLY = frozenset({"tool", "load_side"})
"""Signals that show where the load is: a measured tool, an encoder behind the drive."""


class JointwiseDisplacement(DisplacementEffect, JointwiseEffect):
    """What an encoder reads beyond its load, joint by joint; `per_joint` is a displacement [m or rad].

    Attributes:
        hidden: Why forces alone cannot show it; empty where they can.
    """

    hidden: ClassVar[str] = ""

    @property
    def measured(self) -> bool:
        """The encoder's reading is off, and not the robot."""
        return True

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad]."""
        return JointwiseEffect.columns(self, motion)

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return what the logs lack; where the load is measured directly, no force has to be explained by it."""
        direct = bool(SEEN_DIRECTLY & scene.signals)
        if cls.hidden and not direct:
            return cls.hidden, cls.reveals
        missing = [s for s in cls.needs if s not in scene.signals and not (direct and s in DisplacementEffect.needs)]
        return (f"the logs give no {missing[0]}", cls.reveals) if missing else None
