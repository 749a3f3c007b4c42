"""Whether positions, and the straight moves in joint space between them, are allowed: reach, limits, collisions."""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics import PlacedSolid, Rates
from tau_dyn.kinematics.workspace import INSIDE, InverseSolution, PoseChecker, PoseRequirements, WorkspaceModel
from tau_dyn.mechanism import Poses, forward_kinematics

_STEPS = 40
"""Places at which a move over the whole travel is looked at."""


class PathCheck:
    """Judges positions as a workspace does, without inverse kinematics.

    Args:
        machine: The robot.
        demands: What every place on the way must satisfy.
    """

    def __init__(self, machine: WorkspaceModel, demands: PoseRequirements) -> None:
        """Prepare."""
        self.machine = machine
        self._given = _Given(machine)
        self._judge = PoseChecker(self._given, demands)
        lower, upper = machine.robot.lower, machine.robot.upper
        self.travel = np.where(np.isfinite(upper - lower), upper - lower, 2 * np.pi)

    def poses(self, q: np.ndarray) -> tuple[Poses, np.ndarray]:
        """Return tool poses at positions (N, na) and where there are any (N,)."""
        robot = self.machine.rods if self.machine.rods is not None else self.machine.robot
        found = forward_kinematics(robot, q)
        return found.poses, found.ok

    def reasons(self, q: np.ndarray) -> np.ndarray:
        """Return why positions (N, na) are not allowed (N,), '' where they are."""
        poses, ok = self.poses(q)
        out = np.full(len(q), "out of reach", dtype=object)
        good = np.flatnonzero(ok)
        if len(good):
            self._given.q = q[good]
            code = self._judge.judge(poses.take(good)).code
            out[good] = [self._judge.reasons.words(int(c)) if c != INSIDE else "" for c in code]
        return out

    def blocked(self, start: np.ndarray, end: np.ndarray) -> list[str]:
        """Return why each straight move from `start` to `end` (n, na) is not allowed, '' where it is."""
        many = [
            max(2, int(np.ceil(_STEPS * np.max(np.abs(b - a) / self.travel)))) for a, b in zip(start, end, strict=True)
        ]
        parts = [a + np.linspace(0, 1, k + 1)[1:-1, None] * (b - a) for a, b, k in zip(start, end, many, strict=True)]
        words = self.reasons(np.concatenate(parts)) if parts else np.zeros(0, object)
        splits = np.split(words, np.cumsum([len(p) for p in parts])[:-1]) if parts else []
        return [next((w for w in part if w), "") for part in splits]


class _Given:
    """A machine whose positions are known already: the judge asks it for inverse kinematics and gets them."""

    def __init__(self, machine: WorkspaceModel) -> None:
        self.machine, self.robot, self.rods = machine, machine.robot, machine.rods
        self.home, self.bodies, self.meshes = machine.home, machine.bodies, machine.meshes
        self.q = np.zeros((0, machine.robot.na))

    def solve(self, poses: Poses) -> InverseSolution:
        n = len(poses.position)
        now, self.q = self.q[:n], self.q[n:]  # the judge works in batches
        return InverseSolution(now, np.ones(n, bool), np.full(n, "", dtype=object), poses)

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        if self.rods is None and not self.robot.loops:  # moves in joint space pass a serial arm's singularities
            one = np.broadcast_to(np.eye(3), (len(q), 3, 3))
            return Rates(one, one, np.zeros(3, bool), 1.0)
        return self.machine.rates(q, poses)

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        return self.machine.solids(q, poses)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        return self.machine.reach()

    def holders(self, rod: int) -> list[int]:
        return self.machine.holders(rod)
