"""True motion and forces of a simulation, before any sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from tau_dyn.model import Model
from tau_dyn.simulate.trajectory import Trajectory

Progress = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1, about a hundred times."""

OFTEN_AT_LIMIT = 0.05
"""Share of the samples at a joint's force limit, or at its controller's, above which a run or a replay warns."""


@dataclass(frozen=True, eq=False)
class PlantRun:
    """The true motion and forces, before any sensor.

    Attributes:
        model: The plant.
        t: Time (N,) [s].
        q: True positions (N, na) [m or rad].
        v: True velocities (N, na), the mean of the half steps around each sample, which central differences reproduce.
        a: True accelerations (N, na).
        tau: Forces applied (N, na) [N or N m].
        stuck: Where friction held a joint (N, na).
        reference: Reference of the controller, on the same clock; None for a free motion.
        q_read: Encoder readings that the controller used (N, na); None if it used the true positions.
        q_shown: Readings of perfect encoders (N, na) if an effect makes them differ from the loads' positions.
        tau_shown: Forces as perfect sensors would log them (N, na) if an effect delays them.
        tool_shown: Position of the tool (N, 3) [m] if an effect moves carts off their guideways.
        compute_tool: Gives the tool's positions (N, 3) along positions (N, na) faster than the model, or None.
    """

    model: Model
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    stuck: np.ndarray
    reference: Trajectory | None = None
    q_read: np.ndarray | None = None
    q_shown: np.ndarray | None = None
    tau_shown: np.ndarray | None = None
    tool_shown: np.ndarray | None = None
    compute_tool: Callable[[np.ndarray], np.ndarray | None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling: all attributes except the compiled code of this process."""
        return {**self.__dict__, "compute_tool": None}

    @property
    def sticking_share(self) -> np.ndarray:
        """Share of the samples in which friction held each joint (na,)."""
        return self.stuck.mean(axis=0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about the run: the reference's notes, and joints that were often at their force limit."""
        robot = self.model.robot
        share = np.mean(np.abs(self.tau) >= robot.effort_limit * (1 - 1e-9), axis=0)
        at_limit = (
            f"joint {joint} was at its force limit of {limit:g} {unit} in {100 * part:.0f} % of the samples; it did not "
            "follow the reference freely, and its feedback may swing between the limits"
            for joint, limit, unit, part in zip(
                robot.actuated, robot.effort_limit, robot.force_units, share, strict=True
            )
            if part > OFTEN_AT_LIMIT
        )
        return (*(self.reference.notes if self.reference is not None else ()), *at_limit)

    @cached_property
    def tool(self) -> np.ndarray:
        """True tool positions (N, 3) [m]."""
        found = None if self.compute_tool is None else self.compute_tool(self.q)
        return self.model.mechanism.tool_position(self.q) if found is None else found

    def every(self, step: int) -> PlantRun:
        """Return every `step`-th sample."""
        keep = slice(None, None, step)
        names = ("t", "q", "v", "a", "tau", "stuck", "q_read", "q_shown", "tau_shown", "tool_shown")
        arrays = {key: getattr(self, key)[keep] for key in names if getattr(self, key) is not None}
        reference = self.reference.every(step) if self.reference is not None else None
        return replace(self, **arrays, reference=reference)
