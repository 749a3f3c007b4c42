"""What forward and inverse kinematics answer: numbers, and for each sample that has none the reason."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.poses import Poses

OK, OUT_OF_REACH, SINGULAR, BRANCH_CHANGE, NO_CONVERGENCE, JOINT_LIMIT, NOT_A_NUMBER = range(7)

REASONS = np.array(
    ["", "out of reach", "singular", "branch change", "no convergence", "joint limit", "not a number"]
)  # fmt: skip
"""Reasons by code.

`out of reach`: no pose or no positions close the loops. `singular`: they do, but the mechanism has lost or won a freedom there.
`branch change`: what was found lies beyond a singularity, in another assembly mode than home's or the start's. `no convergence`:
Newton's steps did not come to rest; a solution may exist. `joint limit`: positions exist outside the file's limits.
"""


class _Judged:
    """Samples with a code each."""

    code: np.ndarray

    @property
    def ok(self) -> np.ndarray:
        """Where there is an answer (N,)."""
        return self.code == OK

    @property
    def reason(self) -> np.ndarray:
        """Why there is none, '' where there is one (N,)."""
        return REASONS[self.code]


@dataclass(frozen=True, eq=False)
class ForwardResult(_Judged):
    """Poses from actuated positions.

    Attributes:
        poses: Of the tool, nan where there is none.
        plate: Of the plate; for a robot without one the tool's again.
        code: Index into `REASONS` (N,).
    """

    poses: Poses
    plate: Poses
    code: np.ndarray


@dataclass(frozen=True, eq=False)
class InverseResult(_Judged):
    """Actuated positions from poses.

    Attributes:
        q: (N, na) [m or rad], nan where there are none.
        code: Index into `REASONS` (N,).
        position_error: How far the tool is from the pose asked for (N,) [m]; nan without positions.
        orientation_error: By which angle it is turned from it (N,) [rad]; more than rounding only where the robot has too few
            freedoms for the orientation asked for.
        culprit: Actuated joints to blame, '' for none (N,).
        unlimited: Positions before joint limits were looked at (N, na).
        rotation: Rotation that the tool takes there (N, 3, 3), the one asked for where the robot can; nan without `unlimited`.
    """

    q: np.ndarray
    code: np.ndarray
    position_error: np.ndarray
    orientation_error: np.ndarray
    culprit: np.ndarray
    unlimited: np.ndarray = field(repr=False)
    rotation: np.ndarray = field(repr=False)


class InverseSolutions(NamedTuple):
    """Solutions of each pose.

    Attributes:
        q: Positions (N, n, na); nan where complex, or to fill up.
        proved: Whether those of a pose are all there are (N,).
        why: The reason, a sentence a pose.
    """

    q: np.ndarray
    proved: np.ndarray
    why: list[str]
