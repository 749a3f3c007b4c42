"""Assembly modes of a robot at given actuated positions.

All modes of six rods on a free plate, of three rods on a plate that keeps its orientation and of serial arms are found in closed
form or by homotopy. For any other tree with loops, the loops `c(x_p) = 0` are solved for the passive joints by damped
Gauss-Newton steps

    (J_p' J_p + mu 1) dx = -J_p' c,   mu proportional to |c|^2  (Yamashita & Fukushima 2001),

from starts drawn within the joints' limits. Two solutions are one mode if the tool's pose, the joints' origins and the points
in which loops close agree. Starts are drawn until each mode was found ten times: the probability of a new mode is about the
share of modes found once (Good 1953). This does not prove that the list is complete.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.modes import AssemblyModes, find_assembly_modes
from tau_dyn.mechanism import (
    Frames,
    Kinematics,
    Move,
    NewtonRules,
    Poses,
    Rods,
    TreePose,
    build_kinematics,
    build_rods,
    compute_frames,
    convert_to_quaternions,
    get_cached,
    get_robot,
    get_rods,
    intersect_spheres,
    iterate_newton,
    require_positions,
)
from tau_dyn.robot import Robot

_BATCH = 100  # starts at a time
_MAX_STARTS = 3000  # of one set of actuated positions
_MIN_TIMES_MET = 10  # of each mode before the search ends, as `tree_inverse.py`
_MAX_MODES = 200  # more are a continuum
_DAMPING = 1e-2  # of the squared gap, by that of the largest entry of J_p
_RULES = NewtonRules(60, 60, 0.5, 1e-10, 1e-10)  # nearly all starts that arrive do within 40 steps [m or rad]
_EQUALITY_TOLERANCE = 1e-6  # [m] and of rotation matrices' entries
_REGULAR = 1e-7  # singular value relative to the largest below which a passive motion leaves the loops closed
_SLIDE = 2.0  # [m] range of a passive slide without limits
_UNLIMITED = 1e5  # [m] a limit beyond this counts as unlimited


class TreeModes(NamedTuple):
    """Modes found at one set of actuated positions.

    Attributes:
        tool: Poses of the tool (m).
        n_starts: Starts tried.
        n_singular: Distinct solutions dropped, in which passive joints move while the actuators are at rest.
    """

    tool: Poses
    n_starts: int
    n_singular: int


def search_tree_modes(engine: TreePose, q: np.ndarray, *, seed: int = 0) -> TreeModes:
    """Return the modes that many starts find.

    Args:
        engine: The robot, with at least one loop.
        q: Actuated positions (na,) [m or rad].
        seed: Seed of the starts.
    """
    rng, passive = np.random.default_rng(seed), engine.loops.passive
    rank = _rank(engine, engine.loops.close(engine.robot.home[None]).x)[0]
    signs: list[np.ndarray] = []
    met: list[int] = []
    regular: list[bool] = []
    poses: list[Poses] = []
    n_starts = 0
    while n_starts < _MAX_STARTS and len(signs) < _MAX_MODES:
        x = np.empty((engine.robot.model.nv, _BATCH))
        x[engine.loops.active] = (engine.loops.scale * q)[:, None]
        x[passive] = _draw_starts(engine, rng)
        x = _close(engine, x)
        n_starts += _BATCH
        at = compute_frames(engine.joints, x)
        tool, ranks = engine.pose_of(at), _rank(engine, x)
        for k, sign in enumerate(_signatures(engine, at, tool)):
            same = next((i for i, s in enumerate(signs) if np.abs(s - sign).max() < _EQUALITY_TOLERANCE), None)
            if same is None:
                signs.append(sign)
                met.append(1)
                regular.append(bool(ranks[k] >= rank))
                poses.append(tool.take(slice(k, k + 1)))
            else:
                met[same] += 1
        if not signs or min(met) >= _MIN_TIMES_MET:
            if n_starts >= 2 * _BATCH:
                break
    kept = [p for p, ok in zip(poses, regular, strict=True) if ok]
    return TreeModes(Poses.join(kept), n_starts, len(poses) - len(kept))


def _draw_starts(engine: TreePose, rng: np.random.Generator) -> np.ndarray:
    """Draw passive positions (n_passive, batch): slides within their limits, turning joints over a whole turn."""
    model, rows = engine.robot.model, {joint.v: joint for joint in engine.joints}
    out = np.empty((len(engine.loops.passive), _BATCH))
    for row, v in enumerate(engine.loops.passive):
        low, high = -np.pi, np.pi
        if rows[int(v)].slides:
            at = model.joints[rows[int(v)].index].idx_q
            ends = model.lowerPositionLimit[at], model.upperPositionLimit[at]
            low, high = (e if abs(e) < _UNLIMITED else s * _SLIDE / 2 for e, s in zip(ends, (-1, 1), strict=True))
        out[row] = rng.uniform(low, max(high, low), _BATCH)
    return out


def _close(engine: TreePose, x: np.ndarray) -> np.ndarray:
    """Return the columns of positions (nv, N) for which Newton's method closed the loops."""
    x, passive = x.copy(), engine.loops.passive

    def advance(left: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
        at = compute_frames(engine.joints, x[:, left])
        gap, J = engine.loops.gap(at).T, engine.loops.jacobian(at)
        square = np.einsum("nij,nij->n", J, J)
        JT = np.swapaxes(J, 1, 2)
        damping = np.maximum(_DAMPING * np.sum(gap**2, axis=1), 1e-14 * square)
        normal = JT @ J + damping[:, None, None] * np.eye(len(passive))
        step = -np.linalg.solve(normal, JT @ gap[:, :, None])[:, :, 0]

        def move(share: np.ndarray) -> None:
            x[np.ix_(passive, left)] += (share[:, None] * step).T

        return np.abs(gap).max(axis=1), np.abs(step).max(axis=1), move

    return x[:, iterate_newton(np.ones(x.shape[1], bool), advance, _RULES)]


def _rank(engine: TreePose, x: np.ndarray) -> np.ndarray:
    """Return the rank (N,) of the loops' Jacobian by the passive joints at positions (nv, N)."""
    if not x.shape[1]:
        return np.zeros(0, int)
    s = np.linalg.svd(engine.loops.jacobian(compute_frames(engine.joints, x)), compute_uv=False)
    return np.sum(s > _REGULAR * s.max(axis=1, keepdims=True), axis=1)


def _signatures(engine: TreePose, at: Frames, tool: Poses) -> np.ndarray:
    """Return the numbers that distinguish modes (N, k): the tool's pose, the joints' origins, the points where loops close."""
    n = len(tool.position)
    origins = [np.broadcast_to(at.origin[joint.index], (3, n)).T for joint in engine.joints]
    ends = [np.broadcast_to(point, (3, n)).T for point in engine.loops.closing_points(at)]
    return np.concatenate([tool.position, tool.rotation.reshape(n, 9), *origins, *ends], axis=1)


_FLAT = 1e-12
"""Squared height over the plane of the centres, as a share of the largest radius', below which the two modes may be one."""
_COINCIDENT_M = 1e-12
"""[m] Points nearer than this count as equal: a robot file's frames are composed with rounding errors of 1e-16."""
_HOME = 1e-6
"""[m], and of rotation matrices' entries: a mode this near to the result of forward kinematics is home's."""


@dataclass(frozen=True, eq=False)
class RobotModes:
    """Real assembly modes of a robot at one set of actuated positions.

    Attributes:
        tool: Poses of the tool (m), nearest to home's mode first.
        home: Whether the first is home's mode, the one that `forward_kinematics` gives.
        proved: m is proved to be the number of real isolated modes.
        why: Reason why it is proved, or not.
    """

    tool: Poses
    home: bool
    proved: bool
    why: str

    @property
    def names(self) -> list[str]:
        """Name each mode: `home`, else its number from 1."""
        return ["home" if self.home and k == 0 else str(k + 1) for k in range(self.tool.n_samples)]


def list_robot_modes(robot: Robot | Kinematics, q: np.ndarray) -> RobotModes:
    """Return every assembly mode that is found at actuated positions (na,) [m or rad]; joint limits are ignored.

    Three rods on a translating plate and serial arms are solved in closed form, six rods on a free plate by
    `find_assembly_modes`, all other robots by `search_tree_modes`.

    Raises:
        InputError: `q` does not fit, or the robot has no tool frame.
    """
    q = require_positions(get_robot(robot), q)
    if len(q) != 1 or not np.isfinite(q).all():
        raise InputError("wrong_shape", f"modes are listed at one set of finite positions; these are {np.shape(q)}")
    kinematics = build_kinematics(robot)
    legs, owner = get_rods(kinematics), kinematics.robot
    if legs is not None and legs.n == (3 if legs.translates else 6):
        tool, proved, why = _list_leg_modes(legs, q)
    elif not owner.loops:
        tool, proved, why = kinematics.forward(q).poses, True, "a tree without loops has one pose"
    else:
        found = search_tree_modes(get_cached(owner, "tree modes", lambda: TreePose(owner)), q[0])
        why = f"{found.n_starts} starts of Newton's method; no bound on the number of modes is known"
        why += f"; {found.n_singular} singular solutions are left out" if found.n_singular else ""
        tool, proved = found.tool, False
    return _home_first(kinematics, q, tool, proved, why)


def _list_leg_modes(legs: Rods, q: np.ndarray) -> tuple[Poses, bool, str]:
    """Return real modes of the tool, whether they are proved to be all, and why."""
    try:
        modes = find_robot_assembly_modes(legs, q)
    except InputError as fault:
        if fault.code != "unsupported":
            raise
        return Poses.join([]), False, str(fault)
    complex_ones = len(modes.real) - modes.n_real
    return (
        legs.tool_poses(select_real_poses(modes)),
        modes.certified,
        f"{modes.why}; {modes.n_real} real, {complex_ones} complex",
    )


def _home_first(kinematics: Kinematics, q: np.ndarray, tool: Poses, proved: bool, why: str) -> RobotModes:
    """Sort modes by their distance from home's mode, in which rotations [rad] count as metres."""
    nominal = kinematics.forward(q)
    there = nominal.poses if nominal.ok[0] else kinematics.commanded.home
    away = np.linalg.norm(tool.position - there.position, axis=1)
    turned = np.abs(tool.rotation - there.rotation).max(axis=(1, 2), initial=0.0)
    order = np.argsort(np.round(away + turned, 9), kind="stable")
    home = bool(nominal.ok[0] and len(order) and max(away[order[0]], turned[order[0]]) < _HOME)
    return RobotModes(tool.take(order), home, proved, why)


def find_robot_assembly_modes(robot: Robot | Kinematics, q: np.ndarray) -> AssemblyModes:
    """Return all poses of a robot's plate at one set of actuated positions.

    Args:
        robot: The robot, or its kinematics.
        q: Actuated positions (na,) [m or rad].

    Raises:
        NotRods: The mechanism is not one of rods between points.
        InputError: Its number of rods is not six (free plate) or three (plate that translates), or `q` does not fit.
    """
    legs = build_kinematics(robot).legs
    rods = build_rods(get_robot(robot)) if legs is None else legs  # raises with the missing part
    q = require_positions(rods.robot, q)
    if len(q) != 1 or not np.isfinite(q).all():
        raise InputError(
            "wrong_shape", f"assembly modes are found at one set of finite positions; these are {np.shape(q)}"
        )
    A, L = rods.base_points(q)[0], rods.leg_lengths(q)[0]
    if rods.translates and rods.n == 3:
        return find_translating_modes(A, rods.on_plate, L, rods.rotation)
    if rods.translates or rods.n != 6:
        kind = "translates" if rods.translates else "is free"
        raise InputError(
            "unsupported",
            "assembly modes need six rods on a free plate or three on one that translates; "
            f"{rods.robot.source} has {rods.n} on a plate that {kind}",
        )
    return find_assembly_modes(_merge_points(A), _merge_points(rods.on_plate), L)


def _merge_points(points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) [m]; points that differ only by rounding become equal: shared ends have smaller proven bounds."""
    near = np.abs(points[:, None] - points).max(axis=2) < _COINCIDENT_M
    return points[near.argmax(axis=1)]


def find_translating_modes(
    base: np.ndarray, plate: np.ndarray, lengths: np.ndarray, rotation: np.ndarray
) -> AssemblyModes:
    """Return the two points where three spheres meet (thesis 4.9), real or a conjugate pair.

    Args:
        base: A (3, 3) [m].
        plate: B in the plate's frame (3, 3) [m].
        lengths: L (3,) [m].
        rotation: Rotation of the plate (3, 3).
    """
    centres = base - plate @ rotation.T
    u, w = centres[1] - centres[0], centres[2] - centres[0]
    area = np.sum(np.cross(u, w) ** 2)
    if area <= 1e-24 * (u @ u) * (w @ w) or area == 0:
        raise InputError(
            "unsupported",
            "the spheres' centres are on one line, so the plate is free to turn about it: infinitely many modes",
        )
    square = lengths**2
    points = [intersect_spheres(centres[:, :, None].astype(complex), square[:, None], side) for side in (1.0, -1.0)]
    position, height = np.stack([x.position[:, 0] for x in points]), float(points[0].height[0].real)
    gaps = position[:, None] - centres
    residual = np.abs(np.sqrt((gaps * gaps).sum(axis=2)) - lengths).max(axis=1)
    flat = abs(height) <= _FLAT
    why = "three spheres meet in two points" + ("; here the two are closer than rounding can separate" if flat else "")
    quaternion = convert_to_quaternions(Poses(np.zeros((1, 3)), rotation[None]))
    return AssemblyModes(
        position=position,
        quaternion=np.tile(quaternion, (2, 1)).astype(complex),
        rotation=np.tile(rotation, (2, 1, 1)).astype(complex),
        real=np.full(2, height >= 0 and not flat),
        residual=residual,
        radius=np.full(2, np.finfo(float).eps / max(abs(height), 1e-300)),
        n_no_pose=0,
        n_singular=2 if flat else 0,
        certified=not flat,
        why=why,
    )


def select_real_poses(modes: AssemblyModes) -> Poses:
    """Return the real modes as poses of the plate."""
    return Poses(modes.position[modes.real].real, modes.rotation[modes.real].real)
