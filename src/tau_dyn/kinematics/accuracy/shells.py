"""The error body of a plate on rods by its shells: parallelepiped, ellipsoids and a certified bound (thesis, Appendix A).

Parallelepiped (A.4): its faces are orthogonal to the rods with distances `2 h_k`, `h_k` the largest component of rod k's
error along the rod. The sum of the diagonals' squares is `4 sum h_k^2 (C C')^-1_kk`, at least `4 sum h_k^2` as the rows of C
have length one: orthogonal rods have the smallest worst case, as stated in A.4, for unequal errors too.

Ellipsoids (A.2): rod k's free end is between two ellipsoids around the nominal base point, with semi-axes `L_k -+ r_k,i`
along the base error's own axes. For each of the 2^n corners one ellipsoid per rod is chosen and three steps are repeated:
project the end's current position on its ellipsoid along the ray from the centre, compute the tangent plane there, intersect
the planes (steps 1 to 6; here also for plates that turn). The shell between the ellipsoids is too thin. The end's exact outer
limit is the parallel surface of the error ellipsoid, at the distance `sqrt(sum r_i^2 u_i^2)` outside the sphere along a unit
direction u. The ellipsoid `L + r_i` is only `sum r_i u_i^2` outside: equal on the axes and for a ball, too small in all other
directions, to first order. `worst_case.py` has the exact limit.

Certified bound: with w = B - A, |w| = L and D the whole change of w, `|w + D| = L + l` is exactly

    u . (dp + phi x R b) = [u . dA - u . R db + l] + r,      r = (l^2 - |D|^2) / 2L - u . (R' - R - [phi] R) b - u . (R' - R) db,

and |r| is bounded by the displacement itself: |D| <= d + t (|b| + |db|) + |db| + |dA| for |dp| <= d, |phi| <= t. If d and t
bound the right side's solution, this map takes the ball (d, t) into itself and is a contraction there, so the ball contains
exactly one pose (Banach; Kantorovich's condition for quadrics), the one on the branch without errors. The smallest such d is
found by fixed-point iteration. If the iteration diverges, near a singularity, no bound is certified. Cf. Goldsztejn, Caro and
Chabert 2015.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.accuracy.device import LegsDevice, State, solve
from tau_dyn.mechanism import Poses


def compute_half_heights(device: LegsDevice, state: State) -> np.ndarray:
    """Return `h_k` (N, n) [m]: the sum over the sources of the largest error of each along rod k."""
    _, G = device.tangent(state, state.plate)
    blocks = [np.linalg.norm(G[:, :, ball], axis=2) for ball in device.balls]
    return np.sum(blocks, axis=0) if blocks else np.zeros(G.shape[:2])


def compute_half_edges(device: LegsDevice, state: State) -> np.ndarray:
    """Return the tool's displacement for each rod's largest error alone (N, 3, n) [m]: columns, half of an edge."""
    C, _ = device.tangent(state, state.plate)
    n = device.freedoms
    return solve(C, np.eye(n)[None] * compute_half_heights(device, state)[:, None])[:, :3]


def compute_face_areas(edges: np.ndarray) -> np.ndarray:
    """Return the area of the faces orthogonal to each of three rods (N, 3) [m^2], for half edges (N, 3, 3); Figure 4.9."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return np.stack([4 * np.linalg.norm(np.cross(edges[:, :, i], edges[:, :, j]), axis=1) for i, j in pairs], axis=1)


MAX_PROJECTIONS = 60  # Newton steps; corners that need more do not exist
_TOLERANCE = 1e-12
"""[m] Distance of the projections from the planes' intersection at which the iteration stops."""


def explain_no_ellipsoids(device: LegsDevice) -> str:
    """Return why the method does not apply, '' if it does: every rod needs its own ellipsoid."""
    if not device.sources.own:
        return "rods share a source of error, so that their shells are not independent"
    return "" if np.isfinite(device.sources.radii).all() else "an actuator's error is no ellipsoid of a base point"


def find_corners(device: LegsDevice, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacements of the tool at the corners of the body (N, 2^n, 3) [m] and the iterations needed (N, 2^n).

    Corners without an intersection are nan.
    """
    signs = np.array(list(product((1.0, -1.0), repeat=device.freedoms)))
    shifts, counts = zip(*(_corner(device, state, sign) for sign in signs), strict=True)
    return np.stack(shifts, axis=1), np.stack(counts, axis=1)


def _corner(device: LegsDevice, state: State, sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one corner (N, 3) and its iterations (N,)."""
    A, b, L = device.ends(state.q, None)
    semi = L[:, :, None] + sign[:, None] * device.sources.radii  # (N, n, 3)
    p, R = state.plate.position.copy(), np.array(state.plate.rotation)
    ok, count = np.zeros(len(p), bool), np.zeros(len(p), int)
    for _ in range(MAX_PROJECTIONS):
        arm = np.einsum("Nab,Nkb->Nka", R, np.broadcast_to(b, A.shape))
        away, normal = _projected(p[:, None] + arm - A, device.sources.axes, semi)
        rows = normal if device.rods.translates else np.concatenate([normal, np.cross(arm, normal)], axis=2)
        step = solve(rows, np.einsum("Nka,Nka->Nk", normal, away)[..., None])[..., 0]
        ok = np.linalg.norm(away, axis=2).max(axis=1) < _TOLERANCE
        if np.all(ok | ~np.isfinite(step).all(axis=1)):
            break
        step = np.where(ok[:, None], 0.0, step)
        count += ~ok
        p = p + step[:, :3]
        if not device.rods.translates:
            R = Rotation.from_rotvec(np.nan_to_num(step[:, 3:])).as_matrix() @ R
    tool = device.rods.tool_poses(Poses(p, R))
    return np.where(ok[:, None], tool.position - state.position, np.nan), count


def _projected(w: np.ndarray, axes: np.ndarray, semi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the intersections of rays along `w` (N, n, 3) with the ellipsoids, from w's end, and the unit normals there."""
    own = np.einsum("kab,Nka->Nkb", axes, w)
    on = own / np.linalg.norm(own / semi, axis=2, keepdims=True)
    normal = on / semi**2
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    back = np.einsum("kab,Nkb->Nka", axes, on), np.einsum("kab,Nkb->Nka", axes, normal)
    return back[0] - w, back[1]


def measure_largest(displacements: np.ndarray) -> np.ndarray:
    """Return the farthest corner's distance (N,) [m]; nan if a corner is missing."""
    return np.linalg.norm(displacements, axis=2).max(axis=1)


MAX_FIXED_POINT_STEPS = 200  # of the fixed-point iteration; it converges linearly or not at all
_MAX_BOUND_RATIO = 0.25
"""Share of the shortest rod up to which a bound is sought."""
_SAFE = 1 + 1e-9  # factor that is larger than rounding errors, so that the bound stays valid


def explain_no_certificate(device: LegsDevice) -> str:
    """Return why the bound does not apply, '' if it does."""
    rods, Q = device.rods, device.sources.actuator
    home = rods.robot.home[None]
    curved = np.any(rods.base_jacobian(home) @ Q) or np.any((rods.leg_rates(home) - rods.leg_rates(home + 0.05)) @ Q)
    return "an actuator's error moves its points on a curve, which the bound leaves out" if curved else ""


def bound_displacement(device: LegsDevice, state: State) -> np.ndarray:
    """Return a displacement of the tool (N,) [m] that no errors within their bounds exceed; nan without a proof."""
    A, b, L = device.ends(state.q, None)
    s, shortest = device.sources, L.min(axis=1)
    levers = np.linalg.norm(b[0], axis=1)
    shift, plate, length = (
        _reach(x, device.balls)
        for x in (s.shift, s.plate, (s.length + device.rods.leg_rates(state.q[:1])[0] @ s.actuator)[:, None])
    )
    h = compute_half_heights(device, state)
    C, _ = device.tangent(state, state.plate)
    inverse = solve(C, np.broadcast_to(np.eye(device.freedoms), C.shape))
    lever = state.plate.rotation @ device.rods.tool.translation
    signs = np.array([(1, *x) for x in product((1, -1), repeat=device.freedoms - 1)], float)
    d, t = np.zeros(len(h)), np.zeros(len(h))
    X, settled, lost = np.zeros((len(h), 1, device.freedoms)), np.zeros(len(h), bool), np.zeros(len(h), bool)
    for _ in range(MAX_FIXED_POINT_STEPS):
        change = d[:, None] + t[:, None] * (levers + plate) + plate + shift
        rest = np.maximum(change**2, length**2) / (2 * L) + t[:, None] ** 2 * levers / 2 + t[:, None] * plate
        X = np.einsum("Nik,sk,Nk->Nsi", inverse, signs, h + rest)
        new_d = _SAFE * np.linalg.norm(X[..., :3], axis=2).max(axis=1)
        new_t = _SAFE * np.linalg.norm(X[..., 3:], axis=2).max(axis=1)
        settled = (new_d <= d * _SAFE) & (new_t <= t * _SAFE)
        d, t = np.maximum(d, new_d), np.maximum(t, new_t)
        lost = ~(d < _MAX_BOUND_RATIO * shortest) | ~(t < 1.0)
        if np.all(settled | lost):
            break
    at_tool = d
    if not device.rods.translates:
        moved = X[..., :3] + np.cross(X[..., 3:], lever[:, None])
        at_tool = np.linalg.norm(moved, axis=2).max(axis=1) + t**2 * np.linalg.norm(lever, axis=1) / 2
    return np.where(settled & ~lost, at_tool * _SAFE, np.nan)


def _reach(effect: np.ndarray, balls: tuple[slice, ...]) -> np.ndarray:
    """Return how far all sources together can move each rod's point or length (n,) [m]."""
    sizes = [np.linalg.norm(effect[..., ball], ord=2, axis=(1, 2)) for ball in balls]
    return np.sum(sizes, axis=0) if sizes else np.zeros(len(effect))
