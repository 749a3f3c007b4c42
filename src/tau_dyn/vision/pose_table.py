"""Measured poses as a table: the pattern in the first camera's frame, with standard errors; rows for calibrate."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.log import format_names, read_table
from tau_dyn.vision.cameras import Cameras

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

    def to_dict(self) -> dict:
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
