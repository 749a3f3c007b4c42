"""Judges poses: the first demand that a pose does not meet is its reason; cheap ones come first, collisions last."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.kinematics.collisions import PlacedSolid, find_touched_obstacle
from tau_dyn.kinematics.dexterity import compute_dexterity
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machine import WorkspaceModel, get_travel
from tau_dyn.kinematics.workspace.pairs import list_pairs
from tau_dyn.kinematics.workspace.pose_requirements import PoseRequirements, Reasons
from tau_dyn.mechanism import SLACK, BallJoints, Poses, find_ball_joints, unwind_turns

_BATCH = 20000  # poses at a time, tens of MB


class PoseCheck(NamedTuple):
    """Codes (N,) and positions (N, na) of poses; positions are nan where there are none."""

    code: np.ndarray
    q: np.ndarray


class PoseChecker:
    """Judges the poses of one robot by one set of demands."""

    def __init__(self, machine: WorkspaceModel, demands: PoseRequirements, reasons: Reasons | None = None) -> None:
        """Prepare; finds out what touches at home."""
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
        """Give the poses at `index` that are wrong their reason, unless they have one."""
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
            note(find_touched_obstacle(wall, _at(moving, left), len(left)), "obstacle", wall.name)
        for pair in self.pairs:
            left = np.flatnonzero(free)
            if len(left):
                some = {k: solids[k].take(left) for k in (pair.first, pair.second)}
                hit = np.broadcast_to(pair.touches(some, self.demands.clearance), len(left))
                note(hit, "collision", pair.name)


def _at(solids: list[PlacedSolid], index: np.ndarray) -> list[PlacedSolid]:
    return [solid.take(index) for solid in solids]


def _of_solver(reason: str) -> tuple[str, str]:
    """Return the kind of a reason that inverse kinematics gives, and its words where they say more."""
    if reason == "singular":
        return "singularity", "no inverse kinematics"
    if reason == "branch change":
        return "singularity", "beyond one, seen from home"
    return "out of reach", "" if reason in ("out of reach", "") else reason
