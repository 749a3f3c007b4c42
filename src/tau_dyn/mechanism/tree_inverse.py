"""Inverse kinematics of a tree: Newton from home, along the way and from many starts (`tree_pose.py`); all of a 6R arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from tau_dyn.mechanism.frames import complete_axis
from tau_dyn.mechanism.poses import (
    BRANCH_CHANGE,
    NOT_A_NUMBER,
    OK,
    SLACK,
    InverseResult,
    InverseSolutions,
    Poses,
    measure_turns,
)
from tau_dyn.mechanism.six_revolute import MAX_SOLUTIONS, eliminate
from tau_dyn.mechanism.tree_pose import TreeNewton
from tau_dyn.robot import Robot

_STARTS = 24  # starts drawn within the limits
_MAX_STARTS = 1500  # starts until every solution was met often enough; bounds the time of a pose
_MIN_TIMES_MET = 10  # times that each solution is met before the search ends; with 3 a quarter of UR5 poses lack one
_STARTS_LOOPS = 2  # closing loops from far away takes its time
_MOVED = 1e-2  # [rad] largest motion by Newton's method from the result of an elimination
_SINGULAR = 1e-6  # singular value of the Jacobian relative to the largest; less, and there may be a continuum
_ELIMINATED = "by elimination to an eigenvalue problem"
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


def find_tree_solutions(engine: TreeNewton, poses: Poses) -> InverseSolutions:
    """Return all solutions, nearest to home first: of six turning joints by elimination, else from many starts.

    Starts are drawn until each solution of each pose was met ten times, or to a limit: the probability of a new one is about
    the share of those met once (Good 1953). This does not prove that all are found.
    """
    robot, n = engine.robot, len(poses.position)
    sets: list[list[np.ndarray]] = [[] for _ in range(n)]
    proved, why = np.zeros(n, bool), ["from many starts"] * n
    six = _place_six_joints(engine)
    if six is not None:
        for k in np.flatnonzero(np.isfinite(poses.position).all(axis=1) & np.isfinite(poses.rotation).all(axis=(1, 2))):
            sets[k], doubt = _eliminate(engine, six, poses.take(slice(k, k + 1)))
            proved[k], why[k] = not doubt, f"from many starts: {doubt}" if doubt else _ELIMINATED
    _search(engine, poses, sets, np.flatnonzero(~proved), MAX_SOLUTIONS if six is not None else None)
    out = np.full((n, max([1, *map(len, sets)]), robot.na), np.nan)
    for k, solutions in enumerate(sets):
        if six is not None and len(solutions) > MAX_SOLUTIONS:
            why[k] = f"from many starts: more than {MAX_SOLUTIONS}, so some form a continuum"
        solutions.sort(key=lambda q: float(np.abs(q - robot.home).max()))
        for row, q in enumerate(solutions):
            out[k, row] = q
    return InverseSolutions(out, proved, why)


def _search(
    engine: TreeNewton, poses: Poses, sets: list[list[np.ndarray]], left: np.ndarray, enough: int | None
) -> None:
    """Add the solutions found from many starts to the sets of poses `left`; stop at `enough`."""
    robot = engine.robot
    met = [[0] * len(known) for known in sets]
    home = np.repeat(robot.home[None], len(sets), axis=0)
    fewest, most = _starts(robot), _STARTS_LOOPS if robot.loops else _MAX_STARTS
    for number in range(most + 1):
        if not len(left):
            break
        part = poses.take(left)
        x = engine.close_loops(home[left]) if number == 0 else _random(number - 1)(engine, part)
        q = _solved(engine, part, x, home[left]).q
        for row in np.flatnonzero(np.isfinite(q[:, 0])):
            k = left[row]
            same = _index_of(robot, q[row], sets[k])
            if same is None:
                sets[k].append(q[row])
                met[k].append(1)
            else:
                met[k][same] += 1
        if number >= fewest:
            left = np.array([k for k in left if sets[k] and min(met[k]) < _MIN_TIMES_MET], int)
        if enough is not None:
            left = np.array([k for k in left if len(sets[k]) <= enough], int)


def _place_six_joints(engine: TreeNewton) -> np.ndarray | None:
    """Return the placements (7, 4, 4) between world, six turning joints about z and tool; None of other chains."""
    robot, carriers = engine.robot, engine.engine.carriers
    driven = set(np.asarray(robot.active_v).tolist())
    if robot.loops or len(carriers) != 6 or any(joint.slides or joint.v not in driven for joint in carriers):
        return None
    tool = engine.engine.tool
    about_z = [_place(np.eye(3)), *(_place(complete_axis(joint.axis)) for joint in carriers), _place(np.eye(3))]
    places = [*(_place(j.rotation, j.offset) for j in carriers), _place(tool.rotation, tool.translation)]
    return np.stack([np.linalg.inv(about_z[k]) @ place @ about_z[k + 1] for k, place in enumerate(places)])


def _place(rotation: np.ndarray, offset: np.ndarray | None = None) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3] = rotation
    if offset is not None:
        X[:3, 3] = offset
    return X


def _eliminate(engine: TreeNewton, six: np.ndarray, pose: Poses) -> tuple[list[np.ndarray], str]:
    """Return the solutions (na,) of one pose that eliminations find, and why some may be missing, '' if all are found."""
    wanted = _place(pose.rotation[0], pose.position[0])
    G = np.concatenate([(six[6] @ np.linalg.inv(wanted) @ six[0])[None], six[1:6]])
    found: list[np.ndarray] = []
    doubt = "the elimination is singular"
    for candidates in eliminate(G):
        refined, why = _refine(engine, pose, candidates.q)
        found += [q for q in refined if _index_of(engine.robot, q, found) is None]
        missing = len(refined) < max(candidates.needed, len(found))
        doubt = candidates.doubt or why or ("fewer solutions than eigenvalues" if missing else "")
        if not doubt:
            break
    return found, "joints move while the tool rests" if engine.idle else doubt


def _refine(engine: TreeNewton, pose: Poses, angles: np.ndarray) -> tuple[list[np.ndarray], str]:
    """Return the solutions (na,) at candidates (m, 6), and a doubt where one leads elsewhere or is singular."""
    robot, m = engine.robot, len(angles)
    if not m:
        return [], ""
    x = np.repeat(engine.home, m, axis=1)
    x[[joint.v for joint in engine.engine.carriers]] = angles.T
    many = Poses(np.repeat(pose.position, m, axis=0), np.repeat(pose.rotation, m, axis=0))
    q = _solved(engine, many, x, np.repeat(robot.home[None], m, axis=0)).q
    solutions: list[np.ndarray] = []
    doubt = ""
    for row, start in zip(q, x[robot.active_v].T, strict=True):
        if not np.isfinite(row).all() or np.abs(_unwrapped(robot, row - start)).max() > _MOVED:
            doubt = "a solution is too close to complex ones"
        elif _index_of(robot, row, solutions) is None:
            solutions.append(row)
    if solutions:
        J = engine.engine.jacobian(engine.engine.loops.close(np.array(solutions)))
        J = J[:, :, [robot.active_v.tolist().index(joint.v) for joint in engine.engine.carriers]]
        J[:, :3] /= max(np.abs(J[:, :3]).max(), 1e-300)
        s = np.linalg.svd(J, compute_uv=False)
        if (s[:, -1] < _SINGULAR * s[:, 0]).any():
            doubt = "a solution is singular, others may be joined to it"
        elif np.sign(np.linalg.det(J)).sum() != 0:  # the map from angles to poses is no cover: its degree is zero
            doubt = "the signs of the Jacobian's determinant do not cancel"
    return solutions, doubt


def _index_of(robot: Robot, q: np.ndarray, known: list[np.ndarray]) -> int | None:
    """Return the index of the known solution that equals positions (na,) up to whole turns, or None."""
    return next((i for i, x in enumerate(known) if np.abs(_unwrapped(robot, q - x)).max() <= _EQUALITY_TOLERANCE), None)


def _unwrapped(robot: Robot, away: np.ndarray) -> np.ndarray:
    """Return differences of positions (na,) with whole turns taken out."""
    turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
    return np.where(turns, (away + np.pi) % (2 * np.pi) - np.pi, away)


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
    turn = measure_turns(poses.rotation, back.rotation)
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(back.position - poses.position, axis=1) < _MODE
        return ~(near & (np.abs(np.linalg.norm(turn, axis=1) - error[:, 1]) < _MODE))


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
    """Return results with those at `index` replaced by the `taken` results of `tried`."""
    both = {}
    for field in fields(found):
        old, new = getattr(found, field.name), getattr(tried, field.name)
        both[field.name] = old.astype(np.promote_types(old.dtype, new.dtype))  # names may be longer
        both[field.name][index] = new[taken]
    return InverseResult(**both)
