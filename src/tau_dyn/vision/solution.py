"""Cameras and plates from corners: initial values, adjustment with the noise of the residuals, and rejection of outlier images.

The initial values are focal lengths from images of planes (homographies by direct linear transformation, Hartley 1997), then
plates relative to each camera, then the relative poses of cameras. Quantities that the images do not determine are reported, not
guessed: if a plate has the same tilt in all images (as on a robot whose plate only translates), only the lens distortion
separates the focal length from the distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.vision.bundle import Bundle, Plates, Views, adjust
from tau_dyn.vision.cameras import Cameras
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.quarter_turns import choose_view_turns, turn_views


def estimate_homography(flat: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return `H` (3, 3) with pixels ~ H [flat; 1], least squares, from points (n, 2) and pixels (n, 2), n >= 4."""
    (a, ta), (b, tb) = _normalised(flat), _normalised(pixels)
    one, zero = np.ones(len(a)), np.zeros((len(a), 3))
    p = np.column_stack([a, one])
    rows = np.concatenate([np.hstack([p, zero, -b[:, :1] * p]), np.hstack([zero, p, -b[:, 1:] * p])])
    h = np.linalg.inv(tb) @ np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3) @ ta
    return h / np.linalg.norm(h)


def apply(h: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Return pixels (n, 2) of points (n, 2)."""
    at = np.column_stack([flat, np.ones(len(flat))]) @ h.T
    return at[:, :2] / at[:, 2:]


def estimate_focal_length(homographies: list[np.ndarray], middle: np.ndarray) -> float | None:
    """Return the focal length [px] of square pixels with the principal point at `middle` (2,), or `None` if it is not determined.

    Zhang 2000, (3) and (4): the plane's axes are orthogonal and of equal length, which gives two equations in 1 / f^2 per image.
    """
    shift = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, 1.0]])
    a, b = [], []
    for h in homographies:
        g = shift @ h
        g = g / np.linalg.norm(g[:, :2])
        for x, y in ((g[:, 0], g[:, 1]), (g[:, 0] + g[:, 1], g[:, 0] - g[:, 1])):
            a.append(x[0] * y[0] + x[1] * y[1])
            b.append(-x[2] * y[2])
    square = np.dot(a, a)
    inverse = np.dot(a, b) / square if square > 0 else 0.0
    return float(1 / np.sqrt(inverse)) if inverse > 0 else None


def compute_plane_pose(h: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and position (3,) of a plane relative to a pinhole `k` (fx, fy, cx, cy), from its homography."""
    m = np.linalg.inv(np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1.0]])) @ h
    m = m / np.sqrt(np.linalg.norm(m[:, 0]) * np.linalg.norm(m[:, 1]))
    m = -m if m[2, 2] < 0 else m
    u, _, vt = np.linalg.svd(np.column_stack([m[:, 0], m[:, 1], np.cross(m[:, 0], m[:, 1])]))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, m[:, 2]


def compute_mirrored_tilt(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the other rotation that gives almost the same image: the plate's normal mirrored about the line of sight.

    Schweighofer & Pinz 2006: a small or far plane has two poses with almost the same image.
    """
    sight = position / np.linalg.norm(position)
    normal = rotation[:, 2]
    mirrored = 2 * (normal @ sight) * sight - normal
    axis = np.cross(normal, mirrored)
    s, c = np.linalg.norm(axis), float(normal @ mirrored)
    if s < 1e-9:
        return rotation
    axis = axis / s
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return (np.eye(3) + s * cross + (1 - c) * cross @ cross) @ rotation


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points relative to their mean, scaled to a mean distance of sqrt 2, and the transformation (3, 3)."""
    middle = points.mean(axis=0)
    scale = np.sqrt(2) / np.linalg.norm(points - middle, axis=1).mean()
    t = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
    return scale * (points - middle), t


def estimate_initial_cameras(views: Views, pattern: Pattern, sizes: np.ndarray, lens: str) -> Cameras:
    """Return cameras at the same pose with focal lengths from the images, whose sizes are (c, 2), and no distortion."""
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
    """Return a plate for each view in its own camera's frame (v), with the better of two tilts, and its margin (v,).

    The margin is the difference in weighted squared residuals, with a noise of 1 px; it is small if both tilts explain the image.
    """
    alone = replace(cameras, rotation=np.tile(np.eye(3), (cameras.n, 1, 1)), position=np.zeros((cameras.n, 3)))
    seen = views._replace(plate=np.arange(len(views.camera)))
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
    """Return cameras with their poses relative to the first, the medians over plates that both see; one plate per view.

    Raises:
        CannotAnswer: Two cameras never see a plate at the same moment.
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
    """Return one plate per moment in the first camera's frame, from the view of the first camera that saw it."""
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


MIN_VIEWS = 4
"""Smallest number of views of a camera with unknown intrinsics."""

_MAX_RELATIVE_FOCAL_STDERR = 0.02  # relative standard error of a focal length above which poses are useless
_OUTLIER_LIMITS = (4.0, 0.3)  # times the median residual, and [px], above which an image is an outlier
_MIN_CHI2_DIFFERENCE = 25.0  # difference of squared residuals, in corner variances, that decides between two tilts


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """Cameras and plates estimated from corners.

    Attributes:
        bundle: Cameras and plates.
        views: Used views; plates numbered as in `bundle`.
        used: Index of the used views among those given (v',).
        left_out: Index of omitted views, with the reason.
        unsure: Mask of plates (k,) that only one camera sees and whose tilt is ambiguous.
    """

    bundle: Bundle
    views: Views
    used: np.ndarray
    left_out: dict[int, str]
    unsure: np.ndarray


def solve(
    views: Views, pattern: Pattern, sizes: np.ndarray, *, lens: str = "brown", known: Cameras | None = None
) -> CameraSolution:
    """Return cameras and plates from corners.

    Args:
        views: Corners in images.
        pattern: The pattern.
        sizes: Width and height of each camera's images (c, 2) [px].
        lens: Lens model of unknown cameras.
        known: Known cameras, with covariance.

    Raises:
        CannotAnswer: Too few images, or images that do not determine the cameras.
    """
    _enough(views, len(sizes), known)
    views = _match_turns(views, pattern, sizes, lens, known) if pattern.turns > 1 else views
    used, left_out = np.arange(len(views.camera)), {}
    for _ in range(3):
        now = views.take(used)
        bundle, margin = _solved(now, pattern, sizes, lens, known)
        size = np.sqrt((now.scale(bundle.residuals) ** 2).sum(axis=2).mean(axis=1))
        off = size > np.maximum(_OUTLIER_LIMITS[0] * np.median(size), _OUTLIER_LIMITS[1])
        if not off.any() or off.sum() > 0.25 * len(off):
            break
        for k in np.flatnonzero(off):
            left_out[int(used[k])] = (
                f"its corners are {size[k]:.1f} px from where all images together put them, the others' {np.median(size):.2f} px"
            )
        used = used[~off]
    _determined(bundle, known)
    return CameraSolution(bundle, now, used, left_out, _unsure(bundle, now, margin))


def _enough(views: Views, n_cameras: int, known: Cameras | None) -> None:
    for c in range(n_cameras):
        n = int((views.camera == c).sum())
        if n < (1 if known is not None else MIN_VIEWS):
            raise CannotAnswer(
                "too_little_data",
                f"{n} image{'' if n == 1 else 's'} of camera {c + 1} show{'s' if n == 1 else ''} the pattern; "
                f"its focal length and lens need {MIN_VIEWS} or more",
                "take 15 images of the plate at tilts of 20 to 45 degrees that together fill the image, or give known cameras",
            )


def _match_turns(views: Views, pattern: Pattern, sizes: np.ndarray, lens: str, known: Cameras | None) -> Views:
    """Return views in which all cameras see a plate in the same one of its equivalent quarter turns."""
    start = known or estimate_initial_cameras(views, pattern, sizes, lens)
    each, _ = estimate_view_poses(views, pattern, start)
    return turn_views(views, choose_view_turns(views, each, start, known is not None), pattern)


def _solved(
    views: Views, pattern: Pattern, sizes: np.ndarray, lens: str, known: Cameras | None
) -> tuple[Bundle, np.ndarray]:
    points = pattern.points
    start = known or estimate_initial_cameras(views, pattern, sizes, lens)
    each, margin = estimate_view_poses(views, pattern, start)
    if known is None:
        start = estimate_relative_cameras(views, each, start)
    plates = estimate_rig_poses(views, each, start)
    noise = np.ones(len(sizes))
    bundle = adjust(views, points, start, plates, noise=noise, known=known)
    for _ in range(2):
        noise = _noise(bundle, views, known)
        bundle = adjust(views, points, bundle.cameras, bundle.plates, noise=noise, known=known)
    if known is None and np.bincount(views.plate).min() == 1:  # tilts were chosen with the initial, inaccurate cameras
        margin = estimate_view_poses(views, pattern, bundle.cameras)[1]
    return bundle, margin


def _noise(bundle: Bundle, views: Views, known: Cameras | None) -> np.ndarray:
    """Return each camera's corner noise from its residuals, corrected for the degrees of freedom [px]."""
    rows = 2 * views.corners.shape[0] * views.corners.shape[1]
    unknown = 6 * len(bundle.plates.position) + (0 if known is not None else len(bundle.scaled))
    share = np.sqrt(rows / max(rows - unknown, 1))
    scaled = views.scale(bundle.residuals)
    size = [np.sqrt(np.mean(scaled[views.camera == c] ** 2)) for c in range(bundle.cameras.n)]
    return np.maximum(share * np.array(size), 1e-4)


def _determined(bundle: Bundle, known: Cameras | None) -> None:
    """Reject cameras whose focal length the images do not determine."""
    for c, name in ((c, n) for c in range(bundle.cameras.n) for n in (0, 1)):
        f, stderr = bundle.cameras.intrinsics[c, name], bundle.cameras.stderr[9 * c + name]
        singular = known is None and np.linalg.eigvalsh(bundle.scaled)[0] < 1e-12
        if singular or not stderr < _MAX_RELATIVE_FOCAL_STDERR * abs(f):
            raise CannotAnswer(
                "not_identifiable",
                f"the images do not determine the focal length of camera {c + 1} from the distance of the plate "
                f"(f = {f:.0f} px, 95 % interval [{f - 1.96 * stderr:.0f}, {f + 1.96 * stderr:.0f}] px): the plate "
                f"has nearly the same tilt in all of them",
                "take ten more images with the plate held by hand at tilts of 20 to 45 degrees in several directions (they need "
                "no robot positions), or give cameras known from before",
            )


def _unsure(bundle: Bundle, views: Views, margin: np.ndarray) -> np.ndarray:
    """Return the mask of plates (k,) that are seen once and may have the other tilt."""
    count = np.bincount(views.plate, minlength=len(bundle.plates.position))
    out = np.zeros(len(count), bool)
    doubt = margin < _MIN_CHI2_DIFFERENCE * bundle.noise[views.camera] ** 2
    out[views.plate[doubt]] = True
    return out & (count == 1)
