r"""Assembly modes of a robot at given actuated positions.

Six rods on a free plate, three on a plate that keeps its orientation, any tree with loops, a serial arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.modes import AssemblyModes, find_assembly_modes
from tau_dyn.kinematics.assembly.tree_modes import search_tree_modes
from tau_dyn.mechanism import (
    Poses,
    Rods,
    TreePose,
    build_rods,
    convert_to_quaternions,
    forward_kinematics,
    get_cached,
    get_robot,
    get_rods,
    get_solver,
    require_positions,
)
from tau_dyn.robot import Robot

_FLAT = 1e-12
"""Squared height over the plane of the centres, as a share of the largest radius', below which the two modes may be one."""
_COINCIDENT_M = 1e-12
"""[m] Points nearer than this are one: a robot file's frames are composed with rounding errors of 1e-16."""
_HOME = 1e-6
"""[m], and of rotation matrices' entries: a mode this near to the answer of forward kinematics is home's."""


@dataclass(frozen=True, eq=False)
class RobotModes:
    """Real assembly modes of a robot at one set of actuated positions.

    Attributes:
        tool: Poses of the tool (m), nearest to home's mode first.
        home: Whether the first is home's mode, the one that `forward_kinematics` gives.
        proved: m is proved to be the number of real isolated modes.
        why: Why it is proved, or why not.
    """

    tool: Poses
    home: bool
    proved: bool
    why: str

    @property
    def names(self) -> list[str]:
        """Name each mode: `home`, else its number from 1."""
        return ["home" if self.home and k == 0 else str(k + 1) for k in range(self.tool.n_samples)]


def list_robot_modes(robot: Robot | Rods, q: np.ndarray) -> RobotModes:
    """Return every assembly mode that is found at actuated positions (na,) [m or rad]; joint limits are not looked at.

    Three rods on a translating plate and serial arms in closed form, six rods on a free plate by `find_assembly_modes`,
    anything else by `search_tree_modes`.

    Raises:
        InputError: `q` does not fit, or the robot has no tool frame.
    """
    q = require_positions(get_robot(robot), q)
    if len(q) != 1 or not np.isfinite(q).all():
        raise InputError("wrong_shape", f"modes are listed at one set of finite positions; these are {np.shape(q)}")
    rods = get_rods(robot)
    if rods is not None and rods.n == (3 if rods.translates else 6):
        tool, proved, why = _list_rod_modes(rods, q)
    elif not get_robot(robot).loops:
        tool, proved, why = forward_kinematics(robot, q).poses, True, "a tree without loops has one pose"
    else:
        found = search_tree_modes(_tree(robot), q[0])
        why = f"{found.n_starts} starts of Newton's method; no bound on the number of modes is known"
        why += f"; {found.n_singular} singular solutions are left out" if found.n_singular else ""
        tool, proved = found.tool, False
    return _home_first(robot, q, tool, proved, why)


def _list_rod_modes(rods: Rods, q: np.ndarray) -> tuple[Poses, bool, str]:
    """Return real modes of the tool, whether they are proved to be all, and why."""
    try:
        modes = find_robot_assembly_modes(rods, q)
    except InputError as fault:
        if fault.code != "unsupported":
            raise
        return Poses(np.zeros((0, 3)), np.zeros((0, 3, 3))), False, str(fault)
    complex_ones = len(modes.real) - modes.n_real
    return (
        rods.tool_poses(select_real_poses(modes)),
        modes.certified,
        f"{modes.why}; {modes.n_real} real, {complex_ones} complex",
    )


def _tree(robot: Robot | Rods) -> TreePose:
    """Return the solver by the joints of the tree, also of a robot that has rods."""
    engine = get_solver(robot)
    if isinstance(engine, TreePose):
        return engine
    return get_cached(get_robot(robot), "tree modes", lambda: TreePose(get_robot(robot)))


def _home_first(robot: Robot | Rods, q: np.ndarray, tool: Poses, proved: bool, why: str) -> RobotModes:
    """Sort modes by their distance from home's, which counts turns [rad] as metres."""
    nominal = forward_kinematics(robot, q)
    there = nominal.poses
    if not nominal.ok[0]:
        there = forward_kinematics(robot, get_robot(robot).home[None]).poses
    away = np.linalg.norm(tool.position - there.position, axis=1)
    turned = np.abs(tool.rotation - there.rotation).max(axis=(1, 2), initial=0.0)
    order = np.argsort(np.round(away + turned, 9), kind="stable")
    home = bool(nominal.ok[0] and len(order) and max(away[order[0]], turned[order[0]]) < _HOME)
    return RobotModes(tool.take(order), home, proved, why)


def find_robot_assembly_modes(robot: Robot | Rods, q: np.ndarray) -> AssemblyModes:
    """Return all poses of a robot's plate at one set of actuated positions.

    Args:
        robot: The robot, or its rods.
        q: Actuated positions (na,) [m or rad].

    Raises:
        NotRods: The mechanism is not one of rods between points.
        InputError: Its number of rods is not six (free plate) or three (plate that translates), or `q` does not fit.
    """
    rods = robot if isinstance(robot, Rods) else build_rods(robot)
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
    """Return points (n, 3) [m], those that rounding alone keeps apart as one: shared ends have smaller proven bounds."""
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
        rotation: The plate's (3, 3).
    """
    centres = base - plate @ rotation.T
    u, w = centres[1] - centres[0], centres[2] - centres[0]
    normal = np.cross(u, w)
    area = normal @ normal
    if area <= 1e-24 * (u @ u) * (w @ w) or area == 0:
        raise InputError(
            "unsupported",
            "the spheres' centres stand in one line, so the plate is free to go round it: infinitely many modes",
        )
    square = lengths**2
    p, r = 0.5 * (u @ u + square[0] - square[1]), 0.5 * (w @ w + square[0] - square[2])
    foot = (p * np.cross(w, normal) + r * np.cross(normal, u)) / area
    height = square[0] - foot @ foot
    offset = np.sqrt(complex(height) / area) * normal
    position = np.array([centres[0] + foot + offset, centres[0] + foot - offset])
    gaps = position[:, None] - centres
    residual = np.abs(np.sqrt((gaps * gaps).sum(axis=2)) - lengths).max(axis=1)
    flat = abs(height) <= _FLAT * square.max()
    why = "three spheres meet in two points" + ("; here the two are closer than rounding can tell" if flat else "")
    quaternion = convert_to_quaternions(Poses(np.zeros((1, 3)), rotation[None]))
    return AssemblyModes(
        position=position,
        quaternion=np.tile(quaternion, (2, 1)).astype(complex),
        rotation=np.tile(rotation, (2, 1, 1)).astype(complex),
        real=np.full(2, height >= 0 and not flat),
        residual=residual,
        radius=np.full(2, np.finfo(float).eps * square.max() / max(abs(height), 1e-300)),
        n_no_pose=0,
        n_singular=2 if flat else 0,
        certified=not flat,
        why=why,
    )


def select_real_poses(modes: AssemblyModes) -> Poses:
    """Return the real modes as poses of the plate."""
    return Poses(modes.position[modes.real].real, modes.rotation[modes.real].real)
