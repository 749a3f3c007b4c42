"""A serial arm, or a mechanism whose loops are solved by its tree, as its workspace needs it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from tau_dyn.kinematics.bodies import read_bodies
from tau_dyn.kinematics.collisions import PlacedSolid
from tau_dyn.kinematics.dexterity import Rates
from tau_dyn.kinematics.workspace.machine import InverseSolution, draw_positions, place_body
from tau_dyn.mechanism import (
    Poses,
    Rods,
    TreePose,
    build_kinematics,
    forward_kinematics,
    get_solver,
    inverse_kinematics,
)
from tau_dyn.robot import Robot

_WAVES = 300
"""Most waves in which a tree's inverse kinematics spreads from what is known."""


@dataclass(eq=False)
class _Start:
    """Positions found so far, to start the next ones nearby."""

    place: list[np.ndarray] = field(default_factory=list)
    q: list[np.ndarray] = field(default_factory=list)

    def add(self, place: np.ndarray, q: np.ndarray) -> None:
        if len(place):
            self.place.append(place)
            self.q.append(q)

    def near(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the nearest known places, and how far those are (N,) [m]."""
        away, index = cKDTree(np.concatenate(self.place)).query(place)
        return np.concatenate(self.q)[index], away


def _spacing(places: np.ndarray) -> float:
    """Return the distance [m] at which places (N, 3) stand from each other, inf for one alone."""
    if len(places) < 2:
        return np.inf
    away, _ = cKDTree(places).query(places[:2000] if len(places) > 2000 else places, k=2)
    return float(np.median(away[:, 1]))


class TreeMachine:
    """A serial arm, or a mechanism whose loops are solved by its tree."""

    def __init__(self, robot: Robot) -> None:
        """Prepare."""
        self.robot = robot
        self.rods: Rods | None = None
        self.home = forward_kinematics(robot, robot.home[None]).poses
        engine = get_solver(robot)
        assert isinstance(engine, TreePose)
        self._engine = engine
        self.bodies, self.meshes = read_bodies(robot)
        self._turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
        self._start, self._widest = _Start(), 0.0
        self._start.add(self.home.position, robot.home[None])
        self.length = 1.0
        J = self._jacobian(robot.home[None], self.home)[0][:, self._turns]
        if J.size and np.linalg.norm(J[3:]) > 1e-9:
            self.length = float(np.linalg.norm(J[:3]) / np.linalg.norm(J[3:])) or 1.0
        self._rows = _rows(self._jacobian(draw_positions(robot)[: 2 ** min(robot.na, 8) + 50], None), robot.na)
        square = len(self._rows) == robot.na
        at_home = self._jacobian(robot.home[None], self.home)[:, self._rows]
        self._sign = float(np.sign(np.linalg.det(at_home))[0]) if square else 0.0

    def _jacobian(self, q: np.ndarray, poses: Poses | None) -> np.ndarray:
        return build_kinematics(self.robot).jacobian(q, poses)

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions that are home's carried on from neighbour to neighbour, from home outwards."""
        n = len(poses.position)
        q, code = np.full((n, self.robot.na), np.nan), np.full(n, "out of reach", dtype=object)
        tried, turned = np.full(n, np.inf), 0.0
        if n > 1:
            self._widest = max(self._widest, _spacing(poses.position))
        reach = 2.0 * self._widest if n > 1 else np.inf
        for _ in range(_WAVES):
            lost = np.flatnonzero(code != "")
            start, away = self._start.near(poses.position[lost])
            go = (away < reach) & (away < 0.99 * tried[lost])
            if not go.any():
                break
            tried[lost[go]] = away[go]
            turned = max(turned, self._try(poses, lost[go], start[go], q, code))
        return InverseSolution(q, code == "", code, poses, turned)

    def _try(self, poses: Poses, index: np.ndarray, start: np.ndarray, q: np.ndarray, code: np.ndarray) -> float:
        """Solve some of the poses from known neighbours, write what was found, return how far the tool is turned."""
        here = Poses(poses.position[index], np.asarray(poses.rotation)[index])
        found = inverse_kinematics(self.robot, here, start=start, limits=False)
        same = found.ok.copy()
        if self._sign and same.any():
            rates = self.rates(found.q[same], here.take(same))
            same[same] = np.sign(np.linalg.det(rates.actuators)) == self._sign
        better = same | (found.ok & (code[index] == "out of reach"))
        q[index[better]] = found.q[better]
        code[index[better]] = np.where(same[better], "", "branch change")
        self._start.add(here.position[same], found.q[same])
        return float(np.max(found.orientation_error[same], initial=0.0))

    def holders(self, rod: int) -> list[int]:
        """Return nothing: a tree has no rods of its own."""
        return []

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the Jacobian as rates, `J_x = 1`; up to three actuators by the tool's translation alone."""
        J = self._jacobian(q, poses)[:, self._rows]
        one = np.broadcast_to(np.eye(len(self._rows)), (len(q), len(self._rows), len(self._rows))).copy()
        return Rates(one, J, self._turns, self.length)

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        at = self._engine.loops.close(q).at
        return [place_body(body, at) for body in self.bodies]

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box around the places that random positions reach, with room to every side."""
        found = forward_kinematics(self.robot, draw_positions(self.robot))
        place = found.poses.position[found.ok]
        low, high = place.min(axis=0), place.max(axis=0)
        room = 0.06 * (high - low)
        return low - room, high + room


def _rows(J: np.ndarray, na: int) -> list[int]:
    """Return which components of the twist are asked for: what the tool can do, of translations first."""
    J = J[np.isfinite(J).all(axis=(1, 2))]
    moves = [k for k in range(6) if np.abs(J[:, k]).max(initial=0.0) > 1e-9]
    linear = [k for k in moves if k < 3]
    return linear if na <= len(linear) or na <= 3 else list(range(6))
