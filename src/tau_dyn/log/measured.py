"""Measured points and poses: actuated positions and where a measuring device saw a point, without a clock.

Columns as the contract has them: `q_J` for each actuated joint, `x_tool y_tool z_tool` [m], `qx_tool qy_tool qz_tool qw_tool`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log.table import read_table

POSITION = ("x_tool", "y_tool", "z_tool")
QUATERNION = ("qx_tool", "qy_tool", "qz_tool", "qw_tool")


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """A file of measured points.

    Attributes:
        name: File name.
        sha256: Hash of the file.
        joints: Joints whose positions it has, in the order asked for.
        q: Their positions (N, k) [m or rad].
        points: Measured positions (N, 3) [m]; None without all three columns.
        quaternions: Measured orientations (N, 4), x y z w; None without all four columns.
        warnings: What was left out while reading.
    """

    name: str
    sha256: str
    joints: tuple[str, ...]
    q: np.ndarray
    points: np.ndarray | None
    quaternions: np.ndarray | None
    warnings: tuple[str, ...]

    def column(self, joint: str) -> np.ndarray:
        """Return one joint's positions (N,).

        Raises:
            InputError: The file does not have them.
        """
        if joint not in self.joints:
            raise InputError(
                "missing_column", f"{self.name} has no column q_{joint}; it is needed to know where {joint} was"
            )
        return self.q[:, self.joints.index(joint)]


def read_measured(path: str | Path, actuated: Sequence[str]) -> MeasuredPoints:
    """Read a file of measured points.

    Args:
        path: CSV or Parquet.
        actuated: The robot's actuated joints.

    Raises:
        InputError: The file cannot be read, has no `q_J` column of this robot, or a cell is no number.
    """
    table = read_table(path)
    joints = tuple(j for j in actuated if f"q_{j}" in table.cells)
    if not joints:
        raise InputError(
            "missing_column",
            f"{table.name} has no column q_J of an actuated joint; it needs q_{', q_'.join(actuated)} or some of them",
        )
    points, quaternions = (
        np.column_stack([table.numbers(c) for c in wanted]) if all(c in table.cells for c in wanted) else None
        for wanted in (POSITION, QUATERNION)
    )
    if quaternions is not None:
        sizes = np.linalg.norm(quaternions, axis=1)
        wrong = np.flatnonzero(np.abs(sizes - 1) > 1e-3)
        if wrong.size:
            k = int(wrong[0])
            raise InputError(
                "bad_sample", f"{table.where(k)}: the quaternion qx_tool .. qw_tool has length {sizes[k]:.4g}, not 1"
            )
    q = np.column_stack([table.numbers(f"q_{j}") for j in joints])
    return MeasuredPoints(table.name, table.sha256, joints, q, points, quaternions, table.warnings)
