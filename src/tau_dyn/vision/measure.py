"""Images in, measured poses out: read, find, adjust, match robot positions; a table with standard errors for calibrate."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import format_names, read_table
from tau_dyn.vision.album import Album, Images, check_cameras, check_some, read_album
from tau_dyn.vision.bundle import Views
from tau_dyn.vision.cameras import Cameras, check_lens
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.solution import CameraSolution, solve

POSE = ("x_tool", "y_tool", "z_tool", "qx_tool", "qy_tool", "qz_tool", "qw_tool")
STDERR = ("x_tool_stderr", "y_tool_stderr", "z_tool_stderr", "rx_tool_stderr", "ry_tool_stderr", "rz_tool_stderr")


def escape_formula(text: str) -> str:
    """Return text as a spreadsheet shows it: what begins like a formula gets an apostrophe before it."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


@dataclass(frozen=True, eq=False)
class CameraPoseTable:
    """Poses of the pattern's middle in the first camera's frame.

    Attributes:
        names: The image (the first camera's, where it saw the plate) of each pose (N,).
        position: (N, 3) [m].
        rotation: (N, 3, 3).
        covariance: (N, 6, 6) of position [m] and rotation vector about the camera's axes [rad].
        own: The part of it from the pose's own corners; the rest is common to all poses, through the cameras.
        seen_by: How many cameras saw each (N,).
        joints: Names of actuated joints, where robot positions were given.
        q: Robot positions (N, na).
        cameras: The cameras, with uncertainty.
        rms: Of all corners' residuals in each camera (c,) [px].
        refused: Image -> why it was not used.
        warnings: What was doubtful.
        inputs: Files read.
    """

    names: tuple[str, ...]
    position: np.ndarray
    rotation: np.ndarray
    covariance: np.ndarray
    own: np.ndarray
    seen_by: np.ndarray
    joints: tuple[str, ...]
    q: np.ndarray
    cameras: Cameras
    rms: np.ndarray
    refused: dict[str, str]
    warnings: tuple[str, ...] = ()
    inputs: tuple[Path, ...] = ()

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.names)

    @property
    def quaternion(self) -> np.ndarray:
        """Orientation x y z w (N, 4), w >= 0."""
        return Rotation.from_matrix(self.rotation).as_quat(canonical=True)

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors (N, 6) of position [m] and rotation vector [rad]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def common_stderr(self) -> np.ndarray:
        """Standard errors of positions (N,) [m] that stem from the cameras and so are alike in all poses."""
        common = np.diagonal(self.covariance - self.own, axis1=1, axis2=2)[:, :3]
        return np.sqrt(common.sum(axis=1).clip(0))

    def to_csv(self) -> str:
        """Return the table as text: image, q_J, pose, standard errors."""
        out = io.StringIO()
        write = csv.writer(out, lineterminator="\n")
        write.writerow(["image", *(f"q_{j}" for j in self.joints), *POSE, *STDERR])
        rows = np.hstack([self.q, self.position, self.quaternion, self.stderr])
        for name, row in zip(self.names, rows, strict=True):
            write.writerow([escape_formula(name), *(f"{v:.9g}" for v in row)])
        return out.getvalue()

    def to_dict(self) -> dict[str, Any]:
        """Return what a result file holds."""
        return {
            **self.cameras.to_dict(),
            "rms_px": self.rms,
            "n_poses": self.n,
            "position_stderr": {"median": float(np.median(np.linalg.norm(self.stderr[:, :3], axis=1))), "unit": "m"},
            "position_stderr_common": {"median": float(np.median(self.common_stderr)), "unit": "m"},
            "rotation_stderr": {"median": float(np.median(np.linalg.norm(self.stderr[:, 3:], axis=1))), "unit": "rad"},
            "refused": [{"image": name, "why": why} for name, why in self.refused.items()],
            "poses": [
                {
                    "image": name,
                    "position": self.position[k],
                    "quaternion": self.quaternion[k],
                    "stderr": self.stderr[k],
                    "cameras": int(self.seen_by[k]),
                }
                for k, name in enumerate(self.names)
            ],
        }


@dataclass(frozen=True, eq=False)
class Positions:
    """Robot positions, by image name where the file has a column `image`, else by order.

    Attributes:
        joints: Names of actuated joints.
        q: (N, na).
        images: File names (N,), None where the order counts.
        source: File.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    images: tuple[str, ...] | None
    source: str

    def of(self, names: Sequence[str]) -> np.ndarray:
        """Return the rows (n, na) that belong to images, nan where an image has none.

        Raises:
            InputError: Rows cannot be matched to images.
        """
        if self.images is None:
            if len(names) != len(self.q):
                raise InputError(
                    "missing_column",
                    f"{self.source} has {len(self.q)} rows for {len(names)} images and no column image that says which belong "
                    "together; add one with the file names of the (first) camera's images",
                )
            return self.q
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice:
            raise InputError(
                "duplicate_name",
                f"two images are called {twice}, so {self.source} cannot say which is meant; give them names of their own",
            )
        row = {name: k for k, name in enumerate(self.images)}
        unknown = [name for name in self.images if name not in set(names)]
        if len(unknown) == len(self.images):
            raise InputError(
                "mismatch",
                f"{self.source}, column image: {unknown[0]} and all others are not among the images, such as {names[0]}",
            )
        if unknown:
            raise InputError(
                "mismatch", f"{self.source}, column image: {format_names(unknown[:5])} not among the images given"
            )
        return np.array([self.q[row[n]] if n in row else np.full(self.q.shape[1], np.nan) for n in names]).reshape(
            len(names), -1
        )


def read_positions(path: str | Path) -> Positions:
    """Read robot positions: columns `q_J`, and maybe `image` with file names.

    Raises:
        InputError: No column q_J, a cell that is no number, or an image named twice.
    """
    table = read_table(path)
    columns = [name for name in table.cells if name.startswith("q_") and len(name) > 2]
    if not columns:
        raise InputError(
            "missing_column",
            f"{table.name} has no column q_<joint>; robot positions need one for each actuated joint; "
            f"it has {format_names(table.cells)}",
        )
    q = np.column_stack([table.numbers(name) for name in columns])
    images = None
    if "image" in table.cells:
        images = tuple(Path(str(cell).strip()).name for cell in table.cells["image"])
        twice = next((name for k, name in enumerate(images) if name in images[:k]), None)
        if twice:
            raise InputError(
                "duplicate_name",
                f"{table.name}, column image: {twice} stands there twice; every image is of one position",
            )
    return Positions(tuple(name[2:] for name in columns), q, images, table.name)


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
