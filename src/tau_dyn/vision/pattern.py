"""The calibration pattern: a chessboard or five squares, defined by its corners and the side of a square, which gives the scale.

    z points into the plate; the origin is the centre of the inner corners, where a pose is measured best.

       o--> x     columns of inner corners, with the spacing `square`
       |
       y          rows

The square at the upper left of the first inner corner is black. Five black squares (thesis 5.5) are a board of 3x3 squares with
black corners and a black centre; its points are all 16 corners of squares, and it looks the same after a quarter turn.

Rendered images of a plate with known truth (pinhole, lens, blur, noise, uneven light and a cluttered room) test the detection,
and a camera's pose before it is mounted. Every pixel has `fine` x `fine` rays on a lattice (ray tracing from the camera); each
meets the plate or the room behind it. The mean of the rays is blurred, and noise is added.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.vision.cameras import compute_rays, project

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
                f"a pattern of {self.name} inner corners looks the same upside down, so its orientation cannot be told; "
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


BLACK, WHITE = 35.0, 205.0  # grey values of the print


@dataclass(frozen=True)
class Photography:
    """Imaging effects between the scene and the file.

    Attributes:
        blur: Standard deviation of the point spread function [px].
        noise: Standard deviation of a pixel [grey values of 255].
        gradient: Relative change of light from one side of the image to the other.
        exposure: Factor on all grey values; below 0.2 images are too dark to use.
        fine: Square root of the number of rays per pixel.
    """

    blur: float = 0.7
    noise: float = 2.0
    gradient: float = 0.4
    exposure: float = 1.0
    fine: int = 4


def render(
    pattern: Pattern,
    rotation: np.ndarray,
    position: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    rng: np.random.Generator,
    *,
    background: np.ndarray | None = None,
    photography: Photography | None = None,
    motion: np.ndarray | None = None,
) -> np.ndarray:
    """Return an image (height, width) uint8 of a plate.

    Args:
        pattern: The pattern; its plate has a white rim one square wide.
        rotation: Rotation of the pattern in the camera's frame (3, 3).
        position: Position of the pattern's centre in the camera's frame (3,) [m].
        intrinsics: The camera's nine intrinsics.
        size: Width and height [px].
        rng: Random generator of the noise.
        background: Grey values (height, width) behind the plate; uniform grey if None.
        photography: Blur, noise and light.
        motion: Motion of the plate (6,) during the exposure, centred at the given pose: translation [m], then rotation vector
            about the camera's axes [rad].
    """
    photo = photography or Photography()
    width, height = size
    image = np.full((height, width), 90.0) if background is None else background.astype(float).copy()
    plate = _Plate(pattern, rotation, position, np.asarray(intrinsics, float))
    if motion is None:
        _draw(image, plate, photo.fine)
    else:
        image = _expose(image, plate, photo.fine, motion)
    image *= photo.exposure * _light(width, height, photo.gradient, rng)
    image = gaussian_filter(image, photo.blur) if photo.blur > 0 else image
    image += photo.noise * rng.standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def render_clutter(size: tuple[int, int], rng: np.random.Generator, *, things: int = 60) -> np.ndarray:
    """Return an image of a room (height, width): soft shades, and boxes, black squares and bars of any grey value in front."""
    width, height = size
    coarse = rng.uniform(60, 160, (5, 7))
    image = np.asarray(zoom(coarse, (height / 5, width / 7), order=1))[:height, :width]
    v, u = np.mgrid[0:height, 0:width]
    for _ in range(things):
        angle, middle = rng.uniform(0, np.pi), rng.uniform((0, 0), (width, height))
        half = rng.uniform(3, 0.06 * width, 2) * rng.choice([1.0, 1.0, 2.5], 2)
        along = np.cos(angle) * (u - middle[0]) + np.sin(angle) * (v - middle[1])
        across = np.cos(angle) * (v - middle[1]) - np.sin(angle) * (u - middle[0])
        image[(np.abs(along) < half[0]) & (np.abs(across) < half[1])] = rng.choice([20.0, 60.0, 120.0, 200.0])
    return image


def draw_facing_rotation(tilt: float, towards: float, roll: float) -> np.ndarray:
    """Return the rotation (3, 3) of a plate that faces the camera, then is tilted about an axis in its plane [rad]."""
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    return (Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, 0, roll])).as_matrix()


_PLASTIC = np.array([0.7548776662, 0.5698402910])
"""Powers of the inverse plastic number: shifts by their multiples are spread evenly over a square (Roberts 2018)."""
_MOMENTS_A_PIXEL = 3  # moments of the exposure per pixel of the plate's motion


class _Plate(NamedTuple):
    """A pattern in the frame of a camera with intrinsics `k`."""

    pattern: Pattern
    rotation: np.ndarray
    position: np.ndarray
    k: np.ndarray

    def move(self, motion: np.ndarray) -> _Plate:
        """Return the plate after a translation [m] and a rotation about the camera's axes [rad] (6,)."""
        turned = Rotation.from_rotvec(motion[3:]).as_matrix() @ self.rotation
        return self._replace(rotation=turned, position=self.position + motion[:3])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (n, 2) [px] of points (n, 3) in the pattern's frame."""
        return project(points @ self.rotation.T + self.position, self.k)


def _expose(image: np.ndarray, plate: _Plate, fine: int, motion: np.ndarray) -> np.ndarray:
    """Return the mean image of a plate at equally spaced moments of an exposure."""
    ends = [plate.move(share * motion).project(plate.pattern.points) for share in (-0.5, 0.5)]
    n = 1 + int(np.ceil(_MOMENTS_A_PIXEL * np.linalg.norm(ends[1] - ends[0], axis=1).max()))
    total = np.zeros_like(image)
    few = max(2, int(np.ceil(fine / np.sqrt(n))))  # together the moments have enough rays
    for moment in range(n):
        now = image.copy()
        pair = min(moment, n - 1 - moment)
        shift = (pair + 1) * _PLASTIC % 1 if 2 * moment != n - 1 else np.full(2, 0.5)
        shift = shift if moment == pair else 1 - shift  # in pairs, so that their mean is the centre of a cell
        _draw(now, plate.move(((moment + 0.5) / n - 0.5) * motion), few, shift)
        total += now
    return total / n


def _draw(image: np.ndarray, plate: _Plate, fine: int, shift: float | np.ndarray = 0.5) -> None:
    """Draw the pixels of the plate; `shift` is the position of rays within the cells of their lattice."""
    half = np.array(plate.pattern.half_size) + plate.pattern.square
    rim = np.array([[sx * half[0], sy * half[1], 0.0] for sx in (-1, 0, 1) for sy in (-1, 0, 1)])
    if np.any(rim @ plate.rotation[2] + plate.position[2] <= 1e-3):
        return
    seen = plate.project(rim)
    height, width = image.shape
    low = np.clip(np.floor(seen.min(axis=0) - 4), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(seen.max(axis=0) + 5), 0, [width, height]).astype(int)
    if np.any(high <= low):
        return
    ray = compute_rays(
        np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), axis=-1), plate.k
    )
    by_v, by_u = np.gradient(ray, axis=(0, 1))  # within a pixel, rays vary linearly
    n = fine**2
    share = grey = np.zeros(ray.shape[:2])
    for du, dv in (_lattice(n) + shift) / n - 0.5:
        shade, hit = _shade(ray + du * by_u + dv * by_v, plate, half)
        share, grey = share + hit / n, grey + shade * hit / n
    region = image[low[1] : high[1], low[0] : high[0]]
    region[...] = region * (1 - share) + grey


def _lattice(n: int) -> np.ndarray:
    """Return n points (n, 2) of a grid of n by n cells, one in each row and column: edges along pixels are sampled n times."""
    step = max((k for k in range(1, n) if np.gcd(k, n) == 1), key=lambda k: _spread(k, n)) if n > 1 else 1
    k = np.arange(n)
    return np.column_stack([k, (step * k) % n])


def _spread(step: int, n: int) -> int:
    """Return the smallest squared distance between two points of a periodic lattice."""
    k = np.arange(1, n)
    y = (step * k) % n
    return int(np.min(np.minimum(k, n - k) ** 2 + np.minimum(y, n - y) ** 2))


def _shade(ray: np.ndarray, plate: _Plate, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the print's grey value where rays meet the plate, and whether they do."""
    normal, square = plate.rotation[:, 2], plate.pattern.square
    towards = np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1)
    with np.errstate(all="ignore"):
        depth = (normal @ plate.position) / (towards @ normal)
        x, y = ((depth[..., None] * towards - plate.position) @ plate.rotation[:, :2]).transpose(2, 0, 1)
        hit = (depth > 0) & (np.abs(x) < half[0]) & (np.abs(y) < half[1])
        inside = (np.abs(x) < half[0] - square) & (np.abs(y) < half[1] - square)
        squares = np.floor((x + half[0]) / square) + np.floor((y + half[1]) / square)
        black = inside & (np.mod(squares, 2) == 0)
    return np.where(black, BLACK, WHITE), hit


def _light(width: int, height: int, gradient: float, rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    u, v = np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height)
    return 1 - gradient * (0.5 + np.cos(angle) * u[None, :] + np.sin(angle) * v[:, None]).clip(0, 1)
