"""Inverse kinematics of a tree: Newton from home, along the way from home, and from many starts; see `tree_pose.py`."""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.outcome import NOT_A_NUMBER, OK, Inverse
from tau_dyn.kinematics.plate_arrays import log_of, turned_by
from tau_dyn.kinematics.poses import Poses
from tau_dyn.kinematics.tree_pose import TreePose
from tau_dyn.robot import Robot

_STARTS = 24
_STARTS_LOOPS = 2  # closing loops from far away takes its time
_SAME = 1e-6  # [m or rad] closer solutions are one
_STEPS = 12  # on the way from home


def tree_inverse(engine: object, robot: Robot, poses: Poses, start: np.ndarray | None, limits: bool) -> Inverse:
    """Return positions from home or a start; where that fails or breaks a limit, from the way and from other starts."""
    assert isinstance(engine, TreePose)
    n = len(poses.position)
    first = np.repeat(robot.home[None], n, axis=0) if start is None else start
    found = _solved(engine, robot, poses, first)
    if start is None:
        tries = [_way, *[_random(k) for k in range(_starts(robot))]]
        for attempt in tries:
            again = np.flatnonzero(~_fits(robot, found, limits) & (found.code != NOT_A_NUMBER))
            if not again.size:
                break
            part = poses.take(again)
            tried = _solved(engine, robot, part, attempt(engine, robot, part))
            better = _fits(robot, tried, limits) | (tried.ok & ~found.ok[again])
            found = _put(found, again[better], tried, better)
    return found


def tree_solutions(engine: object, robot: Robot, poses: Poses) -> np.ndarray:
    """Return distinct solutions (N, n, na) found from many starts, nearest to home first; nan fills up."""
    assert isinstance(engine, TreePose)
    n = len(poses.position)
    sets: list[list[np.ndarray]] = [[] for _ in range(n)]
    starts = [
        np.repeat(robot.home[None], n, axis=0),
        *[_random(k)(engine, robot, poses) for k in range(_starts(robot))],
    ]
    for start in starts:
        q = _solved(engine, robot, poses, start).q
        for k in np.flatnonzero(np.isfinite(q[:, 0])):
            if all(np.abs(q[k] - known).max() > _SAME for known in sets[k]):
                sets[k].append(q[k])
    out = np.full((n, max([1, *map(len, sets)]), robot.na), np.nan)
    for k, solutions in enumerate(sets):
        solutions.sort(key=lambda q: float(np.abs(q - robot.home).max()))
        for row, q in enumerate(solutions):
            out[k, row] = q
    return out


def _solved(engine: TreePose, robot: Robot, poses: Poses, start: np.ndarray) -> Inverse:
    q, code, position, orientation = engine.inverse(poses, start)
    for k, kind in enumerate(robot.joint_kinds):
        if kind == "revolute":
            q[:, k] = (q[:, k] - robot.home[k] + np.pi) % (2 * np.pi) - np.pi + robot.home[k]
    lost = np.where(code == OK, 1.0, np.nan)
    culprit = np.where(code == OK, "", " ".join(robot.actuated))
    return Inverse(q, code, position * lost, orientation * lost, culprit, q)


def _way(engine: TreePose, robot: Robot, poses: Poses) -> np.ndarray:
    """Return where the straight way from home leads (N, na)."""
    home, _ = engine.forward(robot.home[None])
    n = len(poses.position)
    turn = np.nan_to_num(log_of(np.moveaxis(poses.rotation @ home.rotation[0].T, 0, 2)))
    base = np.repeat(np.moveaxis(home.rotation, 0, 2), n, axis=2)
    q = np.repeat(robot.home[None], n, axis=0)
    for share in np.linspace(0, 1, _STEPS + 1)[1:-1]:
        here = Poses(
            home.position + share * (poses.position - home.position),
            np.moveaxis(turned_by(share * turn, base), 2, 0),
        )
        step = engine.inverse(here, q)[0]
        q = np.where(np.isfinite(step), step, q)
    return q


def _random(k: int):
    """Return a maker of starts within the limits, the same every time."""

    def starts(engine: TreePose, robot: Robot, poses: Poses) -> np.ndarray:
        low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - np.pi)
        high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + np.pi)
        one = np.random.default_rng(k).uniform(low, np.maximum(low, high))
        return np.repeat(one[None], len(poses.position), axis=0)

    return starts


def _starts(robot: Robot) -> int:
    return _STARTS_LOOPS if robot.loops else _STARTS


def _fits(robot: Robot, found: Inverse, limits: bool) -> np.ndarray:
    if not limits:
        return found.ok
    with np.errstate(invalid="ignore"):
        return found.ok & np.all((found.q >= robot.lower - 1e-9) & (found.q <= robot.upper + 1e-9), axis=1)


def _put(found: Inverse, index: np.ndarray, tried: Inverse, taken: np.ndarray) -> Inverse:
    fields = []
    for name in ("q", "code", "position_error", "orientation_error", "culprit"):
        old = getattr(found, name).copy()
        if old.dtype.kind == "U":
            old = old.astype(object)
        old[index] = getattr(tried, name)[taken]
        fields.append(old.astype(str) if old.dtype == object else old)
    q, code, position, orientation, culprit = fields
    return Inverse(q, code, position, orientation, culprit, q)
