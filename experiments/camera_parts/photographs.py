"""Images of a plate with known truth: pinhole, lens, blur, noise, uneven light and a cluttered room.

Rays go backwards: every pixel has `fine` x `fine` rays on a lattice, each meets the plate or the room behind it, and the means
are blurred and given noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial.transform import Rotation

from tau_dyn.vision import Pattern
from tau_dyn.vision.cameras import compute_rays, project

BLACK, WHITE = 35.0, 205.0  # grey values of the print


@dataclass(frozen=True)
class Photography:
    """What comes between the scene and the file.

    Attributes:
        blur: Standard deviation of the point spread [px].
        noise: Standard deviation of a pixel [grey values of 255].
        gradient: Share by which light changes from one side of the image to the other.
        exposure: Factor on all grey values; below 0.2 images are too dark to use.
        fine: Square root of the number of rays of a pixel.
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
        rotation: Of the pattern in the camera's frame (3, 3).
        position: Of the pattern's middle in the camera's frame (3,) [m].
        intrinsics: The camera's nine numbers.
        size: Width and height [px].
        rng: Of the noise.
        background: What is behind the plate (height, width), grey values; plain grey without.
        photography: Blur, noise and light.
        motion: What the plate moves during the exposure, about its pose in the middle of it: shift [m], then rotation vector
            about the camera's axes [rad] (6,).
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
    """Return a room (height, width): soft shades, and boxes, black squares and bars of any grey value before them."""
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
    """Return the rotation (3, 3) of a plate that faces the camera, then is tilted about an axis in it [rad]."""
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    return (Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, 0, roll])).as_matrix()


_PLASTIC = np.array([0.7548776662, 0.5698402910])
"""Powers of the inverse plastic number: shifts by their multiples are spread evenly over a square (Roberts 2018)."""
_MOMENTS_A_PIXEL = 3  # moments of the exposure, each pixel that the plate moves


class _Plate(NamedTuple):
    """A pattern in the frame of a camera with intrinsics `k`."""

    pattern: Pattern
    rotation: np.ndarray
    position: np.ndarray
    k: np.ndarray

    def move(self, motion: np.ndarray) -> _Plate:
        """Return it after a shift [m] and a turn about the camera's axes [rad] (6,)."""
        turned = Rotation.from_rotvec(motion[3:]).as_matrix() @ self.rotation
        return self._replace(rotation=turned, position=self.position + motion[:3])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return where points (n, 3) of the pattern's frame are seen (n, 2) [px]."""
        return project(points @ self.rotation.T + self.position, self.k)


def _expose(image: np.ndarray, plate: _Plate, fine: int, motion: np.ndarray) -> np.ndarray:
    """Return the mean image of a plate at even moments of an exposure."""
    ends = [plate.move(share * motion).project(plate.pattern.points) for share in (-0.5, 0.5)]
    n = 1 + int(np.ceil(_MOMENTS_A_PIXEL * np.linalg.norm(ends[1] - ends[0], axis=1).max()))
    total = np.zeros_like(image)
    few = max(2, int(np.ceil(fine / np.sqrt(n))))  # together the moments have enough rays
    for moment in range(n):
        now = image.copy()
        pair = min(moment, n - 1 - moment)
        shift = (pair + 1) * _PLASTIC % 1 if 2 * moment != n - 1 else np.full(2, 0.5)
        shift = shift if moment == pair else 1 - shift  # in pairs, so that their mean is the middle of a cell
        _draw(now, plate.move(((moment + 0.5) / n - 0.5) * motion), few, shift)
        total += now
    return total / n


def _draw(image: np.ndarray, plate: _Plate, fine: int, shift: float | np.ndarray = 0.5) -> None:
    """Draw the plate where its pixels are; `shift` puts rays within their cells of the lattice."""
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
    by_v, by_u = np.gradient(ray, axis=(0, 1))  # within a pixel rays are even
    n = fine**2
    share = grey = np.zeros(ray.shape[:2])
    for du, dv in (_lattice(n) + shift) / n - 0.5:
        shade, hit = _shade(ray + du * by_u + dv * by_v, plate, half)
        share, grey = share + hit / n, grey + shade * hit / n
    region = image[low[1] : high[1], low[0] : high[0]]
    region[...] = region * (1 - share) + grey


def _lattice(n: int) -> np.ndarray:
    """Return n points (n, 2) of a square of n by n places, one in each row and column: edges along pixels are sampled n times."""
    step = max((k for k in range(1, n) if np.gcd(k, n) == 1), key=lambda k: _spread(k, n)) if n > 1 else 1
    k = np.arange(n)
    return np.column_stack([k, (step * k) % n])


def _spread(step: int, n: int) -> int:
    """Return the least squared distance of two points of a lattice that repeats."""
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
