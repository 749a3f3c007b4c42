"""The calibration pattern: a chessboard on a plate, known by its inner corners and the size of a square, which gives the scale.

    z is into the plate; the origin is the middle of the inner corners, where a pose is measured best.

       o--> x     columns of inner corners, `square` apart
       |
       y          rows

The square left above the first inner corner is black.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError

_MIN_CORNERS = 3  # inner corners a side


@dataclass(frozen=True)
class Pattern:
    """A chessboard.

    Attributes:
        columns: Inner corners along x.
        rows: Inner corners along y.
        square: Side of a square [m].
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        """Refuse a pattern that cannot be told from itself upside down, or that has no size."""
        if min(self.columns, self.rows) < _MIN_CORNERS:
            raise InputError(
                "invalid_value",
                f"a pattern of {self.name} inner corners is too small; it needs 3 a side, and 9x6 is usual",
            )
        if (self.columns + self.rows) % 2 == 0:
            raise InputError(
                "invalid_value",
                f"a pattern of {self.name} inner corners looks the same upside down, so its orientation cannot be told; "
                f"use one with an odd and an even number, such as {self.columns}x{self.rows - 1}",
            )
        if not 1e-4 <= self.square <= 1.0:
            raise InputError(
                "invalid_value",
                f"a square of {self.square:g} m is no size for a printed pattern; give the side in m, such as 0.02",
            )

    @property
    def name(self) -> str:
        """Its size in words, such as 9x6."""
        return f"{self.columns}x{self.rows}"

    @property
    def n(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def points(self) -> np.ndarray:
        """Inner corners (n, 3) in the pattern's frame, row by row [m]."""
        row, column = np.divmod(np.arange(self.n), self.columns)
        x, y = column - (self.columns - 1) / 2, row - (self.rows - 1) / 2
        return self.square * np.column_stack([x, y, np.zeros(self.n)])

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and height of all squares [m]."""
        return 0.5 * self.square * (self.columns + 1), 0.5 * self.square * (self.rows + 1)


def parse_pattern(size: str, square: float) -> Pattern:
    """Return the pattern that `9x6` and a square [m] describe.

    Raises:
        InputError: Not two whole numbers with an x between them, or a pattern that cannot be used.
    """
    found = re.fullmatch(r"\s*(\d{1,3})\s*[xX*]\s*(\d{1,3})\s*", size)
    if found is None:
        raise InputError("bad_option", f"--pattern {size}: write the inner corners as COLUMNSxROWS, such as 9x6")
    return Pattern(int(found[1]), int(found[2]), square)
