"""Until which size of errors a linear bound holds: the same errors, all enlarged together, at one pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.kinematics.accuracy.error_bounds import MAX_ERROR_SIZE, ErrorBounds
from tau_dyn.kinematics.accuracy.study import Accuracy, build_device, compute_positioning_errors
from tau_dyn.mechanism import Poses, Rods
from tau_dyn.robot import Robot

FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)


class Growth(NamedTuple):
    """Errors enlarged at one pose.

    Attributes:
        factors: By how much (k,).
        largest: Largest displacement by method, each (k,) [m]; nan where there is none.
    """

    factors: np.ndarray
    largest: dict[str, np.ndarray]

    def holds_to(self, method: str, share: float) -> float:
        """Return the largest factor, of those tried, up to which a method is within a share of the exact; nan for none."""
        with np.errstate(all="ignore"):
            off = np.abs(self.largest[method] / self.largest["exact"] - 1)
        good = np.cumprod(off <= share).astype(bool)
        return float(self.factors[good][-1]) if good.any() else float("nan")


def scale_errors(
    robot: Robot, rods: Rods | None, errors: ErrorBounds, q: np.ndarray, tool: Poses, methods: Sequence[str],
    factors: Sequence[float] = FACTORS,
) -> Growth:  # fmt: skip
    """Return the methods' largest displacements at one pose (q (na,), tool 1 sample) for enlarged errors."""
    kept = [f for f in factors if errors.largest * f <= MAX_ERROR_SIZE]
    rows: list[Accuracy] = []
    for factor in kept:
        more = errors.scaled(factor)
        rows.append(
            compute_positioning_errors(build_device(robot, rods, more), more, q[None], tool, methods=methods, samples=1)
        )
    return Growth(np.array(kept), {m: np.array([r.largest[m][0] for r in rows]) for m in rows[0].largest})
