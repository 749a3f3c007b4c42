"""The thesis' implicit kinematics: closed forms of a free plate on three arms of parallel rods (Dressler 2012, section 4.2).

Rods of one arm that are equally long and parallel carry over their arm's rotation to the plate: `A_kj - A_k1 = R (B_kj -
B_k1)` for all of them. So the rotation that turns the plate's vectors into the arms' (Kabsch 1976) is the plate's, and
with it known each arm counts as one rod of a translating plate. This is the thesis' implicit 5-DOF kinematics of the F1
type at `q4 = -q5`, (4.26) forward and (4.25) inverse, and as well the nominal complete Gantry-Tau; forward also the Delta.
`defect` says how far the vectors are from each other: zero where the closed form is exact. The inverse finds an arm's turns
from the plate's rotation: one by the angle between vectors, two as the first two of three successive turns (Paden-Kahan
subproblem 1 twice; Murray, Li & Sastry 1994, ch. 3.3), and its slide from a sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import ChainJoint, Legs, Poses, list_path, require_positions
from tau_dyn.mechanism.poses import require_poses, turn_rotations
from tau_dyn.mechanism.sliding_plate import find_side, intersect_spheres

_EQUAL = 0.01  # by how much the lengths of parallel rods may differ, relative


class Implicit(NamedTuple):
    """Poses of the tool (N) and how far the arms' vectors are from the plate's (N,) [m]."""

    poses: Poses
    defect: np.ndarray


def solve_implicit_forward(rods: Legs, q: np.ndarray) -> Implicit:
    """Return the tool's poses as if the rods of each arm were parallel.

    Args:
        rods: A free plate on three arms.
        q: Actuated positions (N, na).

    Raises:
        InputError: The rods do not form three arms of equally long ones.
    """
    q = require_positions(rods.robot, q)
    arms = _arms(rods)
    A = rods.base_points(q)
    on_base = np.concatenate([A[:, list(arm[1:])] - A[:, arm[:1]] for arm in arms], axis=1)
    on_plate = np.concatenate([rods.on_plate[list(arm[1:])] - rods.on_plate[arm[0]] for arm in arms])
    rotation = _best_rotation(on_plate, on_base)
    defect = _compare_vectors(rods, arms, q, rotation)
    first = [arm[0] for arm in arms]
    centres = (A[:, first] - rods.on_plate[first] @ np.swapaxes(rotation, 1, 2)).transpose(1, 2, 0)
    home = rods.base_points(rods.robot.home[None])[:, first] - rods.on_plate[first] @ rods.rotation.T
    side = float(find_side(home.transpose(1, 2, 0), rods.home.position.T)[0])
    position = intersect_spheres(centres, rods.lengths[first][:, None] ** 2, side).position.T
    return Implicit(rods.tool_poses(Poses(position, rotation)), defect)


class ImplicitInverse(NamedTuple):
    """Actuated positions (N, na) [m or rad], nan out of reach, and how far the arms' vectors are from the plate's (N,) [m]."""

    q: np.ndarray
    defect: np.ndarray


def solve_implicit_inverse(
    rods: Legs, tool: Poses, *, configuration: Sequence[int] | np.ndarray | None = None
) -> ImplicitInverse:
    """Return actuated positions as if the rods of each arm were parallel (thesis (4.25)).

    Args:
        rods: A free plate on three arms, each a slide with up to two turns on it.
        tool: Poses (N). Of five freedoms only poses with zero `defect` are met: the arms cannot follow other rotations.
        configuration: -1 or 1 for each arm, the root of its sphere; by default home's.

    Raises:
        InputError: The rods do not form three such arms, or an unknown configuration.
    """
    plate, home = rods.plate_poses(require_poses(tool)), rods.robot.home[None]
    arms, paths = _arms(rods), []
    for arm in _arms(rods):
        path = [rods.numbers.joints[k] for k in list_path(rods.numbers.joints, rods.numbers.carried.carrier[arm[0]])]
        if not path or not path[0].slides or any(j.slides for j in path[1:]) or len(path) > min(3, len(arm)):
            raise InputError(
                "unsupported",
                f"{rods.robot.source}: the closed form needs arms of one slide and fewer turns than rods, two at most",
            )
        paths.append(path)
    q = np.zeros((len(plate.position), rods.na))
    for arm, path in zip(arms, paths, strict=True):
        for joint, angle in zip(path[1:], _find_turns(rods, arm, path, plate.rotation), strict=True):
            q[:, joint.actuator] = angle
    vectors = _compare_vectors(rods, arms, q, plate.rotation)
    slides = [path[0] for path in paths]
    at_home = home.copy()
    at_home[:, [j.actuator for j in slides]] = 0.0
    roots = np.stack([_find_slides(rods, arms, slides, at_home, rods.home, sign) for sign in (-1, 1)])[:, 0]
    nearest = np.abs(np.nan_to_num(roots - home[0, [j.actuator for j in slides]], nan=np.inf)).argmin(axis=0)
    signs = 2 * nearest - 1 if configuration is None else np.asarray(configuration)
    if signs.shape != (3,) or not np.isin(signs, (-1, 1)).all():
        raise InputError(
            "invalid_value", f"configuration {configuration} does not exist; one holds -1 or 1 for each arm"
        )
    q[:, [j.actuator for j in slides]] = _find_slides(rods, arms, slides, q, plate, signs)
    q[~np.isfinite(q).all(axis=1)] = np.nan
    return ImplicitInverse(q, vectors)


def _find_turns(rods: Legs, arm: list[int], path: list[ChainJoint], rotation: np.ndarray) -> list[np.ndarray]:
    """Return the angles (N,) [rad] of an arm's turns that make its vectors the plate's at rotations (N, 3, 3)."""
    if len(path) == 1:
        return []
    local = rods.numbers.carried.local[arm]
    wanted = (rods.on_plate[arm[1:]] - rods.on_plate[arm[0]]) @ np.swapaxes(rotation, 1, 2)
    parent, first = path[0].rotation, path[1]
    if len(path) == 2:
        vectors = (local[1:] - local[0]) @ first.rotation.T
        return [_find_angle(first, vectors, wanted @ parent)]
    second = path[2]
    turned = _best_rotation(local[1:] - local[0], wanted)
    turned = parent.T @ turned @ second.rotation.T
    axis = second.direction / np.linalg.norm(second.direction)
    angle = _find_angle(first, (first.rotation @ axis)[None], (turned @ axis)[:, None])
    back = turn_rotations(-angle[:, None] * first.direction, np.eye(3)[None])
    left = first.rotation.T @ back @ turned
    across = np.linalg.svd(axis[None])[2][1:]
    return [angle, _find_angle(second, across, across @ np.swapaxes(left, 1, 2))]


def _find_angle(joint: ChainJoint, vectors: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the positions (N,) of a turn that bring vectors (m, 3) best to others (N, m, 3), all in its parent's frame."""
    gain = float(np.linalg.norm(joint.direction))
    n = joint.direction / gain
    sine = np.sum(np.cross(vectors, wanted) @ n, axis=1)
    cosine = np.sum(vectors * wanted, axis=(1, 2)) - np.sum((vectors @ n) * (wanted @ n), axis=1)
    return np.arctan2(sine, cosine) / gain


def _find_slides(
    rods: Legs, arms: list[list[int]], slides: list[ChainJoint], q: np.ndarray, plate: Poses, signs: np.ndarray | int
) -> np.ndarray:
    """Return the slides (N, 3) [m] that put each arm's first rod's end on its sphere; `q` (N, na) has them at zero."""
    first = [arm[0] for arm in arms]
    d = np.array([joint.direction for joint in slides])
    w = rods.plate_points(plate)[:, first] - rods.base_points(q)[:, first]
    square = np.sum(d * d, axis=1)
    along = np.sum(w * d, axis=2) / square
    across = w - along[:, :, None] * d
    with np.errstate(invalid="ignore"):
        return along + signs * np.sqrt((rods.lengths[first] ** 2 - np.sum(across**2, axis=2)) / square)


def _compare_vectors(rods: Legs, arms: list[list[int]], q: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the largest difference (N,) [m] between vectors from rod to rod of an arm and those of the turned plate."""
    A = rods.base_points(q)
    on_base = np.concatenate([A[:, arm[1:]] - A[:, arm[:1]] for arm in arms], axis=1)
    on_plate = np.concatenate([rods.on_plate[arm[1:]] - rods.on_plate[arm[0]] for arm in arms])
    return np.linalg.norm(on_base - on_plate @ np.swapaxes(rotation, 1, 2), axis=2).max(axis=1)


def _arms(rods: Legs) -> list[list[int]]:
    """Return the rods of each arm: those on one body of equal length."""
    arms: dict[int, list[int]] = {}
    for k, carrier in enumerate(rods.numbers.carried.carrier):
        arms.setdefault(carrier, []).append(k)
    lengths = [rods.lengths[arm] for arm in arms.values()]
    unequal = any(np.ptp(length) > _EQUAL * length.mean() for length in lengths)
    if rods.translates or len(arms) != 3 or unequal or np.any(rods.numbers.slides >= 0):
        raise InputError(
            "unsupported", f"{rods.robot.source}: the closed form needs a free plate on three arms of equally long rods"
        )
    return list(arms.values())


def _best_rotation(on_plate: np.ndarray, on_base: np.ndarray) -> np.ndarray:
    """Return the rotations (N, 3, 3) that turn vectors (m, 3) into others (N, m, 3) best, by Kabsch's method."""
    u, _, vt = np.linalg.svd(np.einsum("nmi,mj->nij", on_base, on_plate))
    flip = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= flip[:, None]
    return u @ vt
