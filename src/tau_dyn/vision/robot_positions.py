"""Robot positions at images: one row per image, by name or order, or a log with its own clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import format_names, read_table
from tau_dyn.vision.motion import JointLog, read_image_names, read_increasing


@dataclass(frozen=True, eq=False)
class Positions:
    """Robot positions, by image name if the file has a column `image`, by time if it has a column `t`, else by order.

    Attributes:
        joints: Names of actuated joints.
        q: Positions (N, na).
        images: File names (N,), or None if rows are matched by order.
        source: File.
        log: The positions over time, if the file has a column `t` and no column `image`.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    images: tuple[str, ...] | None
    source: str
    log: JointLog | None = None

    def of(self, names: Sequence[str]) -> np.ndarray:
        """Return the rows (n, na) that belong to images; nan for an image without a row.

        Raises:
            InputError: Rows cannot be matched to images.
        """
        if self.log is not None and len(names) != len(self.q):
            raise InputError(
                "missing_input",
                f"{self.source} is a log of {len(self.q)} rows for {len(names)} images; give the times of the images (--times), "
                "or one row for each image",
            )
        return match_rows(self.q, self.images, names, self.source)


def match_rows(rows: np.ndarray, images: Sequence[str] | None, names: Sequence[str], source: str) -> np.ndarray:
    """Return the rows (n, m) that belong to images with the file names `names` (n,); nan for an image without a row.

    Args:
        rows: Values (N, m).
        images: File names (N,), or None if rows are matched by order.
        names: The (first) camera's images.
        source: File of the rows, for messages.

    Raises:
        InputError: Rows cannot be matched to images.
    """
    if images is None:
        if len(names) != len(rows):
            raise InputError(
                "missing_column",
                f"{source} has {len(rows)} rows for {len(names)} images and no column image that says which belong "
                "together; add one with the file names of the (first) camera's images",
            )
        return rows
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice:
        raise InputError(
            "duplicate_name",
            f"two images are called {twice}, so {source} does not show which is meant; give them names of their own",
        )
    row = {name: k for k, name in enumerate(images)}
    unknown = [name for name in images if name not in set(names)]
    if len(unknown) == len(images):
        raise InputError(
            "mismatch",
            f"{source}, column image: {unknown[0]} and all others are not among the images, such as {names[0]}",
        )
    if unknown:
        raise InputError("mismatch", f"{source}, column image: {format_names(unknown[:5])} not among the images given")
    return np.array([rows[row[n]] if n in row else np.full(rows.shape[1], np.nan) for n in names]).reshape(
        len(names), -1
    )


def read_positions(path: str | Path) -> Positions:
    """Read robot positions: columns `q_J`, and optionally `image` with file names, or `t` [s] of a log with its own clock.

    Raises:
        InputError: There is no column q_J, a cell is not a number, an image is named twice, or times of a log do not increase.
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
    images = read_image_names(table)
    joints, log = tuple(name[2:] for name in columns), None
    if "t" in table.cells and images is None and table.n_rows > 3:
        log = JointLog(read_increasing(table, "t"), q, table.name)
    return Positions(joints, q, images, table.name, log)
