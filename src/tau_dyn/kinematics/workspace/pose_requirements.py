"""What a pose must satisfy to belong to a workspace, and the reasons by which it does not."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.obstacles import Surroundings
from tau_dyn.kinematics.workspace.lattice import INSIDE

KINDS = (
    "out of reach",
    "actuator limit",
    "tool limit",
    "safety zone",
    "ball joint",
    "singularity",
    "obstacle",
    "collision",
    "not connected to home",
    "too close to the border",
)
"""Kinds of reasons, in the order in which they are asked; a pose keeps the first that excludes it."""
WORST_CONDITION = 1e3
"""Condition number above which a pose counts as singular: a thousandth of the best direction's speed is left."""


@dataclass(frozen=True, eq=False)
class PoseRequirements:
    """What a pose must satisfy.

    Attributes:
        ball_angle: Largest angle of rods in their ball joints [rad]; None takes the file's, 45 degrees where it gives none.
        surroundings: Obstacles, zones and the tool's limits.
        collisions: Whether the robot must not touch itself and its frame.
        clearance: Distance that solids of the robot keep from each other [m].
        condition: Largest condition number.
        singularity: Least distance to a singularity, in singular values of the homogenised closure; 0 asks for its sign alone.
        border: Distance to keep from the workspace's border [m].
        actuators: Whether actuator limits count.
    """

    ball_angle: float | None = None
    surroundings: Surroundings = field(default_factory=Surroundings)
    collisions: bool = True
    clearance: float = 0.0
    condition: float = WORST_CONDITION
    singularity: float = 0.0
    border: float = 0.0
    actuators: bool = True

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        if self.ball_angle is not None and not 0 < self.ball_angle <= np.pi:
            raise InputError(
                "invalid_value",
                f"the ball joints' angle must lie between 0 and 180 degrees, not {np.rad2deg(self.ball_angle):g}",
            )
        for name in ("clearance", "singularity", "border"):
            if not 0 <= getattr(self, name) < 1e6:
                raise InputError(
                    "invalid_value", f"{name} must be a finite number from zero up, not {getattr(self, name)}"
                )
        if not self.condition >= 1:
            raise InputError("invalid_value", f"the largest condition number must be 1 or more, not {self.condition}")


class Reasons:
    """Codes for reasons: INSIDE, then one a pair of kind and culprit, as they turn up."""

    def __init__(self) -> None:
        """Start with none."""
        self._known: dict[tuple[str, str], int] = {}

    def code(self, kind: str, culprit: str = "") -> int:
        """Return the code of a reason."""
        return self._known.setdefault((kind, culprit), len(self._known) + INSIDE + 1)

    def items(self) -> list[tuple[int, str, str]]:
        """Return code, kind and culprit of every reason, in the order of the kinds."""
        listed = [(code, kind, culprit) for (kind, culprit), code in self._known.items()]
        return sorted(listed, key=lambda row: (KINDS.index(row[1]), row[0]))

    def words(self, code: int) -> str:
        """Return a reason as words; empty for INSIDE."""
        for (kind, culprit), known in self._known.items():
            if known == code:
                return f"{kind}: {culprit}" if culprit else kind
        return ""
