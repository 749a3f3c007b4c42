r"""Bundle adjustment: cameras, lenses and all plates in one fit to the corners in all images, with analytic derivatives.

The cost is the sum of squared corner residuals, each divided by its camera's noise, plus the prior of the cameras.
A corner of plate k seen by camera c is at u = project(R_c (R_k p + t_k) + t_c). Plates are coupled only through the cameras,
so the normal equations

    [A  E] [cameras]
    [E' B] [plates ],   B block-diagonal of 6 x 6,

are solved by the Schur complement S = A - E B^-1 E' (Brown 1976; Triggs et al. 2000, 6), and the covariance of plate k is
B_k^-1 (its own corners) + B_k^-1 E_k' S^-1 E_k B_k^-1 (the cameras', common to all plates).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.estimate import DescentRules, descend
from tau_dyn.vision.cameras import Cameras, project_with_jacobians

_RULES = DescentRules(60, small_step=0.0, small_gain=1e-9, damping=1e-3, first_damping=1e-12, max_trials=25)
"""Good initial values need ten to twenty steps."""


class Views(NamedTuple):
    """Views of plates by cameras.

    Attributes:
        corners: Corners (v, n, 2) [px].
        camera: Camera index of each view (v,).
        plate: Plate index of each view (v,), from 0 without gaps.
        spread: Standard deviation of each corner in units of its camera's noise (v, n); None if all are one.
    """

    corners: np.ndarray
    camera: np.ndarray
    plate: np.ndarray
    spread: np.ndarray | None = None

    def take(self, mask: np.ndarray) -> Views:
        """Return some views (mask or index), with plates renumbered."""
        plate = np.unique(self.plate[mask], return_inverse=True)[1]
        return Views(self.corners[mask], self.camera[mask], plate, None if self.spread is None else self.spread[mask])

    def scale(self, residuals: np.ndarray) -> np.ndarray:
        """Return residuals (v, n, 2) divided by the corners' spread."""
        return residuals if self.spread is None else residuals / self.spread[..., None]


class Plates(NamedTuple):
    """Poses of plates in the first camera's frame.

    Attributes:
        rotation: Rotations (k, 3, 3).
        position: Positions (k, 3) [m].
    """

    rotation: np.ndarray
    position: np.ndarray

    def moved(self, step: np.ndarray) -> Plates:
        """Return plates after steps (k, 6): translation [m], then rotation about the first camera's axes [rad]."""
        return Plates(Rotation.from_rotvec(step[:, 3:]).as_matrix() @ self.rotation, self.position + step[:, :3])


@dataclass(frozen=True, eq=False)
class Bundle:
    """Adjusted cameras and plates.

    Attributes:
        cameras: Cameras with the covariance of their parameters.
        plates: Poses of the plates.
        covariance: Covariance of each plate (k, 6, 6): position [m], then rotation vector about the first camera's axes [rad].
        own: The part of `covariance` from the plate's own corners; the rest is common to all plates, through the cameras.
        residuals: Measured less predicted corners (v, n, 2) [px].
        noise: Corner noise of each camera (c,) [px].
        cost: Half the weighted sum of squares.
        scaled: Reduced normal matrix of the free parameters, scaled to a diagonal of one; nearly singular if the images do not
            determine them.
    """

    cameras: Cameras
    plates: Plates
    covariance: np.ndarray
    own: np.ndarray
    residuals: np.ndarray
    noise: np.ndarray
    cost: float
    scaled: np.ndarray


class _State(NamedTuple):
    """Cameras and plates with their normal equations."""

    cameras: Cameras
    plates: Plates
    normal: _Normal


class _Normal(NamedTuple):
    cost: float
    a: np.ndarray
    e: np.ndarray
    b: np.ndarray
    ga: np.ndarray
    gb: np.ndarray

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step of cameras, then plates, with Marquardt's damping and block elimination."""
        inverse = np.linalg.inv(self.b + damping * self.b * np.eye(6))
        reach, step = self.e @ inverse, np.zeros(0)
        if len(self.a):
            schur = self.a + damping * self.a * np.eye(len(self.a)) - np.einsum("kpi,kqi->pq", reach, self.e)
            step = np.linalg.lstsq(schur, self.ga - np.einsum("kpi,ki->p", reach, self.gb), rcond=1e-15)[0]
        plates = inverse @ (self.gb - np.einsum("kpi,p->ki", self.e, step))[..., None]
        return np.concatenate([step, plates.ravel()]), np.inf


@dataclass(frozen=True, eq=False)
class _Problem:
    """The adjustment as a least-squares problem; a step holds the cameras' free parameters, then all plates."""

    views: Views
    points: np.ndarray
    noise: np.ndarray
    index: np.ndarray
    known: Cameras | None
    precision: np.ndarray

    def place(self, cameras: Cameras, plates: Plates) -> _State:
        """Return the state at these cameras and plates."""
        normal = _normal(self.views, self.points, cameras, plates, self.noise, self.index, self.known, self.precision)
        return _State(cameras, plates, normal)

    def linearise(self, state: _State) -> _Normal:
        """Return the normal equations at a state."""
        return state.normal

    def move(self, state: _State, step: np.ndarray) -> _State:
        """Return the state after a step."""
        whole = np.zeros(len(state.cameras.names))
        whole[self.index] = step[: len(self.index)]
        return self.place(state.cameras.moved(whole), state.plates.moved(step[len(self.index) :].reshape(-1, 6)))

    def gain(self, state: _State, trial: _State) -> float:
        """Return the relative decrease of the cost."""
        return (state.normal.cost - trial.normal.cost) / state.normal.cost

    def finish(self, state: _State) -> Bundle:
        """Return the adjusted cameras and plates with their covariance."""
        now, index = state.normal, self.index
        inverse = np.linalg.inv(now.b)
        schur = now.a - np.einsum("kpi,kij,kqj->pq", now.e, inverse, now.e)
        scale = np.sqrt(np.diag(schur).clip(1e-300))
        scaled, shared = schur / np.outer(scale, scale), np.zeros((0, 0))
        if len(index):
            shared = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) / np.outer(scale, scale)
        reach = inverse @ np.swapaxes(now.e, 1, 2)
        covariance = np.zeros((len(state.cameras.names),) * 2)
        covariance[np.ix_(index, index)] = shared
        residuals = self.views.corners - _predict(self.views, self.points, state.cameras, state.plates)[0]
        adjusted = replace(state.cameras, covariance=covariance, noise=self.noise)
        whole = inverse + reach @ shared @ np.swapaxes(reach, 1, 2)
        return Bundle(adjusted, state.plates, whole, inverse, residuals, self.noise, now.cost, scaled)


def adjust(
    views: Views,
    points: np.ndarray,
    cameras: Cameras,
    plates: Plates,
    *,
    noise: np.ndarray,
    free: np.ndarray | None = None,
    known: Cameras | None = None,
) -> Bundle:
    """Adjust cameras and plates from initial values.

    Args:
        views: Corners.
        points: The pattern's corners (n, 3) [m].
        cameras: Initial cameras.
        plates: Initial plates (k).
        noise: Corner noise of each camera (c,) [px].
        free: Mask of the camera parameters that may change (p,); by default those of their lens model.
        known: Prior of the cameras, with covariance; parameters of zero variance are fixed.
    """
    index, precision = np.flatnonzero(cameras.free() if free is None else free), np.zeros(())
    if known is not None and known.covariance is not None:
        index = index[np.diag(known.covariance)[index] > 0]
        precision = np.linalg.pinv(known.covariance[np.ix_(index, index)], rcond=1e-14, hermitian=True)
    problem = _Problem(views, points, noise, index, known, precision)
    return problem.finish(descend(problem, problem.place(cameras, plates), _RULES).state)


def _predict(
    views: Views, points: np.ndarray, cameras: Cameras, plates: Plates
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, their derivatives by the point in the camera and by the intrinsics, and points about plate and camera."""
    about = np.einsum("vij,nj->vni", plates.rotation[views.plate], points)
    turned = np.einsum("vij,vnj->vni", cameras.rotation[views.camera], about + plates.position[views.plate][:, None])
    pixels, by_point, by_numbers = project_with_jacobians(
        turned + cameras.position[views.camera][:, None], cameras.intrinsics[views.camera][:, None]
    )
    return pixels, by_point, by_numbers, about, turned


def _normal(
    views: Views,
    points: np.ndarray,
    cameras: Cameras,
    plates: Plates,
    noise: np.ndarray,
    index: np.ndarray,
    known: Cameras | None,
    precision: np.ndarray,
) -> _Normal:
    """Return the normal equations at a point."""
    with np.errstate(all="ignore"):
        pixels, by_point, by_numbers, about, turned = _predict(views, points, cameras, plates)
        residual = views.corners - pixels
        by_world = by_point @ cameras.rotation[views.camera][:, None]
        of_place = np.concatenate([-by_point @ _cross(turned), by_point], axis=-1)
        of_plate = np.concatenate([by_world, -by_world @ _cross(about)], axis=-1)
        rows = np.concatenate([by_numbers, of_place, of_plate, residual[..., None]], axis=-1)
        deviation = noise[views.camera][:, None] * (1.0 if views.spread is None else views.spread)
        rows = (rows / deviation[..., None, None]).reshape(len(views.camera), -1, 22)
        squares = np.ascontiguousarray(np.swapaxes(rows, 1, 2)) @ rows  # (v, 22, 22)
    full, e, b, gb = _gathered(squares, views, cameras, len(plates.position))
    a, ga, cost = full[:-1, :-1][np.ix_(index, index)], full[:-1, -1][index], 0.5 * float(full[-1, -1])
    if known is not None and len(index):
        off = known.minus(cameras)[index]
        a, ga, cost = a + precision, ga + precision @ off, cost + 0.5 * float(off @ precision @ off)
    behind = np.any(turned[..., 2] + cameras.position[views.camera][:, None, 2] <= 0) or not np.isfinite(cost)
    return _Normal(np.inf if behind else cost, a, e[:, index], b, ga, gb)


def _gathered(
    squares: np.ndarray, views: Views, cameras: Cameras, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Add up the views' products of columns (v, 22, 22).

    The columns are nine intrinsics and six pose parameters of the camera, six pose parameters of the plate, and the residual.

    Returns:
        The cameras' normal matrix with right side and cost as last row and column (p + 1, p + 1); their products with the plates'
        columns (k, p, 6); the plates' normal matrices (k, 6, 6) and right sides (k, 6).
    """
    c, p = cameras.n, len(cameras.names)
    full, e, b, gb = np.zeros((p + 1, p + 1)), np.zeros((n, p, 6)), np.zeros((n, 6, 6)), np.zeros((n, 6))
    np.add.at(b, views.plate, squares[:, 15:21, 15:21])
    np.add.at(gb, views.plate, squares[:, 15:21, 21])
    for k in range(c):
        mine = views.camera == k
        place = np.arange(9 * c + 6 * (k - 1), 9 * c + 6 * k) if k else np.zeros(0, int)
        local = np.concatenate([np.arange(9), np.arange(9, 15) if k else place, [21]])
        at = np.concatenate([np.arange(9 * k, 9 * k + 9), place, [p]])
        full[np.ix_(at, at)] += squares[mine].sum(axis=0)[np.ix_(local, local)]
        products = np.zeros((int(mine.sum()), p, 6))
        products[:, at[:-1]] = squares[mine][:, local[:-1], 15:21]
        np.add.at(e, views.plate[mine], products)
    return full, e, b, gb


def _cross(x: np.ndarray) -> np.ndarray:
    """Return the skew-symmetric matrices (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*x.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = x[..., 2], -x[..., 1], x[..., 0]
    return out
