"""The calibration pattern: a chessboard or five squares, defined by its corners and the side of a square, which gives the scale.

    z points into the plate; the origin is the centre of the inner corners, where a pose is measured best.

       o--> x     columns of inner corners, with the spacing `square`
       |
       y          rows

The square at the upper left of the first inner corner is black. Five black squares (thesis 5.5) are a board of 3x3 squares with
black corners and a black centre; its points are all 16 corners of squares, and it looks the same after a quarter turn.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from tau_dyn.exceptions import InputError

_MIN_CORNERS = 3  # inner corners per side
FIVE_SQUARES: Final = "five-squares"
"""Name of the plate with five black squares."""


@dataclass(frozen=True)
class Pattern:
    """A chessboard or five squares.

    Attributes:
        columns: Points along x: inner corners of a chessboard, all corners of five squares.
        rows: Points along y.
        square: Side of a square [m].
        kind: `chessboard` or `five-squares`.
    """

    columns: int
    rows: int
    square: float
    kind: Literal["chessboard", "five-squares"] = "chessboard"

    def __post_init__(self) -> None:
        """Reject a chessboard that looks the same upside down, or a pattern without size."""
        if self.kind == "chessboard":
            self._check_corners()
        if not 1e-4 <= self.square <= 1.0:
            raise InputError(
                "invalid_value",
                f"a square of {self.square:g} m is no size for a printed pattern; give the side in m, such as 0.02",
            )

    def _check_corners(self) -> None:
        if min(self.columns, self.rows) < _MIN_CORNERS:
            raise InputError(
                "invalid_value",
                f"a pattern of {self.name} inner corners is too small; it needs 3 a side, and 9x6 is usual",
            )
        if (self.columns + self.rows) % 2 == 0:
            raise InputError(
                "invalid_value",
                f"a pattern of {self.name} inner corners looks the same upside down, so its orientation cannot be determined; "
                f"use one with an odd and an even number, such as {self.columns}x{self.rows - 1}",
            )

    @property
    def name(self) -> str:
        """Name of its size, such as 9x6."""
        return f"{self.columns}x{self.rows}" if self.kind == "chessboard" else self.kind

    @property
    def turns(self) -> int:
        """Number of orientations about z that look the same."""
        return 1 if self.kind == "chessboard" else 4

    @property
    def n(self) -> int:
        """Number of points."""
        return self.columns * self.rows

    @property
    def points(self) -> np.ndarray:
        """Points (n, 3) in the pattern's frame, row by row [m]."""
        row, column = np.divmod(np.arange(self.n), self.columns)
        x, y = column - (self.columns - 1) / 2, row - (self.rows - 1) / 2
        return self.square * np.column_stack([x, y, np.zeros(self.n)])

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and height of all squares [m]."""
        more = 1 if self.kind == "chessboard" else -1
        return 0.5 * self.square * (self.columns + more), 0.5 * self.square * (self.rows + more)


def parse_pattern(size: str, square: float) -> Pattern:
    """Return the pattern of a size, such as `9x6` or `five-squares`, and the side of a square [m].

    Raises:
        InputError: The size is neither that name nor two integers with an x between them, or the pattern cannot be used.
    """
    if size.strip().lower() == FIVE_SQUARES:
        return Pattern(4, 4, square, FIVE_SQUARES)
    found = re.fullmatch(r"\s*(\d{1,3})\s*[xX*]\s*(\d{1,3})\s*", size)
    if found is None:
        raise InputError(
            "bad_option", f"--pattern {size}: write the inner corners as COLUMNSxROWS, such as 9x6, or {FIVE_SQUARES}"
        )
    return Pattern(int(found[1]), int(found[2]), square)
