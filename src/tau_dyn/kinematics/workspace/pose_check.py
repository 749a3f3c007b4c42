"""Requirements for a pose, and the first one that it violates; cheap ones are checked first, collisions last.

A rod is not tested against the cart and the plate that hold its joints, nor against the guideway of that cart: there the ball
joint's angle is the limit, and the shape of brackets and sockets is not in a robot file. Solids that touch at home are left out
as well, and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.dexterity import compute_dexterity
from tau_dyn.kinematics.obstacles import PlacedSolid, Surroundings, find_collisions, find_touched_obstacle
from tau_dyn.kinematics.solids import Body
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machine import WorkspaceModel, get_travel
from tau_dyn.mechanism import SLACK, BallJoints, Poses, find_ball_joints, unwind_turns

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
"""Kinds of reasons, in the order of the checks; a pose keeps the first that excludes it."""
WORST_CONDITION = 1e3
"""Condition number above which a pose counts as singular: a thousandth of the best direction's speed is left."""


@dataclass(frozen=True, eq=False)
class PoseRequirements:
    """Requirements for a pose.

    Attributes:
        ball_angle: Largest angle of rods in their ball joints [rad]; None takes the file's, or else 45 degrees.
        surroundings: Obstacles, zones and the tool's limits.
        collisions: Whether the robot must not touch itself and its frame.
        clearance: Distance that solids of the robot keep from each other [m].
        condition: Largest condition number.
        singularity: Least distance to a singularity, in singular values of the homogenised closure; 0 requires only the sign
            of the determinant at home.
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
        """Refuse values out of range."""
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
    """Codes of reasons: INSIDE, then one per pair of kind and culprit, in the order of occurrence."""

    def __init__(self) -> None:
        """Start without reasons."""
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


_GUIDEWAY_CLEARANCE_M = 0.02  # [m] largest distance between a cart and its guideway


@dataclass(frozen=True)
class SolidPair:
    """Two solids: indices among the bodies, and the name of the pair."""

    first: int
    second: int
    name: str

    def touches(self, solids: Mapping[int, PlacedSolid] | Sequence[PlacedSolid], margin: float) -> np.ndarray:
        """Return at which poses (N,) they come closer than `margin` [m]."""
        return find_collisions(solids[self.first], solids[self.second], margin)


def list_pairs(machine: WorkspaceModel, margin: float = 0.0) -> tuple[list[SolidPair], list[str]]:
    """Return the pairs to test, and the names of pairs left out because they touch at home although no joint connects them."""
    bodies = machine.bodies
    solids = machine.solids(machine.robot.home[None], machine.home)
    kept: list[SolidPair] = []
    touching: list[str] = []
    for i in range(len(bodies)):
        for j in range(i):
            a, b = (i, j) if bodies[i].rod >= 0 else (j, i)  # a rod first: its cover is the finest
            if _joined(a, b, bodies, solids, machine):
                continue
            pair = SolidPair(a, b, f"{bodies[a].name} and {bodies[b].name}")
            if not pair.touches(solids, margin)[0]:
                kept.append(pair)
            elif not _rides(bodies[a], bodies[b], machine):
                touching.append(pair.name)
    return kept, list(dict.fromkeys(touching))


def _joined(a: int, b: int, bodies: list[Body], solids: list[PlacedSolid], machine: WorkspaceModel) -> bool:
    """Return whether two solids belong to one link, or one is a rod and the other holds its joint or carries the holder."""
    if bodies[a].rod < 0:
        return bodies[a].joint == bodies[b].joint
    if bodies[b].rod >= 0:
        apart = np.linalg.norm(_ends(solids[a])[:, None] - _ends(solids[b])[None], axis=2)
        return bool(apart.min() < 1e-3)
    holders = machine.holders(bodies[a].rod)
    if bodies[b].joint in holders:
        return True
    carts = [k for k, body in enumerate(bodies) if body.rod < 0 and body.joint in holders]
    under = [machine.robot.model.parents[j] for j in holders]
    return bodies[b].joint in under and any(
        find_collisions(solids[k], solids[b], _GUIDEWAY_CLEARANCE_M)[0] for k in carts
    )


def _rides(a: Body, b: Body, machine: WorkspaceModel) -> bool:
    """Return whether a joint connects two links."""
    parents = machine.robot.model.parents
    return a.rod < 0 and (parents[a.joint] == b.joint or parents[b.joint] == a.joint)


def _ends(rod: PlacedSolid) -> np.ndarray:
    """Return a rod's joints (2, 3) at its first pose."""
    assert rod.length is not None
    half = rod.rotation[0][:, 2] * rod.length[0] / 2
    return np.array([rod.position[0] - half, rod.position[0] + half])


_BATCH = 20000  # poses at a time, tens of MB


class PoseCheck(NamedTuple):
    """Codes (N,) and positions (N, na) of poses; positions are nan without a solution."""

    code: np.ndarray
    q: np.ndarray


class PoseChecker:
    """Checks the poses of one robot against one set of requirements."""

    def __init__(self, machine: WorkspaceModel, demands: PoseRequirements, reasons: Reasons | None = None) -> None:
        """Prepare; find the pairs that touch at home."""
        self.machine, self.demands = machine, demands
        self.reasons = reasons if reasons is not None else Reasons()
        self.balls: BallJoints | None = None
        if machine.rods is not None:
            self.balls = find_ball_joints(machine.rods, angle=demands.ball_angle)
        self._lower, self._upper = get_travel(machine.robot)
        self._endless = ~np.isfinite(machine.robot.upper) | ~np.isfinite(machine.robot.lower)
        self._turns = np.array([kind == "revolute" for kind in machine.robot.joint_kinds]) & ~self._endless
        home = compute_dexterity(machine.rates(machine.robot.home[None], machine.home))
        self._signs = float(home.tool_sign[0]), float(home.actuator_sign[0])
        self.pairs, self.touching = list_pairs(machine, demands.clearance) if demands.collisions else ([], [])
        self.n_judged, self.turned = 0, 0.0

    def judge(self, poses: Poses) -> PoseCheck:
        """Return codes and positions of poses."""
        n = len(poses.position)
        parts = [self._part(poses.take(slice(k, k + _BATCH))) for k in range(0, n, _BATCH)]
        self.n_judged += n
        if not parts:
            return PoseCheck(np.zeros(0, int), np.zeros((0, self.machine.robot.na)))
        return PoseCheck(np.concatenate([p.code for p in parts]), np.concatenate([p.q for p in parts]))

    def _part(self, poses: Poses) -> PoseCheck:
        solved = self.machine.solve(poses)
        poses, self.turned = solved.poses, max(self.turned, solved.turned)
        code = np.full(len(solved.ok), INSIDE)
        for reason in np.unique(solved.reason[~solved.ok].astype(str)):
            code[~solved.ok & (solved.reason == reason)] = self.reasons.code(*_of_solver(reason))
        q = unwind_turns(solved.q, self._turns, self._lower, self._upper)
        self._actuators(code, q)
        self._places(code, poses.position)
        self._balls(code, q, poses)
        self._singular(code, q, poses)
        self._touches(code, q, poses)
        return PoseCheck(code, q)

    def _mark(self, code: np.ndarray, index: np.ndarray, wrong: np.ndarray, kind: str, culprit: str = "") -> None:
        """Set the reason of the poses at `index` that are wrong, unless they already have one."""
        hit = index[wrong]
        hit = hit[code[hit] == INSIDE]
        if len(hit):
            code[hit] = self.reasons.code(kind, culprit)

    def _actuators(self, code: np.ndarray, q: np.ndarray) -> None:
        if not self.demands.actuators:
            return
        index = np.flatnonzero(code == INSIDE)
        for k, name in enumerate(self.machine.robot.actuated):
            if not self._endless[k]:
                x = q[index, k]
                outside = (x < self._lower[k] - SLACK) | (x > self._upper[k] + SLACK)
                self._mark(code, index, outside, "actuator limit", name)

    def _places(self, code: np.ndarray, place: np.ndarray) -> None:
        index = np.flatnonzero(code == INSIDE)
        around = self.demands.surroundings
        for k, axis in enumerate("xyz"):
            x = place[index, k]
            self._mark(code, index, (x < around.lower[k] - SLACK) | (x > around.upper[k] + SLACK), "tool limit", axis)
        for zone in around.obstacles:
            kind = "safety zone" if zone.blocks == "tool" else "obstacle"
            self._mark(code, index, zone.distance(place[index]) < zone.margin, kind, zone.name)

    def _balls(self, code: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        index = np.flatnonzero(code == INSIDE)
        if self.balls is None or not len(index):
            return
        assert self.machine.rods is not None
        angles = self.balls.angles(q[index], self.machine.rods.plate_poses(poses.take(index)))
        for side, where in enumerate(("cart", "plate")):
            for k, rod in enumerate(self.machine.rods.names):
                wrong = angles[:, side, k] > self.balls.limits[side, k] + SLACK
                self._mark(code, index, wrong, "ball joint", f"{rod} on the {where}")

    def _singular(self, code: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        index = np.flatnonzero(code == INSIDE)
        if not len(index):
            return
        found = compute_dexterity(self.machine.rates(q[index], poses.take(index)))
        beyond = (found.tool_sign != self._signs[0]) | (found.actuator_sign != self._signs[1])
        self._mark(code, index, beyond, "singularity", "beyond one, seen from home")
        near = ~(found.condition <= self.demands.condition)
        self._mark(code, index, near, "singularity", f"condition above {self.demands.condition:g}")
        close = ~(found.singularity >= self.demands.singularity)
        self._mark(code, index, close, "singularity", f"closer than {self.demands.singularity:g}")

    def _touches(self, code: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        walls = [o for o in self.demands.surroundings.obstacles if o.blocks == "robot"]
        index = np.flatnonzero(code == INSIDE)
        if not len(index) or not (walls or self.pairs):
            return
        solids = self.machine.solids(q[index], poses.take(index))
        moving = [s for s, body in zip(solids, self.machine.bodies, strict=True) if body.joint != 0]
        free = np.ones(len(index), bool)

        def note(hit: np.ndarray, kind: str, culprit: str) -> None:
            left = np.flatnonzero(free)
            self._mark(code, index[left], hit, kind, culprit)
            free[left[hit]] = False

        for wall in walls:
            left = np.flatnonzero(free)
            some = [solid.take(left) for solid in moving]
            note(find_touched_obstacle(wall, some, len(left)), "obstacle", wall.name)
        for pair in self.pairs:
            left = np.flatnonzero(free)
            if len(left):
                some = {k: solids[k].take(left) for k in (pair.first, pair.second)}
                hit = np.broadcast_to(pair.touches(some, self.demands.clearance), len(left))
                note(hit, "collision", pair.name)


def _of_solver(reason: str) -> tuple[str, str]:
    """Return the kind of a reason of inverse kinematics, and its text if that is more specific."""
    if reason == "singular":
        return "singularity", "no inverse kinematics"
    if reason == "branch change":
        return "singularity", "beyond one, seen from home"
    return "out of reach", "" if reason in ("out of reach", "") else reason
