"""The order in which poses are measured: short, every position and every straight move between them allowed.

A move takes as long as its slowest joint, so distances are the largest share of the travel. The tour starts at home: nearest
neighbour first, then 2-opt until no reversal of a stretch makes it shorter. Moves that collide cost too much to be taken; where
one remains, it goes through a place in between. A pose without a free move to it is left out and named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from tau_dyn.kinematics import PlacedSolid, Rates
from tau_dyn.kinematics.workspace import INSIDE, InverseSolution, PoseChecker, PoseRequirements, WorkspaceModel
from tau_dyn.mechanism import Poses, forward_kinematics

_STEPS = 40
"""Number of places at which a move over the whole travel is checked."""


class PathCheck:
    """Check of positions as in a workspace analysis, without inverse kinematics.

    Args:
        machine: The robot.
        demands: Conditions that every place on the way must satisfy.
    """

    def __init__(self, machine: WorkspaceModel, demands: PoseRequirements) -> None:
        """Prepare the check of positions."""
        self.machine = machine
        self._given = _Given(machine)
        self._judge = PoseChecker(cast(WorkspaceModel, self._given), demands)  # it has the methods that are called
        lower, upper = machine.robot.lower, machine.robot.upper
        self.travel = np.where(np.isfinite(upper - lower), upper - lower, 2 * np.pi)

    def poses(self, q: np.ndarray) -> tuple[Poses, np.ndarray]:
        """Return tool poses at positions (N, na) and whether they exist (N,)."""
        robot = self.machine.rods if self.machine.rods is not None else self.machine.robot
        found = forward_kinematics(robot, q)
        return found.poses, found.ok

    def reasons(self, q: np.ndarray) -> np.ndarray:
        """Return why positions (N, na) are not allowed (N,), '' if they are."""
        poses, ok = self.poses(q)
        out = np.full(len(q), "out of reach", dtype=object)
        good = np.flatnonzero(ok)
        if len(good):
            self._given.q = q[good]
            code = self._judge.judge(poses.take(good)).code
            out[good] = [self._judge.reasons.words(int(c)) if c != INSIDE else "" for c in code]
        return out

    def blocked(self, start: np.ndarray, end: np.ndarray) -> list[str]:
        """Return why each straight move from `start` to `end` (n, na) is not allowed, '' if it is."""
        many = [
            max(2, int(np.ceil(_STEPS * np.max(np.abs(b - a) / self.travel)))) for a, b in zip(start, end, strict=True)
        ]
        parts = [a + np.linspace(0, 1, k + 1)[1:-1, None] * (b - a) for a, b, k in zip(start, end, many, strict=True)]
        words = self.reasons(np.concatenate(parts)) if parts else np.zeros(0, object)
        splits = np.split(words, np.cumsum([len(p) for p in parts])[:-1]) if parts else []
        return [next((w for w in part if w), "") for part in splits]


class _Given:
    """A machine with known actuated positions, which it returns as its inverse kinematics."""

    def __init__(self, machine: WorkspaceModel) -> None:
        self.machine, self.robot, self.rods = machine, machine.robot, machine.rods
        self.home, self.bodies, self.meshes = machine.home, machine.bodies, machine.meshes
        self.q = np.zeros((0, machine.robot.na))

    def solve(self, poses: Poses) -> InverseSolution:
        n = len(poses.position)
        now, self.q = self.q[:n], self.q[n:]  # the checker works in batches
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


_BLOCKED = 1e3  # added to the cost of a move that is not free, far above that of free ones
_MAX_ITERATIONS = 12  # of improvement by exchange; bounds its time
_BETWEEN = 40
"""Number of places that are tried for a detour."""


@dataclass(frozen=True, eq=False)
class Tour:
    """Places in the order in which they are visited.

    Attributes:
        q: Actuated positions (k, na), without the start.
        pose: Index of the pose that is measured there (k,), -1 on the way.
        left_out: Poses that no free move leads to, and why.
        length: Length of the tour, in whole travels of the slowest joint.
        as_given: The same in the order given, collisions not counted.
    """

    q: np.ndarray
    pose: np.ndarray
    left_out: dict[int, str]
    length: float
    as_given: float


def plan_tour(q: np.ndarray, start: np.ndarray, check: PathCheck, ways: np.ndarray | None = None) -> Tour:
    """Order poses into a short tour.

    Args:
        q: Poses (n, na).
        start: Current position of the robot (na,).
        check: Check of positions and moves.
        ways: Places (m, na) that moves may go through where the straight one is blocked.
    """
    points = np.vstack([start, q])
    cost = np.max(np.abs(points[:, None] - points[None]) / check.travel, axis=2)
    plain = cost.copy()
    known: dict[tuple[int, int], str] = {}
    order = _short(cost)
    for _ in range(_MAX_ITERATIONS):
        blocked = _look(points, order, check, known)
        if not blocked:
            break
        for a, b in blocked:
            cost[a, b] = cost[b, a] = _BLOCKED + plain[a, b]
        order = _short(cost, order)
    places, pose, left_out = _walk(points, order, check, known, start if ways is None else np.vstack([start, ways]))
    given = float(np.sum(np.max(np.abs(np.diff(points, axis=0)) / check.travel, axis=1)))
    track = np.vstack([start, places]) if len(places) else start[None]
    length = float(np.sum(np.max(np.abs(np.diff(track, axis=0)) / check.travel, axis=1)))
    return Tour(places, pose, left_out, length, given)


def approach_poses(tour: Tour, q: np.ndarray, travel: np.ndarray) -> Tour:
    """Return a tour that enters each pose (n, na) from its place of the tour and goes back to it; poses at their place stay.

    Args:
        tour: Tour over the places before the poses.
        q: The poses themselves (n, na).
        travel: Travel of the joints (na,).
    """
    places, pose, length = [], [], tour.length
    for place, k in zip(tour.q, tour.pose, strict=True):
        apart = k >= 0 and bool(np.any(q[k] != place))
        places += [place, q[k], place] if apart else [place]
        pose += [-1, k, -1] if apart else [k]
        length += 2 * float(np.max(np.abs(q[k] - place) / travel)) if apart else 0.0
    return replace(tour, q=np.array(places).reshape(-1, q.shape[1]), pose=np.array(pose, int), length=length)


def _short(cost: np.ndarray, start: list[int] | None = None) -> list[int]:
    """Return a short open tour from point 0."""
    order = start
    if order is None:
        order, left = [0], set(range(1, len(cost)))
        while left:
            order.append(min(left, key=lambda k: (cost[order[-1], k], k)))
            left.remove(order[-1])
    return _two_opt(np.array(order), cost).tolist()


def _two_opt(order: np.ndarray, cost: np.ndarray) -> np.ndarray:
    n, better = len(order), True
    while better:
        better = False
        for i in range(1, n - 1):
            a, b = order[i - 1], order[i]
            ends = order[i + 1 :]
            after = np.append(order[i + 2 :], -1)
            last = np.where(after < 0, 0.0, cost[ends, after] - cost[b, after])
            gain = cost[a, b] - cost[a, ends] + last
            k = int(np.argmax(gain))
            if gain[k] > 1e-9:
                order[i : i + k + 2] = order[i : i + k + 2][::-1].copy()
                better = True
    return order


def _look(
    points: np.ndarray, order: list[int], check: PathCheck, known: dict[tuple[int, int], str]
) -> list[tuple[int, int]]:
    """Check the moves of a tour that were not checked yet, and return those that are blocked."""
    legs = [(min(a, b), max(a, b)) for a, b in zip(order[:-1], order[1:], strict=True)]
    new = [leg for leg in dict.fromkeys(legs) if leg not in known]
    if new:
        a, b = np.array(new).T
        known.update(zip(new, check.blocked(points[a], points[b]), strict=True))
    return [leg for leg in legs if known[leg]]


def _walk(
    points: np.ndarray, order: list[int], check: PathCheck, known: dict[tuple[int, int], str], ways: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
    """Follow a tour, with detours around obstacles."""
    places, pose, left_out, here = [], [], {}, order[0]
    for there in order[1:]:
        leg = (min(here, there), max(here, there))
        if leg not in known:
            known[leg] = check.blocked(points[[leg[0]]], points[[leg[1]]])[0]
        if known[leg]:
            way = _round(points[here], points[there], check, np.atleast_2d(ways))
            if way is None:
                left_out[there - 1] = known[leg]
                continue
            places.append(way)
            pose.append(-1)
        places.append(points[there])
        pose.append(there - 1)
        here = there
    return np.array(places).reshape(-1, points.shape[1]), np.array(pose, int), left_out


def _round(start: np.ndarray, end: np.ndarray, check: PathCheck, ways: np.ndarray) -> np.ndarray | None:
    """Return a place through which a move can go, the shortest way first."""
    detour = np.max(np.abs(ways - start) / check.travel, axis=1) + np.max(np.abs(ways - end) / check.travel, axis=1)
    near = ways[np.argsort(detour, kind="stable")[:_BETWEEN]]
    first = check.blocked(np.repeat(start[None], len(near), axis=0), near)
    second = check.blocked(near, np.repeat(end[None], len(near), axis=0))
    return next((way for way, a, b in zip(near, first, second, strict=True) if not a and not b), None)
