"""Corners of the pattern in an image, to a hundredth of a pixel; an image that does not show it whole is refused with a reason.

OpenCV finds the chessboard (Duda & Frese 2018, else its older detector). The order in which it returns the corners depends on
detector and version and may be upside down; it is settled here by the colours of the squares, so that a pose never flips. Then a
blurred crossing of two edges is fitted to the grey values about each corner, by Gauss-Newton with step limits for all at once:

    I(p) = a + g . d + b erf(n1 . d / (sqrt 2 s)) erf(n2 . d / (sqrt 2 s)),   d = p - corner,  n_i = (-sin a_i, cos a_i)

A detector's own guess stems from a neighbourhood that blur and perspective pull to one side; the crossing is symmetric about the
corner, so its fit is not.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from scipy import optimize
from scipy.special import erf

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.solution import apply, estimate_homography

_REACH = 0.38  # of a square's side that the window reaches, each way
_MAX_WINDOW_PX = 8  # [px]
_MOVED = 1.5  # [px] farther from the detector's guess, the fit went elsewhere
_ROOT = np.sqrt(2 / np.pi)


def refine(image: np.ndarray, corners: np.ndarray, pattern: Pattern) -> np.ndarray:
    """Return corners (n, 2) [px] fitted to an image, the given ones where the fit fails."""
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    half = int(np.clip(_REACH * _side(grid), 2, _MAX_WINDOW_PX))
    middle = corners.round().astype(int)
    inside = np.all((middle >= half) & (middle < np.array(image.shape[::-1]) - half), axis=1)
    out = corners.copy()
    if inside.any():
        dv, du = (a.ravel() for a in np.mgrid[-half : half + 1, -half : half + 1])
        at = middle[inside]
        grey = image[at[:, 1, None] + dv, at[:, 0, None] + du].astype(float)
        found = _fit(grey, np.column_stack([du, dv]), corners[inside] - at, _directions(grid)[inside])
        good = np.linalg.norm(found + at - corners[inside], axis=1) < _MOVED
        out[np.flatnonzero(inside)[good]] = (found + at)[good]
    return out


def _side(grid: np.ndarray) -> float:
    return min(float(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min()) for a in (0, 1))


def _directions(grid: np.ndarray) -> np.ndarray:
    """Return the directions of rows and columns at each corner (n, 2) [rad]."""
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    return np.stack([np.arctan2(d[..., 1], d[..., 0]).ravel() for d in (along, down)], axis=-1)


def _fit(grey: np.ndarray, at: np.ndarray, start: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return corners (n, 2) about the windows' middles from grey values (n, w) at offsets (w, 2); nan where nothing fits."""
    n = len(grey)
    theta = np.column_stack([start, directions, np.full(n, 0.8), grey.mean(1), np.zeros((n, 2)), np.zeros(n)])
    value, jacobian = _model(theta, at)
    pattern = jacobian[..., 8]
    theta[:, 8] = ((grey - grey.mean(1, keepdims=True)) * pattern).sum(1) / np.maximum((pattern**2).sum(1), 1e-9)
    limit = np.array([0.5, 0.5, 0.2, 0.2, 0.3, np.inf, np.inf, np.inf, np.inf])
    for _ in range(15):
        value, jacobian = _model(theta, at)
        normal = np.einsum("nwi,nwj->nij", jacobian, jacobian)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(9) + 1e-12 * np.eye(9)
        step = np.linalg.solve(normal, np.einsum("nwi,nw->ni", jacobian, grey - value)[..., None])[..., 0]
        step = np.clip(step, -limit, limit)
        theta = theta + step
        theta[:, 4] = theta[:, 4].clip(0.3, 4.0)
        if np.abs(step[:, :2]).max() < 1e-4:
            break
    still = np.abs(step[:, :2]).max(axis=1) < 5e-3
    return np.where(still[:, None], theta[:, :2], np.nan)


def _model(theta: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey values (n, w) and their derivatives (n, w, 9) by corner, directions, blur, light, gradient, contrast."""
    d = at[None] - theta[:, None, :2]
    s, b = theta[:, 4, None], theta[:, 8, None]
    f, df, x, across = [], [], [], []
    for column in (2, 3):
        sin, cos = np.sin(theta[:, column, None]), np.cos(theta[:, column, None])
        x.append((-sin * d[..., 0] + cos * d[..., 1]) / s)
        across.append((-(cos * d[..., 0] + sin * d[..., 1]), -sin, cos))
        f.append(erf(x[-1] / np.sqrt(2)))
        df.append(_ROOT * np.exp(-0.5 * x[-1] ** 2) / s)
    one, two = b * df[0] * f[1], b * df[1] * f[0]
    out = np.empty((*d.shape[:2], 9))
    for axis in (0, 1):
        out[..., axis] = -(one * across[0][1 + axis] + two * across[1][1 + axis]) - theta[:, 6 + axis, None]
        out[..., 6 + axis] = d[..., axis]
    out[..., 2], out[..., 3] = one * across[0][0], two * across[1][0]
    out[..., 4] = -(one * x[0] + two * x[1])
    out[..., 5], out[..., 8] = 1.0, f[0] * f[1]
    value = theta[:, 5, None] + (theta[:, None, 6:8] * d).sum(-1) + b * f[0] * f[1]
    return value, out


_CONTRAST = 25.0  # grey values between dark and light below which an image is of no use
_MIN_SQUARE_PX = 6.0  # [px] side of a square
_UNEVEN = 0.25  # of a square that corners may be off the plane's picture, the lens accounted for
_MAX_BENDING = 0.5
"""Largest distortion `k` at the image's corners that is tried: a lens of 120 degrees; a fisheye needs another model."""


_MAX_FILE_BYTES = 1 << 30  # bytes of one file
_MAX_PIXELS = 1 << 28  # the largest cameras have 1.5e8


def import_opencv() -> ModuleType:
    """Return OpenCV, which only this room needs.

    Raises:
        InputError: It is not installed.
    """
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MAX_PIXELS))  # a small PNG may declare gigabytes
    try:
        import cv2
    except ImportError as fault:
        raise InputError(
            "missing_package", "reading images needs OpenCV; install it with: pip install 'tau_dyn[vision]'"
        ) from fault
    return cv2


def read_image(path: Path) -> np.ndarray:
    """Return grey values (height, width) uint8; 16-bit images are scaled to their own range.

    Raises:
        InputError: Not readable, or not an image.
    """
    cv2 = import_opencv()
    try:
        data = np.frombuffer(read_bytes(path, _MAX_FILE_BYTES), np.uint8)
    except OSError as fault:
        raise InputError("cannot_read", f"{path}: cannot be read ({fault.strerror or fault})") from fault
    try:
        image = (
            cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
            if data.size
            else None
        )
    except cv2.error:
        image = None
    if image is None:
        raise InputError("damaged_file", f"{path}: not an image that can be read; give PNG, JPEG, TIFF or BMP")
    if image.size > _MAX_PIXELS:  # where OpenCV was there before us
        raise InputError("file_format", f"{path}: {image.shape[1]}x{image.shape[0]} pixels; that is no photograph")
    if image.dtype != np.uint8:
        top = max(float(np.nanmax(image)), 1e-9)
        image = np.clip(255.0 * image / top, 0, 255).astype(np.uint8)
    return image


class Detection(NamedTuple):
    """What was found in an image.

    Attributes:
        corners: (n, 2) [px] in the pattern's order, None where the pattern was not found.
        reason: Why not, '' where it was.
        other: Size of another pattern that is in the image, '' where none is.
    """

    corners: np.ndarray | None
    reason: str = ""
    other: str = ""


def find_corners(image: np.ndarray, pattern: Pattern) -> Detection:
    """Return the pattern's inner corners in an image (height, width) uint8."""
    low, high = np.percentile(image, [1, 99])
    if high - low < _CONTRAST:
        dark = "too dark" if high < 80 else "too bright" if low > 180 else "without contrast"
        return Detection(
            None, f"the image is {dark} (grey values {low:.0f} to {high:.0f} of 255); change the light or the exposure"
        )
    corners = _search(image, pattern)
    if corners is None:
        return _why_not(image, pattern)
    corners = _in_order(image, corners, pattern)
    if corners is None:
        return Detection(None, "black and white do not alternate as on a chessboard")
    return _checked(refine(image, corners, pattern), pattern, image)


def _search(image: np.ndarray, pattern: Pattern) -> np.ndarray | None:
    cv2 = import_opencv()
    size = (pattern.columns, pattern.rows)
    quick = cv2.CALIB_CB_NORMALIZE_IMAGE
    try:
        for flags in (quick, quick | cv2.CALIB_CB_EXHAUSTIVE):
            ok, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
            if ok:
                return corners.reshape(-1, 2).astype(float)
        ok, corners = cv2.findChessboardCorners(
            image, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not ok:
            return None
        side = np.linalg.norm(np.diff(corners.reshape(-1, 2)[: pattern.columns], axis=0), axis=1).min()
        half = int(np.clip(0.35 * side, 2, 9))
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
        return (
            cv2.cornerSubPix(image, np.ascontiguousarray(corners, np.float32), (half, half), (-1, -1), enough)
            .reshape(-1, 2)
            .astype(float)
        )
    except cv2.error:
        return None


def _in_order(image: np.ndarray, corners: np.ndarray, pattern: Pattern) -> np.ndarray | None:
    """Return corners so that columns run to rows as x to y seen from the front, and the first square is black."""
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    along, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if along[0] * down[1] - along[1] * down[0] < 0:  # seen from behind: mirrored
        grid = grid[:, ::-1]
    sign = _blackness(image, grid)
    if abs(sign) < 0.5:
        return None
    return (grid if sign > 0 else grid[::-1, ::-1]).reshape(-1, 2)


def _blackness(image: np.ndarray, grid: np.ndarray) -> float:
    """Return the correlation between the squares' colours and those of a pattern whose first inner square is black."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    u, v = (middles[..., i].round().astype(int).clip(1, image.shape[1 - i] - 2) for i in (0, 1))
    grey = np.mean([image[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=0)
    row, column = np.indices(grey.shape)
    black = np.where(
        (row + column) % 2 == 0, 1.0, -1.0
    )  # same colour as the square left above the first corner, one diagonal on
    local = grey - grey.mean() - _trend(grey)
    return float(-(local * black).sum() / max(np.abs(local).sum(), 1e-9))


def _trend(grey: np.ndarray) -> np.ndarray:
    """Return the light's gradient over the squares, as a plane."""
    row, column = np.indices(grey.shape)
    black = (row + column) % 2
    a = np.column_stack([np.ones(grey.size), row.ravel(), column.ravel(), black.ravel()])
    weight = np.linalg.lstsq(a, grey.ravel(), rcond=None)[0]
    return (a[:, 1:3] @ weight[1:3]).reshape(grey.shape) - (a[:, 1:3] @ weight[1:3]).mean()


def _checked(corners: np.ndarray, pattern: Pattern, image: np.ndarray) -> Detection:
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    side = min(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min() for a in (0, 1))
    if side < _MIN_SQUARE_PX:
        return Detection(
            None, f"the pattern is too small: a square is {side:.1f} px wide; come closer or use larger squares"
        )
    if np.any(corners < 1) or np.any(corners > np.array(image.shape[::-1]) - 2):
        return Detection(None, "the pattern is cut off by the image's border")
    flat = pattern.points[:, :2] / pattern.square
    off = _measure_unevenness(flat, corners)
    if off > _UNEVEN * side:
        off = _measure_unevenness_behind_lens(flat, corners, image.shape)
    if off > _UNEVEN * side:
        return Detection(None, f"the corners found are not those of one flat pattern (off by {off:.1f} px)")
    return Detection(corners)


def _measure_unevenness(flat: np.ndarray, corners: np.ndarray) -> float:
    """Return the largest distance [px] of corners (n, 2) from the picture of a plane's points (n, 2)."""
    return float(np.linalg.norm(apply(estimate_homography(flat, corners), flat) - corners, axis=1).max())


def _measure_unevenness_behind_lens(flat: np.ndarray, corners: np.ndarray, shape: tuple[int, ...]) -> float:
    """Return the same behind a lens that bends straight lines, by the division model about the image's middle.

    With `r` the distance from the middle in half diagonals, `x = d / (1 + k r^2)` is where a lens without distortion would have
    put what stands at `d` (Fitzgibbon 2001). Corners that no `k` makes even are no chessboard.
    """
    middle = 0.5 * np.array(shape[1::-1], dtype=float)
    d = corners - middle
    r2 = np.sum(d**2, axis=1, keepdims=True) / float(middle @ middle)

    def off(k: float) -> float:
        return _measure_unevenness(flat, d / (1 + k * r2))

    found = optimize.minimize_scalar(off, bounds=(-_MAX_BENDING, _MAX_BENDING), method="bounded")
    return float(found.fun)  # type: ignore[attr-defined]


def _why_not(image: np.ndarray, pattern: Pattern) -> Detection:
    """Return what is in the image instead."""
    columns, rows = _other(image)
    other = f"{columns}x{rows}" if rows else ""
    if not other or {columns, rows} == {pattern.columns, pattern.rows}:
        return Detection(
            None, f"no {pattern.name} pattern found: not in the image, partly hidden, blurred, or of another size"
        )
    if columns * rows < pattern.n:
        said = f"only {other} corners of the {pattern.name} can be seen: partly hidden, or another pattern"
        return Detection(None, said, other)
    return Detection(None, f"the pattern in the image has {other} inner corners, not {pattern.name}", other)


def _other(image: np.ndarray) -> tuple[int, int]:
    """Return the size of whatever chessboard is in the image, the longer side first; zeros where there is none."""
    cv2 = import_opencv()
    try:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        ok, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
    except (cv2.error, AttributeError):
        return 0, 0
    a, b = sorted(meta.shape[:2], reverse=True) if ok else (0, 0)
    return int(a), int(b)
