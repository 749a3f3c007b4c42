"""Images in, measured poses out: `measure_poses_from_images` reads, finds, adjusts, and matches robot positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import format_names
from tau_dyn.vision.album import Album, Images, check_cameras, check_some, read_album
from tau_dyn.vision.bundle import Views
from tau_dyn.vision.cameras import Cameras, check_lens
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.pose_table import CameraPoseTable, Positions
from tau_dyn.vision.solution import CameraSolution, solve


def measure_poses_from_images(
    images: Images,
    pattern: Pattern,
    *,
    second: Images | None = None,
    cameras: Cameras | None = None,
    extra: Images | None = None,
    second_extra: Images | None = None,
    positions: Positions | None = None,
    lens: str = "brown",
    progress: Callable[[str], None] = lambda step: None,
) -> CameraPoseTable:
    """Measure poses of a chessboard plate with one camera or two.

    Args:
        images: The (first) camera's images, or a folder.
        pattern: The chessboard.
        second: The second camera's images of the same moments.
        cameras: Known from before, with covariance; without them the images tell the cameras too.
        extra: Images of the (first) camera that serve to find the cameras only, such as with the plate held by hand.
        second_extra: The second camera's.
        positions: The robot's positions, by image name or order.
        lens: `brown` (k1 k2 p1 p2), `radial` (k1 k2), `brown3` (and k3) or `none`; unused where cameras are given.
        progress: Told what is being done.

    Raises:
        InputError: Files that are no images, of mixed sizes, or none that shows the pattern.
        CannotAnswer: Too few images, or images that do not tell the cameras' numbers.
    """
    check_lens(lens)
    seen = read_album(images, second, extra, second_extra, pattern, progress)
    check_some(seen, pattern)
    if cameras is not None:
        check_cameras(cameras, seen)
    views, labels = _views(seen)
    progress("adjusting the bundle")
    solved = solve(views, pattern, seen.sizes, lens=lens, known=cameras)
    return _table(seen, solved, labels, positions)


def _views(seen: Album) -> tuple[Views, list[tuple[int, int]]]:
    """Return all corners found, and camera and index of the image of each view."""
    labels = [(c, k) for c, of in enumerate(seen.found) for k, d in enumerate(of) if d.corners is not None]
    corners = np.array([seen.found[c][k].corners for c, k in labels])
    moment = np.array([seen.moments[c][k] for c, k in labels])
    return Views(corners, np.array([c for c, _ in labels]), np.unique(moment, return_inverse=True)[1]), labels


def _table(
    seen: Album, solved: CameraSolution, labels: list[tuple[int, int]], positions: Positions | None
) -> CameraPoseTable:
    refused = {
        seen.name(c, k): d.reason for c, of in enumerate(seen.found) for k, d in enumerate(of) if d.corners is None
    }
    refused |= {seen.name(*labels[v]): why for v, why in solved.left_out.items()}
    kept = [labels[v] for v in solved.used]
    plates, names, extra, seen_by = _plates(seen, solved, kept)
    q, joints, warned = _robot(seen, positions, plates, names, extra, kept)
    keep = np.flatnonzero(~extra & (np.isfinite(q).all(axis=1) if joints else True))
    if not len(keep):
        raise CannotAnswer(
            "not_visible",
            "no image of a robot position shows the pattern",
            "take images in which the whole plate can be seen",
        )
    bundle = solved.bundle
    rms = np.array(
        [np.sqrt((bundle.residuals[solved.views.camera == c] ** 2).sum(-1).mean()) for c in range(bundle.cameras.n)]
    )
    return CameraPoseTable(
        names=tuple(names[k] for k in keep),
        position=bundle.plates.position[keep],
        rotation=bundle.plates.rotation[keep],
        covariance=bundle.covariance[keep],
        own=bundle.own[keep],
        seen_by=seen_by[keep],
        joints=joints,
        q=q[keep],
        cameras=bundle.cameras,
        rms=rms,
        refused=refused,
        warnings=(*_doubts(seen, refused, solved, names, keep), *warned),
        inputs=tuple(path for of in seen.paths for path in of),
    )


def _plates(
    seen: Album, solved: CameraSolution, kept: list[tuple[int, int]]
) -> tuple[np.ndarray, list[str], np.ndarray, np.ndarray]:
    """Return for each plate its first view, its image's name, whether it serves the cameras only, and how many saw it."""
    n = len(solved.bundle.plates.position)
    first = np.array([int(np.flatnonzero(solved.views.plate == k)[0]) for k in range(n)])
    names = [seen.name(*kept[v]) for v in first]
    extra = np.array([seen.extra[kept[v][0]][kept[v][1]] for v in first])
    return first, names, extra, np.bincount(solved.views.plate, minlength=n)


def _robot(
    seen: Album,
    positions: Positions | None,
    first: np.ndarray,
    names: list[str],
    extra: np.ndarray,
    kept: list[tuple[int, int]],
) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """Return the robot's positions of each plate (k, na)."""
    if positions is None:
        return np.zeros((len(names), 0)), (), []
    row_of = {}
    usual = [path.name for path, aside in zip(seen.paths[0], seen.extra[0], strict=True) if not aside]
    for moment, q in zip(seen.moments[0], positions.of(usual), strict=False):
        row_of[moment] = q
    nothing = np.full(positions.q.shape[1], np.nan)
    moments = [seen.moments[kept[v][0]][kept[v][1]] for v in first]
    q = np.array([nothing if aside else row_of.get(m, nothing) for m, aside in zip(moments, extra, strict=True)])
    lacking = [
        name for name, row, aside in zip(names, q, extra, strict=True) if not aside and not np.isfinite(row).all()
    ]
    said = f"{len(lacking)} images have no robot position in {positions.source} and served the cameras only: "
    said += format_names(lacking[:5])
    return q, positions.joints, [said] if lacking else []


def _doubts(
    seen: Album, refused: dict[str, str], solved: CameraSolution, names: list[str], keep: np.ndarray
) -> list[str]:
    said = []
    total = sum(len(of) for of in seen.paths)
    if refused:
        some = "; ".join(f"{name}: {why}" for name, why in list(refused.items())[:3])
        said.append(f"{len(refused)} of {total} images were not used. {some}{' ...' if len(refused) > 3 else ''}")
    unsure = [names[k] for k in keep if solved.unsure[k]]
    if unsure:
        said.append(
            f"the tilt of {len(unsure)} plates has two answers of nearly the same picture ({format_names(unsure[:5])}); "
            "their orientations are unsure: tilt the plate by 20 degrees or more, come closer, or use two cameras"
        )
    for c, noise in enumerate(solved.bundle.noise):
        if noise > 0.5:
            said.append(
                f"corners of camera {c + 1} scatter by {noise:.2f} px about the model, which is more than detection does; "
                "a lens model is missing, the plate is not flat, or images are blurred"
            )
    return said
