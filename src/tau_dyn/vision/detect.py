"""Corners of the pattern in an image, to a hundredth of a pixel; an image without the complete pattern is rejected with a reason.

OpenCV finds the chessboard (Duda & Frese 2018, else its older detector). The order of its corners depends on detector and
version and may be upside down. Here the colours of the squares determine the order, so that a pose never flips. Then a blurred
crossing of two edges is fitted to the grey values around each corner (`corner_fit.py`). A detector's own estimate is biased by
blur and perspective in its neighbourhood; the crossing is symmetric about the corner, so its fit is unbiased.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from tau_dyn.vision.corner_fit import fit_corners
from tau_dyn.vision.images import Detection, import_opencv
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.solution import apply, estimate_homography

_REACH = 0.38  # half width of the window, relative to a square's side
_MAX_WINDOW_PX = 8  # [px]
_MOVED = 1.5  # [px] a fit farther from the detector's estimate is at another corner


def refine(image: np.ndarray, corners: np.ndarray, pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Return fitted corners (n, 2) and their standard errors (n,) [px]; a failed fit gives the initial corner and nan."""
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    half = int(np.clip(_REACH * _side(grid), 2, _MAX_WINDOW_PX))
    middle = corners.round().astype(int)
    inside = np.all((middle >= half) & (middle < np.array(image.shape[::-1]) - half), axis=1)
    out, stderr = corners.copy(), np.full(len(corners), np.nan)
    if inside.any():
        dv, du = (a.ravel() for a in np.mgrid[-half : half + 1, -half : half + 1])
        at = middle[inside]
        grey = image[at[:, 1, None] + dv, at[:, 0, None] + du].astype(float)
        crossing = np.ones(len(at), bool)
        fit = fit_corners(grey, np.column_stack([du, dv]), corners[inside] - at, _directions(grid)[inside], crossing)
        found = fit.place + at
        good = np.linalg.norm(found - corners[inside], axis=1) < _MOVED
        out[np.flatnonzero(inside)[good]] = found[good]
        stderr[np.flatnonzero(inside)[good]] = fit.stderr[good]
    return out, stderr


def _side(grid: np.ndarray) -> float:
    return min(float(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min()) for a in (0, 1))


def _directions(grid: np.ndarray) -> np.ndarray:
    """Return the directions of rows and columns at each corner (n, 2) [rad]."""
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    return np.stack([np.arctan2(d[..., 1], d[..., 0]).ravel() for d in (along, down)], axis=-1)


_CONTRAST = 25.0  # grey values, smallest usable contrast between dark and light
_MIN_SQUARE_PX = 6.0  # [px] side of a square
_UNEVEN = 0.25  # of a square, largest deviation of corners from the image of a plane, lens corrected
_MAX_BENDING = 0.5
"""Largest tried distortion `k` at the image's corners: a lens of 120 degrees; a fisheye needs another model."""


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
    refined, stderr = refine(image, corners, pattern)
    return _checked(refined, pattern, image)._replace(stderr=stderr)


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
    """Return corners ordered such that columns and rows are along x and y seen from the front, and the first square is black."""
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
    )  # next on the diagonal, so of the colour of the square at the upper left of the first corner
    local = grey - grey.mean() - _trend(grey)
    return float(-(local * black).sum() / max(np.abs(local).sum(), 1e-9))


def _trend(grey: np.ndarray) -> np.ndarray:
    """Return the gradient of the light over the squares, as a plane."""
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
    """Return the largest distance [px] of corners (n, 2) from the image of a plane's points (n, 2)."""
    return float(np.linalg.norm(apply(estimate_homography(flat, corners), flat) - corners, axis=1).max())


def _measure_unevenness_behind_lens(flat: np.ndarray, corners: np.ndarray, shape: tuple[int, ...]) -> float:
    """Return the largest distance [px] of corners from the image of a plane, with a distorted lens.

    The division model about the image's centre (Fitzgibbon 2001) maps a distorted point `d` to `x = d / (1 + k r^2)`, with the
    distance `r` from the centre in half diagonals. If no `k` reduces the distance enough, the corners are not a chessboard.
    """
    middle = 0.5 * np.array(shape[1::-1], dtype=float)
    d = corners - middle
    r2 = np.sum(d**2, axis=1, keepdims=True) / float(middle @ middle)

    def off(k: float) -> float:
        return _measure_unevenness(flat, d / (1 + k * r2))

    found = optimize.minimize_scalar(off, bounds=(-_MAX_BENDING, _MAX_BENDING), method="bounded")
    return float(found.fun)  # type: ignore[attr-defined]


def _why_not(image: np.ndarray, pattern: Pattern) -> Detection:
    """Return the reason why the pattern was not found, and another pattern in the image."""
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
    """Return the size of a chessboard in the image, the longer side first; zeros if there is no chessboard."""
    cv2 = import_opencv()
    try:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        ok, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
    except (cv2.error, AttributeError):
        return 0, 0
    a, b = sorted(meta.shape[:2], reverse=True) if ok else (0, 0)
    return int(a), int(b)
