"""Five black squares in an image (thesis 5.5): candidates, validation by all 20 sides, and 16 corners to a hundredth of a pixel.

Dark quadrilaterals are candidates if all four sides have edges of the right sign. Each is tried as each of the five squares: a
homography predicts the 20 sides, edges are searched perpendicular to them, and the homography is fitted again. A plate is
accepted if all 20 sides are found, the squares are dark, and the area between and around them is white; this excludes a
chessboard or a shelf. The corners are then fitted as blurred wedges (`corner_fit.py`): the 4 of the middle square are
crossings, the 12 others single corners.

The plate looks the same after a quarter turn: here x is to the right in the image; `quarter_turns.py` chooses the turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from tau_dyn.vision.corner_fit import estimate_blur, fit_corners
from tau_dyn.vision.images import Detection, import_opencv
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.solution import apply, estimate_homography

_EDGE_MODEL_PX = 0.01  # [px] rms error of corners of rendered plates without noise: the edge is not exactly a step
_MIN_SIDE_PX = 7.0  # [px] side of a square that can still be measured
_SAMPLES = 9  # points on a side
_MIN_SAMPLES = 7  # samples with an edge on one line; a bar across a side hides more
_REACHES = (0.30, 0.18, 0.12, 0.10)
"""Search distance of sides from their prediction, relative to a side: first predicted by one square, then by all sides."""
_ENOUGH_SIDES = (9, 15, 20, 20)
"""Required sides in each pass; with a distorted lens, far sides are missed in the first pass."""
_STRAIGHT = 0.05  # of a side, largest distance of edge points from its line, at least 0.7 px
_MIN_STEP_NOISES = 5.0  # noise standard deviations of a smoothed edge: five in a row are significant
_MIN_STEP = 4.0  # grey values; smaller steps are lost in quantisation
_EVEN = 0.25  # of the contrast, largest deviation of a cell's mean from black or white
_RING = 0.35  # of a side, width of the white rim around the plate
_REACH = 0.38  # half width of a corner's window, relative to a square's side
_MAX_WINDOW_PX = 14  # [px]
_MOVED = 0.08  # of a side, at least 1.5 px: largest distance of a fit from the sides' crossing
_MAX_BLUR = 0.15  # standard deviation of the blur, relative to a side: with more blur, neighbouring edges merge
_MAX_MOTION_BLUR = 0.06
"""Largest standard deviation of motion blur, of a side: motion by a fifth of it. Above, 95 % intervals cover less than 88 %."""
_UNEVEN = 0.06  # of a side, largest deviation of corners from a homography; a lens of k1 = -0.3 gives 0.03

_GRID = np.array([(c, r) for r in range(4) for c in range(4)], float)
"""Corners (16, 2) in units of squares, row by row."""
_SQUARES = ((0, 0), (2, 0), (1, 1), (0, 2), (2, 2))
"""Column and row of the black squares."""
_SIDES = np.array(
    [
        (4 * (r + y0) + c + x0, 4 * (r + y1) + c + x1)
        for c, r in _SQUARES
        for (x0, y0), (x1, y1) in (((0, 0), (1, 0)), ((1, 0), (1, 1)), ((1, 1), (0, 1)), ((0, 1), (0, 0)))
    ]
)
"""First and last corner of each of the 20 sides, clockwise about its square in image coordinates (y down)."""
_CROSSINGS = np.array([5, 6, 9, 10])
"""The corners of the middle square."""


class _Edges(NamedTuple):
    """Edges along sides: lines `point + s direction` (m, 2), and the number of samples on each (m,)."""

    point: np.ndarray
    direction: np.ndarray
    count: np.ndarray
    step: np.ndarray


class _Search(NamedTuple):
    """An image prepared for the search: smoothed grey values, their noise, and the step that counts as an edge."""

    smooth: np.ndarray
    step: float


def find_squares(image: np.ndarray, pattern: Pattern) -> Detection:
    """Return the pattern's 16 corners in an image (height, width) uint8; several plates are all returned, without a choice."""
    noise = _estimate_noise(image)
    search = _Search(gaussian_filter(image.astype(float), 0.8), max(_MIN_STEP_NOISES * 0.35 * noise, _MIN_STEP))
    plates, best = _find_plates(search, _list_quads(image, noise))
    if not plates:
        return Detection(None, _why_not(image, best))
    found = [_measure(image, grid) for grid in plates]
    good = [d for d in found if d.corners is not None]
    if len(good) > 1:
        middles = [d.corners.mean(axis=0) for d in good if d.corners is not None]
        places = " and ".join(f"({u:.0f}, {v:.0f})" for u, v in middles)
        return Detection(
            None,
            f"{len(good)} plates of five squares are in the image, at pixels {places}; cover those that do not move",
            several=tuple(d.corners for d in good if d.corners is not None),
            several_stderr=tuple(d.stderr for d in good if d.stderr is not None),
        )
    return good[0] if good else found[0]


def _estimate_noise(image: np.ndarray) -> float:
    """Return the standard deviation of a pixel [grey values], by a mask without lines and planes (Immerkaer 1996)."""
    values = image.astype(float)
    rows = values[:-2] - 2 * values[1:-1] + values[2:]
    both = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    return max(float(np.median(np.abs(both))) / (6 * 0.6745), 0.3)  # 0.3: rounding to whole grey values


def _list_quads(image: np.ndarray, noise: float) -> np.ndarray:
    """Return dark quadrilaterals (m, 4, 2) [px], corners clockwise in image coordinates, the largest first."""
    cv2 = import_opencv()
    low, high = np.percentile(image, [1, 99])
    scale = 255 / max(high - low, 8.0)
    level = gaussian_filter(((image - low) * scale).clip(0, 255), 1.0).round().astype(np.uint8)
    offset = float(np.clip(1.2 * noise * scale, 5, 40))
    kernel = np.ones((3, 3), np.uint8)
    quads: list[np.ndarray] = []
    for share in (20, 8, 3):
        block = 2 * int(min(image.shape) / share / 2) + 3
        dark = cv2.adaptiveThreshold(level, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, offset)
        for shrunk in range(1, 5):  # separates squares that touch at their corners
            dark = cv2.erode(dark, kernel)
            contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            quads += [q for c in contours if len(c) > 8 and (q := _fit_quad(c, shrunk)) is not None]
    if not quads:
        return np.zeros((0, 4, 2))
    every = np.array(quads)
    size = np.linalg.norm(every - np.roll(every, 1, axis=1), axis=2).min(axis=1)
    return every[np.argsort(-size, kind="stable")]


def _fit_quad(contour: np.ndarray, shrunk: int) -> np.ndarray | None:
    """Return the corners (4, 2) of a contour that is a quadrilateral, enlarged by the eroded width."""
    cv2 = import_opencv()
    length = cv2.arcLength(contour, True)
    corners = cv2.approxPolyDP(contour, 0.08 * length, True).reshape(-1, 2).astype(float)
    if len(corners) != 4 or not cv2.isContourConvex(corners.astype(np.float32)):
        return None
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    if side.min() + 2 * shrunk < _MIN_SIDE_PX or side.max() > 5 * side.min():
        return None
    ahead = np.roll(corners, -1, axis=0) - corners
    if ahead[0, 0] * ahead[1, 1] - ahead[0, 1] * ahead[1, 0] < 0:
        corners, ahead = corners[::-1], np.roll(corners[::-1], -1, axis=0) - corners[::-1]
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return corners + shrunk * (np.roll(ahead, 1, axis=0) - ahead)


def _find_plates(search: _Search, quads: np.ndarray) -> tuple[list[np.ndarray], int]:
    """Return the corners (16, 2) of each plate, and the number of sides of the best candidate."""
    plates: list[np.ndarray] = []
    best = 0
    if not len(quads):
        return plates, best
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    edges = _seek_edges(search, ends, np.repeat(_measure_side(quads), 4) * 0.25)
    valid = np.all(edges.count.reshape(-1, 4) >= _MIN_SAMPLES, axis=1)
    done: list[tuple[np.ndarray, float]] = []
    for quad in _cross_sides(edges)[valid]:
        middle, side = quad.mean(axis=0), float(_measure_side(quad[None])[0])
        near = any(np.linalg.norm(middle - m) < 0.3 * min(s, side) and 0.6 < s / side < 1.7 for m, s in done)
        if near or not np.isfinite(side) or any(_is_inside(plate, middle) for plate in plates):
            continue
        done.append((middle, side))
        for square in [(quad, 2), *((np.roll(quad, k, axis=0), 0) for k in range(4))]:
            grid, sides = _grow(search, *square)
            best = max(best, sides)
            if grid is not None:
                plates.append(grid)
                break
    return plates, best


def _is_inside(plate: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a point is on a plate whose corners (16, 2) are known."""
    rim = plate[[0, 3, 15, 12]]
    ahead, to = np.roll(rim, -1, axis=0) - rim, point - rim
    return bool(np.all(ahead[:, 0] * to[:, 1] - ahead[:, 1] * to[:, 0] > 0))


def _measure_side(quads: np.ndarray) -> np.ndarray:
    """Return the shortest side (m,) of quadrilaterals (m, 4, 2)."""
    return np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min(axis=1)


def _grow(search: _Search, quad: np.ndarray, square: int) -> tuple[np.ndarray | None, int]:
    """Return the corners (16, 2) of the plate with a quadrilateral as one square, or None, and the number of sides found."""
    c, r = _SQUARES[square]
    known = np.array([(c, r), (c + 1, r), (c + 1, r + 1), (c, r + 1)], float)
    grid = apply(estimate_homography(known, quad), _GRID)
    found = 0
    for reach, enough in zip(_REACHES, _ENOUGH_SIDES, strict=True):
        if not _is_sound(grid, search.smooth.shape):
            return None, found
        side = np.linalg.norm(grid[_SIDES[:, 1]] - grid[_SIDES[:, 0]], axis=1)
        edges = _seek_edges(search, grid[_SIDES], reach * side)
        good = edges.count >= _MIN_SAMPLES
        found = int(good.sum())
        if found < enough:
            return None, found
        grid = _fit_grid(edges, good, grid)
    return (grid if _has_five_squares(search, grid) else None), found


def _is_sound(grid: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Return whether a predicted plate is within the image and faces the camera."""
    if not np.all(np.isfinite(grid)) or np.any(grid < 2) or np.any(grid > np.array(shape[::-1]) - 3):
        return False
    cells = grid.reshape(4, 4, 2)
    along, down = np.diff(cells, axis=1)[:-1], np.diff(cells, axis=0)[:, :-1]
    area = along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]
    lengths = np.concatenate([np.linalg.norm(d, axis=-1).ravel() for d in (along, down)])
    return bool(np.all(area > 0) and lengths.min() > 0.6 * _MIN_SIDE_PX and lengths.max() < 6 * lengths.min())


def _seek_edges(search: _Search, ends: np.ndarray, reach: np.ndarray) -> _Edges:
    """Return edges near clockwise sides (m, 2, 2) with light outside, searched within `reach` (m,) to both sides [px]."""
    first, ahead = ends[:, 0], ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(ahead, axis=1).clip(1e-9)
    direction = ahead / length[:, None]
    outward = np.column_stack([direction[:, 1], -direction[:, 0]])
    share = np.linspace(0.14, 0.86, _SAMPLES)
    half = max(int(np.ceil(reach.max())), 2)
    t = np.arange(-half - 1, half + 2, dtype=float)
    step = np.maximum(reach / half, 0.5)  # a coarse grid for a wide search, never finer than half a pixel
    base = first[:, None] + share[None, :, None] * ahead[:, None]
    at = base[:, :, None] + (step[:, None] * t)[:, None, :, None] * outward[:, None, None]
    grey = map_coordinates(search.smooth, [at[..., 1], at[..., 0]], order=1, mode="nearest")
    rise = grey[..., 2:] - grey[..., :-2]
    k = rise.argmax(axis=-1)
    inner = k.clip(1, rise.shape[-1] - 2)
    left, peak, right = (np.take_along_axis(rise, (inner + d)[..., None], -1)[..., 0] for d in (-1, 0, 1))
    bend = left - 2 * peak + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, 1), 0.0).clip(-1, 1)
    offset = step[:, None] * (t[1:-1][inner] + shift)
    s = share * length[:, None]
    strong = (peak > search.step) & (k == inner)
    line, on = _fit_lines(s, offset, strong, np.maximum(_STRAIGHT * length, 0.7))
    turned = direction + line[:, 1, None] * outward
    turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return _Edges(first + line[:, :1] * outward, turned, on.sum(axis=1), np.where(on, peak, np.nan))


def _fit_lines(
    s: np.ndarray, offset: np.ndarray, strong: np.ndarray, tolerance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and slope (m, 2) of the line with the most samples on it, and the mask of these samples (m, n)."""
    n = s.shape[1]
    pairs = np.array([(a, b) for a in range(n // 2) for b in range(n // 2 + 1, n)])
    slope = (offset[:, pairs[:, 1]] - offset[:, pairs[:, 0]]) / (s[:, pairs[:, 1]] - s[:, pairs[:, 0]])
    start = offset[:, pairs[:, 0]] - slope * s[:, pairs[:, 0]]
    off = np.abs(offset[:, None] - start[..., None] - slope[..., None] * s[:, None])
    on = (off < tolerance[:, None, None]) & strong[:, None]
    best = on.sum(axis=2).argmax(axis=1)
    on = np.take_along_axis(on, best[:, None, None], 1)[:, 0]
    w = on + 1e-9
    total = w.sum(axis=1)
    ms, mo = (w * s).sum(1) / total, (w * offset).sum(1) / total
    ds = s - ms[:, None]
    tilt = (w * ds * (offset - mo[:, None])).sum(1) / np.maximum((w * ds**2).sum(1), 1e-9)
    return np.column_stack([mo - tilt * ms, tilt]), on


def _cross_sides(edges: _Edges) -> np.ndarray:
    """Return the corners (q, 4, 2) where consecutive sides of squares (4 q) cross; the first is before the first side."""
    point, direction = edges.point.reshape(-1, 4, 2), edges.direction.reshape(-1, 4, 2)
    before, along = np.roll(point, 1, axis=1), np.roll(direction, 1, axis=1)
    gap = point - before
    cross = along[..., 0] * direction[..., 1] - along[..., 1] * direction[..., 0]
    with np.errstate(all="ignore"):
        share = (gap[..., 0] * direction[..., 1] - gap[..., 1] * direction[..., 0]) / cross
    return before + share[..., None] * along


def _fit_grid(edges: _Edges, good: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return corners (16, 2) where sides cross, or from the homography if one of the two sides is missing."""
    crossed = _cross_sides(edges).reshape(-1, 2)
    both = good & np.roll(good.reshape(5, 4), 1, axis=1).ravel()
    both &= np.all(np.isfinite(crossed), axis=1)
    total, count = np.zeros_like(grid), np.zeros(len(grid))
    np.add.at(total, _SIDES[both, 0], crossed[both])
    np.add.at(count, _SIDES[both, 0], 1)
    known = count > 0
    if known.sum() < 5:
        return np.full_like(grid, np.nan)
    out = total / np.maximum(count, 1)[:, None]
    if not known.all():
        predicted = apply(estimate_homography(_GRID[known], out[known]), _GRID)
        out[~known] = predicted[~known]
    return out


def _has_five_squares(search: _Search, grid: np.ndarray) -> bool:
    """Return whether five cells are black, the four between and twelve around them white, under linearly varying light."""
    h = estimate_homography(_GRID, grid)
    inside = np.array([(c + 0.5, r + 0.5) for r in range(3) for c in range(3)])
    black = np.arange(9) % 2 == 0
    out = [(k + 0.5, -_RING) for k in range(3)] + [(k + 0.5, 3 + _RING) for k in range(3)]
    ring = np.array(out + [(y, x) for x, y in out] + [(a, b) for a in (-0.25, 3.25) for b in (-0.25, 3.25)])
    middles = np.concatenate([inside, ring])
    black = np.concatenate([black, np.zeros(len(ring), bool)])
    spread = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)], float)
    reach = np.where(np.arange(len(middles)) < 9, 0.25, 0.08)
    at = apply(h, (middles[:, None] + reach[:, None, None] * spread).reshape(-1, 2))
    height, width = search.smooth.shape
    if np.any(at < 0) or np.any(at > (width - 1, height - 1)):
        return False
    grey = map_coordinates(search.smooth, [at[:, 1], at[:, 0]], order=1).reshape(len(middles), 9)
    mean = grey.mean(axis=1)
    flat = middles - 1.5
    a = np.column_stack([np.ones(len(flat)), flat, black, black[:, None] * flat])  # light scales the contrast as well
    weight = np.linalg.lstsq(a, mean, rcond=None)[0]
    contrast = -weight[3]
    return bool(
        contrast > search.step
        and np.abs(mean - a @ weight).max() < _EVEN * contrast
        and np.abs(grey - mean[:, None]).max(axis=1)[:9].max() < 2 * _EVEN * contrast + search.step
    )


def _measure(image: np.ndarray, grid: np.ndarray) -> Detection:
    """Return corners fitted to the grey values about the crossings of the sides, x to the right in the image."""
    cells = grid.reshape(4, 4, 2)
    ahead = [np.rot90(cells, k)[:, -1].mean(0) - np.rot90(cells, k)[:, 0].mean(0) for k in range(4)]
    cells = np.rot90(cells, int(np.argmax([d[0] / np.linalg.norm(d) for d in ahead])))
    corners = cells.reshape(-1, 2)
    side = min(float(np.linalg.norm(np.diff(cells, axis=a), axis=-1).min()) for a in (0, 1))
    if side < _MIN_SIDE_PX:
        return Detection(
            None, f"the pattern is too small: a square is {side:.1f} px wide; come closer or use larger squares"
        )
    half = int(np.clip(_REACH * side, 2, _MAX_WINDOW_PX))
    middle = corners.round().astype(int)
    if np.any(middle < half) or np.any(middle >= np.array(image.shape[::-1]) - half):
        return Detection(None, "the pattern is cut off by the image's border")
    dv, du = (a.ravel() for a in np.mgrid[-half : half + 1, -half : half + 1])
    grey = image[middle[:, 1, None] + dv, middle[:, 0, None] + du].astype(float)
    crossing = np.isin(np.arange(16), _CROSSINGS)
    at = np.column_stack([du, dv])
    first = fit_corners(grey, at, corners - middle, _directions(cells), crossing, each_edge=True)
    blur = estimate_blur(first, crossing)
    fit = fit_corners(grey, at, corners - middle, _directions(cells), crossing, blur=blur)
    found = fit.place + middle
    moved = np.linalg.norm(found - corners, axis=1)
    narrow, wide = np.linalg.eigvalsh(blur)
    if np.sqrt(wide - narrow) > _MAX_MOTION_BLUR * side:
        return Detection(
            None,
            f"the plate moved by {np.sqrt(12 * (wide - narrow)):.1f} px during the exposure, where a square has {side:.0f}; "
            "shorten the exposure, or move slower",
        )
    if np.sqrt(narrow) > _MAX_BLUR * side:
        return Detection(
            None, f"edges are blurred by {np.sqrt(narrow):.1f} px where a square has {side:.0f}; focus the camera"
        )
    if not np.all(moved < max(_MOVED * side, 1.5)) or not np.all(fit.contrast < 0):
        return Detection(None, "a corner of the five squares is not sharp: partly hidden, blurred or reflecting")
    off = np.linalg.norm(apply(estimate_homography(_GRID, found), _GRID) - found, axis=1).max()
    if off > max(_UNEVEN * side, 0.7):
        return Detection(None, f"the corners found are not those of one flat pattern (off by {off:.1f} px)")
    return Detection(found, stderr=np.hypot(fit.stderr, _EDGE_MODEL_PX))


def _directions(cells: np.ndarray) -> np.ndarray:
    """Return directions of both edges at each corner (16, 2) [rad], the black square left of both (`corner_fit`)."""
    out = np.zeros((16, 2))
    for c, r in [s for s in _SQUARES if s != (1, 1)] + [(1, 1)]:
        ring = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
        for k, (row, column) in enumerate(ring):
            ahead = cells[ring[(k + 1) % 4]] - cells[row, column]
            back = cells[row, column] - cells[ring[k - 1]]
            out[4 * row + column] = np.arctan2(ahead[1], ahead[0]), np.arctan2(back[1], back[0])
    return out


def _why_not(image: np.ndarray, sides: int) -> str:
    """Return the reason why no plate was found; `sides` is the number of sides of the best candidate."""
    low, high = np.percentile(image, [1, 99])
    if high - low < 25:
        dark = "too dark" if high < 80 else "too bright" if low > 180 else "without contrast"
        return f"the image is {dark} (grey values {low:.0f} to {high:.0f} of 255); change the light or the exposure"
    if sides == len(_SIDES):
        return "20 sides as of five squares are seen, but not white between and around them: another pattern, or glare"
    if sides >= 15:
        return (
            f"only {sides} of the 20 sides of five squares are sharp: partly hidden, in glare, moved during the exposure, or "
            "another pattern"
        )
    return "no five squares found: not in the image, partly hidden, blurred by focus or motion, too small, or without a white rim"
