"""Closed forms of plates: three spheres for one that only translates, and arms of parallel rods. Samples last.

A plate that keeps its rotation ends each rod at `T + r_k` with constant `r_k`, and `|A_k - r_k - T| = L_k`: three spheres
(thesis (4.9); Coope 2000), with Gauss-Newton where there are more rods. They meet in two points, mirrored in the plane of the
centres; `side` says on which side of it the plate is, seen along `(C_2 - C_1) x (C_3 - C_1)`: the thesis' configuration `c`.
Home's side is taken, since the way from one to the other leads through a singularity.

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
from itertools import combinations
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.frames import ChainJoint, compute_cross_product, list_path
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import (
    NOT_A_NUMBER,
    OK,
    OUT_OF_REACH,
    SINGULAR,
    Poses,
    require_poses,
    require_positions,
    turn_rotations,
)
from tau_dyn.mechanism.small_systems import solve_with_lapack


class SphereIntersection(NamedTuple):
    """Where three spheres meet.

    Attributes:
        position: (3, N) [m]; nan where they do not.
        height: Squared height of that point over the centres' plane, by the squared longest radius (N,); below zero where
            the spheres do not meet.
    """

    position: np.ndarray
    height: np.ndarray


def intersect_spheres(centres: np.ndarray, square: np.ndarray, side: float | np.ndarray) -> SphereIntersection:
    """Intersect spheres around centres (3, 3, N) [m] with squared radii (3, N or 1) [m^2], on one side of their plane."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    with np.errstate(all="ignore"):
        inverse = 1.0 / compute_dot_products(normal, normal)
        p = (0.5 * inverse) * (compute_dot_products(u, u) + (square[0] - square[1]))
        r = (0.5 * inverse) * (compute_dot_products(w, w) + (square[0] - square[2]))
        foot = compute_cross_product(w, normal)
        foot *= p
        other = compute_cross_product(normal, u)
        other *= r
        foot += other
        height = square[0] - compute_dot_products(foot, foot)
        normal *= side * np.sqrt(height * inverse)
    foot += normal
    foot += centres[0]
    return SphereIntersection(foot, height / square.max(axis=0))


def find_side(centres: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return on which side (N,) of the plane of three centres (3, 3, N) a point (3, N) is: 1, -1 or 0."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    return np.sign(compute_dot_products(normal, position - centres[0]))


def compute_dot_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of vectors (3, N)."""
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out


BLOCK = 8192  # samples at a time; arrays stay in the processor's cache
_FLAT = 1e-12
"""Squared height over the centres' plane, by the squared longest rod, below which a pose counts as singular."""
_AGREE = 1e-9  # [m] by how much more than three rods may contradict each other


class SlidingPlate:
    """Solves one robot."""

    def __init__(self, rods: Legs) -> None:
        """Choose the three rods that meet best at home, and home's side."""
        self.rods, self.numbers = rods, rods.numbers
        self._shift = rods.on_plate @ rods.rotation.T
        home = self._centres(rods.robot.home[:, None])
        self.three = self._best_three(home, rods.home.position.T)
        self.side = float(find_side(home[self.three], rods.home.position.T)[0])

    def forward(self, q: np.ndarray, start: Poses | None = None) -> tuple[Poses, np.ndarray]:
        """Return the plate's poses and codes at `q` (N, na); a start chooses the side of its own position."""
        position = np.empty((len(q), 3))
        code = np.zeros(len(q), np.int8)
        for first in range(0, len(q), BLOCK):
            part = slice(first, first + BLOCK)
            found, code[part] = self.solve(np.ascontiguousarray(q[part].T), _part(start, part))
            position[part] = found.T
        return Poses(position, np.broadcast_to(self.rods.rotation, (len(q), 3, 3))), code

    def both(self, q: np.ndarray) -> np.ndarray:
        """Return both solutions (N, 2, 3) [m], home's side first; nan where the spheres do not meet."""
        centres = self._centres(np.ascontiguousarray(q.T))[self.three]
        squares = rod_dimensions.compute_squared_lengths(self.numbers, q.T)[self.three]
        return np.stack(
            [intersect_spheres(centres, squares, side).position.T for side in (self.side, -self.side)], axis=1
        )

    def solve(self, q: np.ndarray, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the plate's positions (3, N) [m] and codes at `q` (na, N), on the side of a start (3, N), or home's."""
        centres, squares = self._centres(q), rod_dimensions.compute_squared_lengths(self.numbers, q)
        chosen, three = (centres, squares) if self.rods.n == 3 else (centres[self.three], squares[self.three])
        side = self.side if start is None else find_side(chosen, start)
        found = intersect_spheres(chosen, three, side)
        position, height = found.position, found.height
        code = np.zeros(q.shape[1], np.int8)
        if not np.all(height > _FLAT):
            with np.errstate(invalid="ignore"):
                code = np.where(height >= 0, SINGULAR, OUT_OF_REACH)
                code = np.where(height > _FLAT, OK, code)
                code = np.where(np.isfinite(q).all(axis=0), code, NOT_A_NUMBER)
            position[:, code != OK] = np.nan
        if self.rods.n > 3:
            position = self._refined(centres, squares, position)
            gap = np.linalg.norm(centres - position, axis=1) - np.sqrt(squares)
            code = np.where((code == OK) & ~(np.abs(gap).max(axis=0) < _AGREE), OUT_OF_REACH, code)
        return position, code

    def _refined(self, centres: np.ndarray, squares: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the positions (3, N) that suit all rods best."""
        for _ in range(3):
            d = centres - position
            f = 0.5 * (np.einsum("kin,kin->kn", d, d) - squares)
            position = position + solve_with_lapack(d.transpose(2, 0, 1), f)
        return position

    def _centres(self, q: np.ndarray) -> np.ndarray:
        """Return the spheres' centres `A - R b` (n, 3, N) [m]."""
        points = frames.compute_points(self.numbers.joints, self.numbers.carried, q)
        return points - self._shift[:, :, None] if self._shift.any() else points

    def _best_three(self, centres: np.ndarray, position: np.ndarray) -> list[int]:
        d = (centres - position)[:, :, 0]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        return list(max(combinations(range(len(d)), 3), key=lambda three: abs(np.linalg.det(d[list(three)]))))


def _part(start: Poses | None, part: slice) -> np.ndarray | None:
    if start is None:
        return None
    position = start.position
    return (position if len(position) == 1 else position[part]).T


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
