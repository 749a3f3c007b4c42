"""Are guideways parallel: the angle between two fitted lines, with its standard error and a test of zero (thesis 4.2).

The lines must be measured in one frame. With unit directions d_i, the small angle's vector is `d_i x d_j`; its part along
the lines is no angle, so two numbers are tested (chi-squared).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

from tau_dyn.kinematics.assumptions.guideway import SIGNIFICANCE_LEVEL, Guideway


@dataclass(frozen=True)
class Parallelism:
    """Two guideways against each other.

    Attributes:
        joints: Their actuated joints.
        angle: Between them [rad].
        stderr: Standard error [rad].
        p_value: Of their being parallel.
        apart: What the angle makes over the longer of the two travels [m].
    """

    joints: tuple[str, str]
    angle: float
    stderr: float
    p_value: float
    apart: float

    @property
    def sure(self) -> bool:
        """Whether they are not parallel, beyond chance."""
        return self.p_value < SIGNIFICANCE_LEVEL

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        size = f"{1e3 * self.angle:.3f} +- {1e3 * self.stderr:.3f} mrad"
        if not self.sure:
            return f"{self.joints[0]} and {self.joints[1]} are parallel as far as these points tell ({size})."
        return f"{self.joints[0]} and {self.joints[1]} are not parallel: {size}, {1e6 * self.apart:.0f} um over the travel."

    def to_dict(self) -> dict[str, Any]:
        """Return what a result file holds of it."""
        return asdict(self) | {"joints": list(self.joints), "sentence": self.sentence}


def check_parallelism(lines: Sequence[Guideway]) -> list[Parallelism]:
    """Return each pair of guideways against each other, all measured in one frame."""
    return [_pair(one, other) for one, other in combinations(lines, 2)]


def _pair(one: Guideway, other: Guideway) -> Parallelism:
    d, g = one.direction, other.direction
    g = g if d @ g > 0 else -g
    angle = np.cross(d, g)
    plane = np.linalg.svd((d + g)[None])[2][1:]
    cross = [_cross(line, plane) for line in (one, other)]
    covariance, two = cross[0] + cross[1], plane @ angle
    size = float(np.linalg.norm(two))
    unit = two / size if size > 0 else np.array([1.0, 0.0])
    statistic = float(two @ np.linalg.pinv(covariance) @ two)
    travel = max(float(np.ptp(line.q)) for line in (one, other))
    p = float(stats.chi2.sf(statistic, 2)) if np.any(covariance) else float(size == 0)
    return Parallelism((one.joint, other.joint), size, float(np.sqrt(unit @ covariance @ unit)), p, size * travel)


def _cross(line: Guideway, plane: np.ndarray) -> np.ndarray:
    """Return the covariance (2, 2) [rad^2] of a direction's turn within the plane's two axes."""
    d = line.direction
    turned = np.cross(d, np.eye(3)).T / np.linalg.norm(line.slope)  # column k: d x (unit change of slope k)
    return plane @ turned @ line.covariance @ turned.T @ plane.T
