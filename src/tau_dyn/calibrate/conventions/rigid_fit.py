r"""The distance between measured poses and a robot of nominal dimensions, with device and target placed in closed form.

    R_m = R_D R R_T,    p_m = p_D + R_D (p + R p_T)

With orientations, `R_D` and `R_T` maximise `sum tr(R_m' R_D R R_T)`, which depends on the poses through one 9 x 9 matrix
(Procrustes steps in turn, from all 24 quarter turns of the target); a turn that they do not show is found by the positions.
With positions alone, `p = A p_m + c - R p_T` is linear in an unconstrained `A`, whose nearest rotation is `R_D'`. Both then
leave `p_D` and `p_T` to linear least squares. The worst fifth of the poses is left out (least trimmed squares), so that gross
outliers do not decide. References: Dornaika & Horaud 1998 (robot and world frames); Umeyama 1991; Rousseeuw 1984.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import align, compute_rotation_between
from tau_dyn.calibrate.measured import PoseSet, measure_spread
from tau_dyn.mechanism import Poses

_TRIMMED_SHARE = 0.2
"""Share of the poses that are left out: the largest share that counts as outliers elsewhere in this room."""
_CONCENTRATION_STEPS = 1
"""Fits after the first, without the worst poses of the one before: two fits rank readings as their limit does."""
_FIRST_STEPS = 3
"""Steps from every start before only the best is continued."""
_NEWTON_STEPS = 5
"""Gauss-Newton steps from there; they converge quadratically."""
_BLIND = 1e-6
"""Share of the largest singular value below which a turn of both frames is not identifiable."""
_WEAK = 0.03
"""Share of the largest singular value below which positions determine a turn better: errors of 20 mrad move it by a radian."""
_TURNS = 24
"""Starts of a turn about an axis that orientations do not show."""
_TURN_TOL = 1e-6  # [rad]
_PROCRUSTES_STEPS = 12
"""Steps of the device's and the target's orientation in turn; the residual falls by a constant factor in each."""
_MIN_POSES = 8
"""Least poses of one device and target: the 15 unknowns of the linear start are then over-determined with a fifth trimmed."""


class Misfit(NamedTuple):
    """Trimmed rms errors of a robot with nominal dimensions.

    Attributes:
        position: Error of the measured positions [m].
        rotation: Error of the orientations [rad], None if orientations are not compared.
        spread: Rms distance of the robot's own tool positions from their middle [m].
        distances: Error of every pose that was compared (N,) [m].
        angles: Error of its orientation (N,) [rad], None if orientations are not compared.
        unit: Metres of the unit in which the file has positions: likelihoods are of the numbers as written.
    """

    position: float
    rotation: float | None
    spread: float
    distances: np.ndarray
    angles: np.ndarray | None
    unit: float = 1.0

    @classmethod
    def of(cls, distances: np.ndarray, angles: np.ndarray | None, spread: float, unit: float = 1.0) -> Misfit:
        """Return the misfit of distances (N,) [m] and angles (N,) [rad]."""
        rotation = None if angles is None else compute_trimmed_rms(angles)
        return cls(compute_trimmed_rms(distances), rotation, spread, distances, angles, unit)

    @property
    def n_numbers(self) -> int:
        """Coordinates and angles that were compared."""
        return len(self.distances) * (3 if self.angles is None else 6)

    @property
    def value(self) -> float:
        """Geometric mean of the errors: its logarithm is the log-likelihood of a coordinate, up to its sign and a constant."""
        size = self.position / self.unit
        return size if self.rotation is None else float(np.sqrt(size * self.rotation))


UNREACHED = Misfit(float("inf"), None, 1.0, np.zeros(0), None)
"""Misfit of a reading at which the robot cannot be placed."""


def measure_misfit(poses: PoseSet, nominal: Poses, ok: np.ndarray, *, turns: bool) -> Misfit:
    """Return the misfit of poses (N) for tool poses of the nominal robot in its base frame.

    Args:
        poses: Measured poses; every device and target with enough of them is placed on its own.
        nominal: Tool poses (N).
        ok: Whether the robot reaches them (N,).
        turns: Whether the robot's tool can turn.
    """
    if 2 * ok.sum() < poses.n or ok.sum() < 3:
        return UNREACHED
    seen, known = poses.take(ok), nominal.take(ok)
    _, group, size = np.unique(seen.setup, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    if size.max() < _MIN_POSES:
        group, size = np.zeros(seen.n, int), np.array([seen.n])
    own = [group == k for k in np.flatnonzero(size >= min(_MIN_POSES, size.max()))]
    parts = [_measure_group(seen.take(mask), known.take(mask), turns) for mask in own]
    position, angles = np.concatenate([distance for distance, _ in parts]), [a for _, a in parts if a is not None]
    rotation = np.concatenate(angles) if angles else None
    return Misfit.of(position, rotation, measure_spread(known.position))


def compute_trimmed_rms(errors: np.ndarray) -> float:
    """Return the rms of the smaller errors (N,)."""
    kept = np.sort(errors)[: max(1, int(np.ceil((1 - _TRIMMED_SHARE) * len(errors))))]
    return float(np.sqrt(np.mean(kept**2)))


def _measure_group(poses: PoseSet, nominal: Poses, turns: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the distances (N,) [m] and angles (N,) [rad] of the poses of one device and one target."""
    used = np.arange(poses.n)
    keep = max(int(np.ceil((1 - _TRIMMED_SHARE) * poses.n)), min(poses.n, 3))
    for _ in range(1 + _CONCENTRATION_STEPS):
        place = _place if turns else _place_without_turns
        distance, angle = place(poses, nominal, used)
        size = distance / max(compute_trimmed_rms(distance), 1e-300)
        size = size if angle is None else np.hypot(size, angle / max(compute_trimmed_rms(angle), 1e-300))
        used = np.sort(np.argsort(size, kind="stable")[:keep])
    return distance, angle


def _place_without_turns(poses: PoseSet, nominal: Poses, used: np.ndarray) -> tuple[np.ndarray, None]:
    """Return distances (N,) for a tool that keeps its orientation.

    The device's place compensates for the target's place on the tool.
    """
    frame = align(poses.position[used], nominal.position[used])
    return np.linalg.norm(poses.position - frame.translation - nominal.position @ frame.rotation.T, axis=1), None


def _place(poses: PoseSet, nominal: Poses, used: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return distances (N,) and angles (N,) with frames fitted to the poses in use."""
    if poses.rotation is None:
        device, angle = _turn_by_positions(poses.position[used], nominal.take(used)), None
    else:
        device, tool = align_orientations(poses.rotation[used], nominal.rotation[used])
        device, tool = _turn_about_blind_axis(poses, nominal, used, device, tool)
        angle = np.linalg.norm(compute_rotation_between(poses.rotation, device @ nominal.rotation @ tool), axis=1)
    return _miss(poses, nominal, used, device), angle


def _miss(poses: PoseSet, nominal: Poses, used: np.ndarray, device: np.ndarray) -> np.ndarray:
    """Return distances (N,) with the device's and the target's places fitted to the poses in use, at the device's orientation."""
    arms, right = device @ nominal.rotation, poses.position - nominal.position @ device.T
    rows = np.concatenate([np.broadcast_to(np.eye(3), arms.shape), arms], axis=2)
    place = np.linalg.lstsq(rows[used].reshape(-1, 6), right[used].ravel(), rcond=None)[0]
    return np.linalg.norm(right - rows @ place, axis=1)


def _turn_about_blind_axis(
    poses: PoseSet, nominal: Poses, used: np.ndarray, device: np.ndarray, tool: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return both orientations with their common turn about an axis as the positions ask for, where orientations do not show it.

    A tool that turns about one axis `u` alone, as parallel joints turn it, leaves open `Exp(x u) R_D` with `R_T Exp(-x u')`.
    """
    turned = device @ nominal.rotation[used] @ tool
    rows = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    if s[-1] > _WEAK * s[0]:
        return device, tool
    axes = vt[-1].reshape(2, 3) / np.linalg.norm(vt[-1].reshape(2, 3), axis=1, keepdims=True)

    def turn(x: float) -> tuple[np.ndarray, np.ndarray]:
        return Rotation.from_rotvec(x * axes[0]).as_matrix() @ device, tool @ Rotation.from_rotvec(
            x * axes[1]
        ).as_matrix()

    def miss(x: float) -> float:
        return float(np.sum(_miss(poses, nominal, used, turn(x)[0])[used] ** 2))

    width = 2 * np.pi / _TURNS
    start = min(width * np.arange(_TURNS), key=miss)
    end = minimize_scalar(miss, bounds=(start - width, start + width), method="bounded", options={"xatol": _TURN_TOL})
    return turn(float(end.x))


def _turn_by_positions(seen: np.ndarray, nominal: Poses) -> np.ndarray:
    """Return the device's orientation (3, 3) from positions (N, 3) of a target anywhere on the tool."""
    n = len(seen)
    rows = np.zeros((n, 3, 15))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = seen - seen.mean(axis=0)
    rows[:, :, 9:12], rows[:, :, 12:] = np.eye(3), -nominal.rotation
    x = np.linalg.lstsq(rows.reshape(-1, 15), nominal.position.ravel(), rcond=1e-9)[0]
    u, _, vt = np.linalg.svd(x[:9].reshape(3, 3))
    device = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    for _ in range(_PROCRUSTES_STEPS):
        arms = device @ nominal.rotation
        rows6 = np.concatenate([np.broadcast_to(np.eye(3), arms.shape), arms], axis=2).reshape(-1, 6)
        place = np.linalg.lstsq(rows6, (seen - nominal.position @ device.T).ravel(), rcond=None)[0]
        device = align(seen, nominal.position + nominal.rotation @ place[3:]).rotation
    return device


def align_orientations(seen: np.ndarray, nominal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `R_D` and `R_T` (3, 3) that take nominal orientations (N, 3, 3) nearest to the measured ones."""
    shared = np.einsum("nij,nkl->ijkl", seen, nominal)  # sum of R_m[i, j] R[k, l]
    tool = _list_quarter_turns()
    for step in range(_PROCRUSTES_STEPS):
        device = _nearest_rotations(np.einsum("ijkl,alj->aik", shared, tool))
        tool = _nearest_rotations(np.einsum("ijkl,aik->alj", shared, device))
        if step == _FIRST_STEPS:
            best = int(np.argmax(np.einsum("ijkl,aik,alj->a", shared, device, tool)))
            device, tool = device[best : best + 1], tool[best : best + 1]
    return _refine_orientations(seen, nominal, device[0], tool[0])


def _refine_orientations(
    seen: np.ndarray, nominal: np.ndarray, device: np.ndarray, tool: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the orientations after Gauss-Newton steps, which need no wide motion as Procrustes steps do; the best of all."""
    found, least = (device, tool), np.inf
    for _ in range(_NEWTON_STEPS):
        turned = device @ nominal @ tool
        left = compute_rotation_between(seen, turned)
        size = float(np.sum(left**2))
        if size < least:
            found, least = (device, tool), size
        rows = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)
        step = np.linalg.lstsq(rows, left.ravel(), rcond=_BLIND)[0]
        device = Rotation.from_rotvec(step[:3]).as_matrix() @ device
        tool = tool @ Rotation.from_rotvec(step[3:]).as_matrix()
    return found


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations (A, 3, 3) nearest to matrices."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt


@cache
def _list_quarter_turns() -> np.ndarray:
    """Return the 24 rotations of a cube (24, 3, 3)."""
    return Rotation.create_group("O").as_matrix()
