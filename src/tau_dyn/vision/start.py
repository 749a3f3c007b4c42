"""Where a bundle adjustment starts: focal lengths from pictures of planes, plates before each camera, cameras to each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.vision.bundle import Bundle, Plates, Views, adjust
from tau_dyn.vision.cameras import Cameras
from tau_dyn.vision.homography import (
    compute_mirrored_tilt,
    compute_plane_pose,
    estimate_focal_length,
    estimate_homography,
)
from tau_dyn.vision.pattern import Pattern


def estimate_initial_cameras(views: Views, pattern: Pattern, sizes: np.ndarray, lens: str) -> Cameras:
    """Return cameras in one place with focal lengths from the images (c, 2 sizes) and no distortion."""
    n = len(sizes)
    inner = np.zeros((n, 9))
    flat = pattern.points[:, :2]
    for c in range(n):
        middle = (sizes[c] - 1) / 2
        pictures = [estimate_homography(flat, corners) for corners in views.corners[views.camera == c]]
        f = estimate_focal_length(pictures, middle)
        width = float(sizes[c].max())
        inner[c, :4] = [*[f if f is not None and 0.3 * width < f < 20 * width else 1.2 * width] * 2, *middle]
    return Cameras(inner, np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), sizes, lens)


def estimate_view_poses(views: Views, pattern: Pattern, cameras: Cameras) -> tuple[Plates, np.ndarray]:
    """Return a plate for each view in its own camera's frame (v), the better of two tilts, and by how much it is (v,).

    The margin is the difference in weighted squared residuals, with a noise of 1 px; small where both tilts explain the picture.
    """
    alone = replace(cameras, rotation=np.tile(np.eye(3), (cameras.n, 1, 1)), position=np.zeros((cameras.n, 3)))
    seen = Views(views.corners, views.camera, np.arange(len(views.camera)))
    starts = [
        compute_plane_pose(estimate_homography(pattern.points[:, :2], c), cameras.intrinsics[k])
        for c, k in zip(views.corners, views.camera, strict=True)
    ]
    one = Plates(np.array([r for r, _ in starts]), np.array([t for _, t in starts]))
    first = _alone(seen, pattern, alone, one)
    other = Plates(
        np.array([compute_mirrored_tilt(r, t) for r, t in zip(*first.plates, strict=True)]), first.plates.position
    )
    second = _alone(seen, pattern, alone, other)
    costs = np.array([(b.residuals**2).sum(axis=(1, 2)) for b in (first, second)])
    better = costs[1] < costs[0]
    rotation = np.where(better[:, None, None], second.plates.rotation, first.plates.rotation)
    position = np.where(better[:, None], second.plates.position, first.plates.position)
    same = Rotation.from_matrix(
        np.swapaxes(first.plates.rotation, 1, 2) @ second.plates.rotation
    ).magnitude() < np.radians(2)
    return Plates(rotation, position), np.where(same, np.inf, np.abs(costs[1] - costs[0]))


def _alone(views: Views, pattern: Pattern, cameras: Cameras, plates: Plates) -> Bundle:
    return adjust(
        views, pattern.points, cameras, plates, noise=np.ones(cameras.n), free=np.zeros(len(cameras.names), bool)
    )


def estimate_relative_cameras(views: Views, plates: Plates, cameras: Cameras) -> Cameras:
    """Return cameras at their places to the first, the medians over plates that both see; `plates` one a view.

    Raises:
        CannotAnswer: Two cameras see no plate at one moment.
    """
    rotation, position = cameras.rotation.copy(), cameras.position.copy()
    first = {plate: k for k, plate in enumerate(views.plate) if views.camera[k] == 0}
    for c in range(1, cameras.n):
        pairs = [(first[views.plate[k]], k) for k in np.flatnonzero(views.camera == c) if views.plate[k] in first]
        if not pairs:
            raise CannotAnswer(
                "not_visible",
                f"no image pair shows the pattern to camera 1 and camera {c + 1} at one moment, so their places to each other "
                "are unknown",
                "take images of the plate where both cameras see it whole",
            )
        turned = np.array([plates.rotation[k] @ plates.rotation[i].T for i, k in pairs])
        middle = _median_rotation(turned)
        shifts = [plates.position[k] - middle @ plates.position[i] for i, k in pairs]
        rotation[c], position[c] = middle, np.median(shifts, axis=0)
    return replace(cameras, rotation=rotation, position=position)


def _median_rotation(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to all others (m, 3, 3); a few wrong tilts do not move it."""
    trace = np.einsum("aij,bij->ab", rotations, rotations)
    angle = np.arccos(((trace - 1) / 2).clip(-1, 1))
    return rotations[int(np.argmin(angle.sum(axis=1)))]


def estimate_rig_poses(views: Views, plates: Plates, cameras: Cameras) -> Plates:
    """Return one plate a moment in the first camera's frame, from the view of the first camera that saw it."""
    n = int(views.plate.max()) + 1
    rotation, position = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for k in reversed(range(len(views.camera))):
        back = cameras.rotation[views.camera[k]].T
        if k == int(
            np.flatnonzero(views.plate == views.plate[k])[np.argmin(views.camera[views.plate == views.plate[k]])]
        ):
            rotation[views.plate[k]] = back @ plates.rotation[k]
            position[views.plate[k]] = back @ (plates.position[k] - cameras.position[views.camera[k]])
    return Plates(rotation, position)
