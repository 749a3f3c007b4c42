r"""How the tool moves with the actuators: velocity, acceleration, and how near a singularity is.

The gaps `g_k = |A_k - B_k| - L_k` stay zero, so with their derivatives `G_x` by the tool's twist and `G_q` by the
positions

    G_x V + G_q v = 0,   V = J v,   J = -G_x^+ G_q,   dV/dt = J a + b(q, v).

`G_x` loses rank in a parallel (second kind) singularity, `G_q` in a serial (first kind) one: Gosselin & Angeles 1990;
Merlet 2006, ch. 5 and 6. Twists are linear first, in world axes, at the tool's origin; a translating plate has the linear
half alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import chains
from tau_dyn.mechanism.forward import forward_kinematics
from tau_dyn.mechanism.plate_arrays import solve_with_lapack
from tau_dyn.mechanism.poses import Poses, require_poses
from tau_dyn.mechanism.positions import require_positions
from tau_dyn.mechanism.rods import Rods
from tau_dyn.mechanism.solvers import get_robot, get_rods, get_solver
from tau_dyn.mechanism.tree_pose import TreePose
from tau_dyn.robot import Robot


class Singularity(NamedTuple):
    """How far from singular, each (N,): 1 is as far as can be, 0 is there.

    Attributes:
        parallel: Smallest singular value of `G_x` by the largest, angles taken at the plate's radius (root mean square of |B|):
            the actuators lose hold of the plate.
        serial: The same of `G_q`, each column by the fastest point that its actuator moves: an actuator no longer moves
            the plate.
    """

    parallel: np.ndarray
    serial: np.ndarray


def jacobian(robot: Robot | Rods, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
    """Return `J`: the tool's twist per actuated velocity.

    Args:
        robot: A robot or its rods.
        q: Actuated positions (N, na).
        poses: Poses of the tool there (N); by default those of forward kinematics. A tree takes its own.

    Returns:
        (N, 6, na), linear first; (N, 3, na) for a plate that only translates. nan where there is no pose.
    """
    rods, q = get_rods(robot), require_positions(get_robot(robot), q)
    if rods is None:
        return _of_tree(robot, q)
    plate = _plate(rods, q, poses)
    return -_solved(_by_tool(rods, q, plate), rods.gap_by_q(q, plate))


def compute_inverse_jacobian(robot: Robot | Rods, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
    """Return `G_x`: how fast each gap opens per tool twist, (N, n rods, 6), or (N, n rods, 3) for a translating plate.

    For the legs of a Stewart platform this is the inverse Jacobian but for the sign; rods on carts need `gap_by_q` too:
    `gap_by_q v = -G_x V`.

    Raises:
        InputError: The robot has no rods.
    """
    rods, q = get_rods(robot), require_positions(get_robot(robot), q)
    if rods is None:
        raise InputError("unsupported", f"{get_robot(robot).source}: has no rods; invert its Jacobian instead")
    return _by_tool(rods, q, _plate(rods, q, poses))


def compute_acceleration_bias(
    robot: Robot | Rods, q: np.ndarray, v: np.ndarray, poses: Poses | None = None
) -> np.ndarray:
    """Return the tool's acceleration (N, 6 or 3) at actuated velocities `v` (N, na) without actuated acceleration: `dJ/dt v`."""
    rods, q = get_rods(robot), require_positions(get_robot(robot), q)
    v = require_positions(get_robot(robot), v)
    if len(v) != len(q):
        raise InputError("wrong_shape", f"as many velocities as positions are needed, not {len(v)} and {len(q)}")
    if rods is None:
        engine = get_solver(robot)
        assert isinstance(engine, TreePose)
        out = np.full((len(q), 6), np.nan)
        for index, closed in engine.closed(q, np.flatnonzero(np.isfinite(q).all(axis=1))):
            out[index] = engine.acceleration(closed, v[index])
        return out
    return _bias(rods, q, v, _plate(rods, q, poses))


def measure_singularity(robot: Robot | Rods, q: np.ndarray, poses: Poses | None = None) -> Singularity:
    """Return how near the robot is to singularities of both kinds; of a tree, by its loops and by its tool's Jacobian."""
    rods, q = get_rods(robot), require_positions(get_robot(robot), q)
    if rods is None:
        return _tree_singularity(robot, q)
    plate = _plate(rods, q, poses)
    radius = float(np.sqrt(np.mean(np.sum(rods.on_plate**2, axis=1)))) or 1.0
    by_pose, by_q = rods.gap_by_pose(q, plate), rods.gap_by_q(q, plate)
    by_pose = by_pose[:, :, :3] if rods.translates else by_pose / np.array([1, 1, 1, radius, radius, radius])
    speed = np.linalg.norm(rods.base_jacobian(q), axis=2).max(axis=1)
    speed = np.maximum(speed, np.abs(rods.leg_rates(q)).max(axis=1))
    return Singularity(_ratio(by_pose), _ratio(by_q / speed[:, None]))


def _plate(rods: Rods, q: np.ndarray, poses: Poses | None) -> Poses:
    if poses is None:
        return forward_kinematics(rods, q).plate
    poses = require_poses(poses)
    if len(poses.position) != len(q):
        raise InputError(
            "wrong_shape", f"as many poses as positions are needed, not {len(poses.position)} and {len(q)}"
        )
    return rods.plate_poses(poses)


def _by_tool(rods: Rods, q: np.ndarray, plate: Poses) -> np.ndarray:
    """Return the gaps' derivative by the tool's twist."""
    columns = rods.gap_by_pose(q, plate)
    if rods.translates:
        return columns[:, :, :3]
    r = plate.rotation @ rods.tool.translation  # the plate's origin moves with v_tool - w x r
    turned = columns[:, :, 3:] + np.cross(columns[:, :, :3], r[:, None])
    return np.concatenate([columns[:, :, :3], turned], axis=2)


def _solved(by_pose: np.ndarray, sides: np.ndarray) -> np.ndarray:
    sides = sides[:, :, None] if sides.ndim == 2 else sides
    return solve_with_lapack(by_pose, np.moveaxis(sides, 0, 2)).transpose(2, 0, 1)


def _bias(rods: Rods, q: np.ndarray, v: np.ndarray, plate: Poses) -> np.ndarray:
    r"""Return the tool's acceleration at rest of the actuators.

    With `f = (|d|^2 - L^2) / 2`, `d . T'' + (r x d) . w' = |d'|^2 + d . (A'' - w x (w x r)) - (L L')'`, and `(L L')'` is the
    square of a slide's speed.
    """
    by_pose, by_q = rods.gap_by_pose(q, plate), rods.gap_by_q(q, plate)
    by_pose = by_pose[:, :, :3] if rods.translates else by_pose
    twist = -_solved(by_pose, np.einsum("nka,na->nk", by_q, v))[:, :, 0]
    w = np.zeros((len(q), 3)) if rods.translates else twist[:, 3:]
    r = rods.plate_points(plate) - plate.position[:, None]
    rate = np.einsum("nkia,na->nki", rods.base_jacobian(q), v) - twist[:, None, :3] - np.cross(w[:, None], r)
    joints, carried, qt = rods.numbers.joints, rods.numbers.carried, q.T
    places = chains.compute_points(joints, carried, qt)
    pushed = chains.compute_accelerations(
        joints, carried, chains.compute_joint_frames(joints, qt), places, v.T
    ).transpose(2, 0, 1)
    pushed = pushed - np.cross(w[:, None], np.cross(w[:, None], r))
    d = places.transpose(2, 0, 1) - rods.plate_points(plate)
    right = np.sum(rate**2, axis=2) + np.sum(d * pushed, axis=2)
    for k in np.flatnonzero(rods.numbers.slides >= 0):
        right[:, k] -= v[:, rods.numbers.slides[k]] ** 2
    length = np.linalg.norm(d, axis=2)
    total = _solved(-by_pose, right / length)[:, :, 0]
    if rods.translates:
        return total
    arm = plate.rotation @ rods.tool.translation
    total[:, :3] += np.cross(total[:, 3:], arm) + np.cross(w, np.cross(w, arm))
    return total


def _of_tree(robot: Robot | Rods, q: np.ndarray) -> np.ndarray:
    engine = get_solver(robot)
    assert isinstance(engine, TreePose)
    out = np.full((len(q), 6, q.shape[1]), np.nan)
    for index, closed in engine.closed(q, np.flatnonzero(np.isfinite(q).all(axis=1))):
        out[index] = engine.jacobian(closed)
    return out


def _tree_singularity(robot: Robot | Rods, q: np.ndarray) -> Singularity:
    engine = get_solver(robot)
    assert isinstance(engine, TreePose)
    parallel, serial = np.full(len(q), np.nan), np.full(len(q), np.nan)
    for index, closed in engine.closed(q, np.flatnonzero(np.isfinite(q).all(axis=1))):
        if engine.robot.loops:
            parallel[index] = _ratio(engine.loops.jacobian(closed.at))
        else:
            parallel[index] = 1.0
        serial[index] = _ratio(engine.jacobian(closed))
    return Singularity(parallel, serial)


def _ratio(matrices: np.ndarray) -> np.ndarray:
    """Return the smallest singular value by the largest (N,); nan where a matrix is not finite."""
    out = np.full(len(matrices), np.nan)
    sound = np.isfinite(matrices).all(axis=(1, 2))
    if sound.any():
        s = np.linalg.svd(matrices[sound], compute_uv=False)
        out[sound] = s[:, -1] / s[:, 0]
    return out
