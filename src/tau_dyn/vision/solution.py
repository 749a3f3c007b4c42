"""From corners to cameras and plates: start, adjustment with the noise that the residuals show, and images that do not belong.

What images cannot tell is said, not guessed: a plate tilted alike in all images (as on a robot whose plate only
translates) leaves the focal length and the distance to be told apart by the lens' bending alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.vision.bundle import Bundle, Views, adjust
from tau_dyn.vision.cameras import Cameras
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.start import (
    estimate_initial_cameras,
    estimate_relative_cameras,
    estimate_rig_poses,
    estimate_view_poses,
)

MIN_VIEWS = 4
"""Views a camera of unknown numbers needs."""

_MAX_RELATIVE_FOCAL_STDERR = 0.02  # relative standard error of a focal length that makes poses worthless
_OUTLIER_LIMITS = (4.0, 0.3)  # times the median residual, and [px], beyond which an image does not belong to the others
_MIN_CHI2_DIFFERENCE = 25.0  # difference of squared residuals, in corner variances, at which one of two tilts is taken


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """What the corners say.

    Attributes:
        bundle: Cameras and plates.
        views: Those used; plates numbered as in `bundle`.
        used: Index of the used views among those given (v',).
        left_out: Index of views left out, with the reason.
        unsure: Plates (k,) seen by one camera only whose tilt has two answers.
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
        pattern: The chessboard.
        sizes: Width and height of each camera's images (c, 2) [px].
        lens: Lens model of cameras not known from before.
        known: Cameras from before, with covariance.

    Raises:
        CannotAnswer: Too few images, or images that do not tell the cameras' numbers.
    """
    _enough(views, len(sizes), known)
    used, left_out = np.arange(len(views.camera)), {}
    for _ in range(3):
        now = views.take(used)
        bundle, margin = _solved(now, pattern, sizes, lens, known)
        size = np.sqrt((bundle.residuals**2).sum(axis=2).mean(axis=1))
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
    if known is None and np.bincount(views.plate).min() == 1:  # tilts were chosen with the first, rough cameras
        margin = estimate_view_poses(views, pattern, bundle.cameras)[1]
    return bundle, margin


def _noise(bundle: Bundle, views: Views, known: Cameras | None) -> np.ndarray:
    """Return each camera's corner noise from its residuals, unknowns taken off [px]."""
    rows = 2 * views.corners.shape[0] * views.corners.shape[1]
    unknown = 6 * len(bundle.plates.position) + (0 if known is not None else len(bundle.scaled))
    share = np.sqrt(rows / max(rows - unknown, 1))
    size = [np.sqrt(np.mean(bundle.residuals[views.camera == c] ** 2)) for c in range(bundle.cameras.n)]
    return np.maximum(share * np.array(size), 1e-4)


def _determined(bundle: Bundle, known: Cameras | None) -> None:
    """Refuse cameras whose focal length the images do not tell."""
    for c, name in ((c, n) for c in range(bundle.cameras.n) for n in (0, 1)):
        f, stderr = bundle.cameras.intrinsics[c, name], bundle.cameras.stderr[9 * c + name]
        singular = known is None and np.linalg.eigvalsh(bundle.scaled)[0] < 1e-12
        if singular or not stderr < _MAX_RELATIVE_FOCAL_STDERR * abs(f):
            raise CannotAnswer(
                "not_identifiable",
                f"the images do not tell the focal length of camera {c + 1} from the distance of the plate "
                f"(f = {f:.0f} px, 95 % interval [{f - 1.96 * stderr:.0f}, {f + 1.96 * stderr:.0f}] px): the plate "
                f"has nearly the same tilt in all of them",
                "take ten more images with the plate held by hand at tilts of 20 to 45 degrees in several directions (they need "
                "no robot positions), or give cameras known from before",
            )


def _unsure(bundle: Bundle, views: Views, margin: np.ndarray) -> np.ndarray:
    """Return which plates (k,) are seen once and may be tilted the other way."""
    count = np.bincount(views.plate, minlength=len(bundle.plates.position))
    out = np.zeros(len(count), bool)
    doubt = margin < _MIN_CHI2_DIFFERENCE * bundle.noise[views.camera] ** 2
    out[views.plate[doubt]] = True
    return out & (count == 1)
