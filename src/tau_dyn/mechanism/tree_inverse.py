"""Inverse kinematics of a tree: Newton from home, along the way from home, and from many starts; see `tree_newton.py`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.mechanism.joint_limits import SLACK
from tau_dyn.mechanism.kinematics_result import BRANCH_CHANGE, NOT_A_NUMBER, OK, InverseResult
from tau_dyn.mechanism.plate_arrays import log_of
from tau_dyn.mechanism.poses import Poses
from tau_dyn.mechanism.tree_newton import TreeNewton
from tau_dyn.robot import Robot

_STARTS = 24  # starts drawn within the limits; a 6R arm has up to 16 solutions
_MAX_STARTS = 1500  # starts until every solution was met often enough; bounds the time of a pose
_MIN_TIMES_MET = 10  # times that each solution is met before the search ends; with 3 a quarter of UR5 poses lack one
_STARTS_LOOPS = 2  # closing loops from far away takes its time
_EQUALITY_TOLERANCE = 1e-6  # [m or rad] closer solutions are one
_MODE = 1e-6  # [m or 1] by how much forward kinematics may lead elsewhere

Maker = Callable[[TreeNewton, Poses], np.ndarray]
"""Makes starts (nv, N) for poses."""


def solve_tree_inverse(engine: TreeNewton, poses: Poses, start: np.ndarray | None, limits: bool) -> InverseResult:
    """Return positions from home or a start; where that fails or breaks a limit, from the way and from other starts."""
    robot, n = engine.robot, len(poses.position)
    first = np.repeat(robot.home[None], n, axis=0) if start is None else start
    found = _solved(engine, poses, engine.close_loops(first), first)
    tries: list[Maker] = [] if start is not None else [TreeNewton.way, *[_random(k) for k in range(_starts(robot))]]
    for attempt in tries:
        again = np.flatnonzero(~_fits(robot, found, limits) & (found.code != NOT_A_NUMBER))
        if not again.size:
            break
        part = poses.take(again)
        tried = _solved(engine, part, attempt(engine, part), first[again])
        better = _fits(robot, tried, limits) | (tried.ok & ~found.ok[again])
        found = _put(found, again[better], tried, better)
    return found


def find_tree_solutions(engine: TreeNewton, poses: Poses) -> np.ndarray:
    """Return distinct solutions (N, n, na) found from many starts, nearest to home first; nan fills up.

    Starts are drawn until each solution of each pose was met ten times, or to a limit: the chance of meeting a new one is
    about the share of those met once (Good 1953). It is no proof that none is left.
    """
    robot, n = engine.robot, len(poses.position)
    sets: list[list[np.ndarray]] = [[] for _ in range(n)]
    met: list[list[int]] = [[] for _ in range(n)]
    home = np.repeat(robot.home[None], n, axis=0)
    fewest, most = _starts(robot), _STARTS_LOOPS if robot.loops else _MAX_STARTS
    left = np.arange(n)
    for number in range(most + 1):
        part = poses.take(left)
        x = engine.close_loops(home[left]) if number == 0 else _random(number - 1)(engine, part)
        q = _solved(engine, part, x, home[left]).q
        for row in np.flatnonzero(np.isfinite(q[:, 0])):
            k = left[row]
            same = [i for i, known in enumerate(sets[k]) if np.abs(q[row] - known).max() <= _EQUALITY_TOLERANCE]
            if same:
                met[k][same[0]] += 1
            else:
                sets[k].append(q[row])
                met[k].append(1)
        if number >= fewest:
            left = np.array([k for k in left if sets[k] and min(met[k]) < _MIN_TIMES_MET], int)
            if not len(left):
                break
    out = np.full((n, max([1, *map(len, sets)]), robot.na), np.nan)
    for k, solutions in enumerate(sets):
        solutions.sort(key=lambda q: float(np.abs(q - robot.home).max()))
        for row, q in enumerate(solutions):
            out[k, row] = q
    return out


def _solved(engine: TreeNewton, poses: Poses, x: np.ndarray, toward: np.ndarray) -> InverseResult:
    robot = engine.robot
    q, code, error, rotation = engine.solve(poses, x, toward)
    for k, kind in enumerate(robot.joint_kinds):
        if kind == "revolute":
            q[:, k] = (q[:, k] - robot.home[k] + np.pi) % (2 * np.pi) - np.pi + robot.home[k]
    if robot.loops:
        code[(code == OK) & _elsewhere(engine, q, poses, error)] = BRANCH_CHANGE
    q[code != OK], rotation[code != OK] = np.nan, np.nan
    lost = np.where(code == OK, 1.0, np.nan)
    culprit = np.where(code == OK, "", " ".join(robot.actuated))
    return InverseResult(q, code, error[:, 0] * lost, error[:, 1] * lost, culprit, q, rotation)


def _elsewhere(engine: TreeNewton, q: np.ndarray, poses: Poses, error: np.ndarray) -> np.ndarray:
    """Return where the loops, closed in home's assembly mode, put the tool elsewhere (N,)."""
    back, _ = engine.engine.forward(q)
    turn = log_of(np.moveaxis(poses.rotation @ np.swapaxes(back.rotation, 1, 2), 0, 2))
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(back.position - poses.position, axis=1) < _MODE
        return ~(near & (np.abs(np.linalg.norm(turn, axis=0) - error[:, 1]) < _MODE))


def _random(k: int) -> Maker:
    """Return a maker of starts within the limits, the same every time."""

    def starts(engine: TreeNewton, poses: Poses) -> np.ndarray:
        robot = engine.robot
        low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - np.pi)
        high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + np.pi)
        one = np.random.default_rng(k).uniform(low, np.maximum(low, high))
        return np.repeat(engine.close_loops(one[None]), len(poses.position), axis=1)

    return starts


def _starts(robot: Robot) -> int:
    return _STARTS_LOOPS if robot.loops else _STARTS


def _fits(robot: Robot, found: InverseResult, limits: bool) -> np.ndarray:
    if not limits:
        return found.ok
    with np.errstate(invalid="ignore"):
        return found.ok & np.all((found.q >= robot.lower - SLACK) & (found.q <= robot.upper + SLACK), axis=1)


def _put(found: InverseResult, index: np.ndarray, tried: InverseResult, taken: np.ndarray) -> InverseResult:
    fields = []
    for name in ("q", "code", "position_error", "orientation_error", "culprit", "rotation"):
        old = getattr(found, name).copy()
        if old.dtype.kind == "U":
            old = old.astype(object)
        old[index] = getattr(tried, name)[taken]
        fields.append(old.astype(str) if old.dtype == object else old)
    q, code, position, orientation, culprit, rotation = fields
    return InverseResult(q, code, position, orientation, culprit, q, rotation)
