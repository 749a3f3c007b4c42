r"""Appendix A.2: the tool's error body as the intersection of ellipsoidal shells, by the thesis' iteration.

Rod k's free end lies between two ellipsoids around the nominal base point, with semi-axes `L_k -+ r_k,i` along the base error's
own axes. Each of the 2^n corners takes one ellipsoid a rod and repeats: project the end's current position on its ellipsoid along
the ray from the centre, take the tangent plane there, intersect the planes (steps 1 to 6; here for plates that turn, too).

These ellipsoids are too thin. The end's exact outer limit is the parallel surface of the error ellipsoid, so along a unit
direction u it lies `sqrt(sum r_i^2 u_i^2)` outside the sphere, and the ellipsoid `L + r_i` only `sum r_i u_i^2`: equal on
the axes and for a ball, too small everywhere else, to first order and not "slightly". `solve_worst_case.py` has the exact limit.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.accuracy.rod_device import RodDevice, State, solve
from tau_dyn.mechanism import Poses

_STEPS = 60  # Newton steps; corners that need more do not exist
_TOLERANCE = 1e-12
"""[m] Distance of the projections from the planes' intersection at which the iteration stops."""


def explain_inapplicable(device: RodDevice) -> str:
    """Return why the method does not apply, '' where it does: every rod needs its own ellipsoid."""
    if not device.sources.own:
        return "rods share a source of error, so that their shells are not independent"
    return "" if np.isfinite(device.sources.radii).all() else "an actuator's error is no ellipsoid of a base point"


def find_corners(device: RodDevice, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacements of the tool at the corners of the body (N, 2^n, 3) [m] and the iterations needed (N, 2^n).

    Corners without an intersection are nan.
    """
    signs = np.array(list(product((1.0, -1.0), repeat=device.freedoms)))
    shifts, counts = zip(*(_corner(device, state, sign) for sign in signs), strict=True)
    return np.stack(shifts, axis=1), np.stack(counts, axis=1)


def _corner(device: RodDevice, state: State, sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one corner (N, 3) and its iterations (N,)."""
    A, b, L = device.ends(state.q, None)
    semi = L[:, :, None] + sign[:, None] * device.sources.radii  # (N, n, 3)
    p, R = state.plate.position.copy(), np.array(state.plate.rotation)
    ok, count = np.zeros(len(p), bool), np.zeros(len(p), int)
    for _ in range(_STEPS):
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
    """Return where the rays along `w` (N, n, 3) pierce the ellipsoids, from w's end, and the unit normals there."""
    own = np.einsum("kab,Nka->Nkb", axes, w)
    on = own / np.linalg.norm(own / semi, axis=2, keepdims=True)
    normal = on / semi**2
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    back = np.einsum("kab,Nkb->Nka", axes, on), np.einsum("kab,Nkb->Nka", axes, normal)
    return back[0] - w, back[1]


def measure_largest(displacements: np.ndarray) -> np.ndarray:
    """Return the farthest corner's distance (N,) [m]; nan where a corner is missing."""
    return np.linalg.norm(displacements, axis=2).max(axis=1)


def compute_shell_heights(device: RodDevice, state: State) -> np.ndarray:
    """Return to first order the half thickness of each rod's shell as the thesis' ellipsoids have it (N, n) [m]."""
    A, b, _ = device.ends(state.q, None)
    w = state.plate.position[:, None] + np.einsum("Nab,Nkb->Nka", state.plate.rotation, np.broadcast_to(b, A.shape)) - A
    u = np.einsum("kab,Nka->Nkb", device.sources.axes, w / np.linalg.norm(w, axis=2, keepdims=True))
    return np.einsum("Nkb,kb->Nk", u**2, device.sources.radii)
