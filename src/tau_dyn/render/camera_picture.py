"""The expected image of a camera, in the camera's resolution, to overlay on the live image: robot, pattern, border and axes.

The image has only lines, on a transparent background or on an image of the camera. Colours: robot blue, expected pattern green
with its first corner (upper left) marked, detected pattern red, border and principal axes of the image grey.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn.calibrate.poses import Camera, list_bones
from tau_dyn.kinematics import HalfSpace
from tau_dyn.kinematics.workspace import WorkspaceModel
from tau_dyn.mechanism import Poses
from tau_dyn.render.pictures import encode_png, outline_solid
from tau_dyn.render.sketch import compute_hull

_BLUE, _GREEN, _RED, _GREY = (46, 124, 214), (30, 170, 70), (214, 48, 48), (128, 128, 128)
_MIN_DEPTH_M = 0.05  # depth in front of the camera at which lines are clipped
_DASH = 12.0  # [px] length of the dashes of the axes

Line = tuple[np.ndarray, tuple[int, int, int], int]
"""Points (n, 2) [px], colour, and width [px]."""


def draw_camera_picture(
    camera: Camera,
    machine: WorkspaceModel,
    q: np.ndarray,
    tool: Poses,
    *,
    taken: np.ndarray | None = None,
    found: Poses | None = None,
) -> bytes:
    """Return the expected image of a camera as a PNG file.

    Args:
        camera: The camera at its planned pose.
        machine: The robot.
        q: Its actuated positions (na,).
        tool: The tool's pose (1) at these positions.
        taken: Grey values (height, width) of an image of the camera, as background.
        found: The pattern's pose (1) detected in it, in the camera's frame.
    """
    width, height = camera.image
    picture = np.zeros((height, width, 4), np.uint8)
    if taken is not None:
        picture[..., :3], picture[..., 3] = taken[..., None], 255
    for points, colour, wide in _list_lines(camera, machine, q, tool, found):
        _draw(picture, points, colour, wide)
    return encode_png(picture)


def _list_lines(
    camera: Camera, machine: WorkspaceModel, q: np.ndarray, tool: Poses, found: Poses | None
) -> Iterator[Line]:
    width, height = camera.image
    u, v = camera.centre
    yield np.array([[1, 1], [width - 2, 1], [width - 2, height - 2], [1, height - 2], [1, 1]], float), _GREY, 3
    for start, end in (((0, v), (width - 1, v)), ((u, 0), (u, height - 1))):
        for a, b in _dash(np.array(start, float), np.array(end, float)):
            yield np.array([a, b]), _GREY, 1
    for solid in machine.solids(q[None], tool):
        if not isinstance(solid.shape, HalfSpace):
            yield from _outline(camera, outline_solid(solid), _BLUE)
    for ends in list_bones(machine, q[None]).transpose(1, 0, 2):
        yield from _cut(camera, _to_camera(camera, ends), _BLUE, 3)
    yield from _pattern(camera, camera.frames.measured(tool, np.zeros(1, int)), _GREEN)
    if found is not None:
        yield from _pattern(camera, found, _RED)


def _to_camera(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) [m] of the base frame in the camera's frame."""
    return (points - camera.pose.translation) @ camera.pose.rotation


def _outline(camera: Camera, points: np.ndarray, colour: tuple[int, int, int]) -> Iterator[Line]:
    """Yield the outline of points (n, 3) [m] of the base frame, a line for two points, if it is in front of the camera."""
    local = _to_camera(camera, points)
    if len(points) == 2:
        yield from _cut(camera, local, colour, 3)
    elif (local[:, 2] > _MIN_DEPTH_M).all():
        flat = camera.project(local[None])[0]
        around = compute_hull(flat)
        if around is not None:
            yield flat[[*around, around[0]]], colour, 2


def _cut(camera: Camera, ends: np.ndarray, colour: tuple[int, int, int], wide: int) -> Iterator[Line]:
    """Yield a line between two points (2, 3) [m] in the camera's frame, clipped at the smallest depth."""
    a, b = ends if ends[0, 2] >= ends[1, 2] else ends[::-1]
    if a[2] <= _MIN_DEPTH_M:
        return
    if b[2] < _MIN_DEPTH_M:
        b = a + (b - a) * (a[2] - _MIN_DEPTH_M) / (a[2] - b[2])
    yield camera.project(np.array([a, b])[None])[0], colour, wide


def _pattern(camera: Camera, at: Poses, colour: tuple[int, int, int]) -> Iterator[Line]:
    """Yield the lines of a pattern's grid at a pose (1) in the camera's frame, and a square about its first corner."""
    corners = camera.place_corners(at)[0]
    if (corners[:, 2] <= _MIN_DEPTH_M).any():
        return
    pattern = camera.pattern
    grid = camera.project(corners[None])[0].reshape(pattern.rows, pattern.columns, 2)
    for lines in (grid, grid.transpose(1, 0, 2)):
        for line in lines:
            yield line, colour, 1
    rim = [*grid[0], *grid[1:, -1], *grid[-1, ::-1], *grid[::-1, 0]]
    yield np.array(rim), colour, 3
    first = grid[-1, 0]  # rows run upwards; the printed pattern's first corner is at the upper left
    half = 0.5 * float(np.linalg.norm(grid[-1, 1] - first))
    yield first + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]), colour, 2


def _dash(start: np.ndarray, end: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    length = float(np.linalg.norm(end - start))
    along = (end - start) / max(length, 1e-9)
    for at in np.arange(0.0, length, 2 * _DASH):
        yield start + at * along, start + min(at + _DASH, length) * along


def _draw(picture: np.ndarray, points: np.ndarray, colour: tuple[int, int, int], wide: int) -> None:
    """Draw lines through points (n, 2) [px] into a picture (height, width, 4)."""
    height, width = picture.shape[:2]
    offsets = np.arange(wide) - wide // 2
    dv, du = (a.ravel() for a in np.meshgrid(offsets, offsets, indexing="ij"))
    for start, end in zip(points[:-1], points[1:], strict=True):
        part = _clip(start, end, np.array([-wide, -wide]), np.array([width + wide, height + wide]))
        if part is None:
            continue
        n = 2 * int(np.ceil(np.abs(part[1] - part[0]).max())) + 2
        at = np.rint(part[0] + np.linspace(0, 1, n)[:, None] * (part[1] - part[0])).astype(int)
        u, v = (at[:, :1] + du).ravel(), (at[:, 1:] + dv).ravel()
        good = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        picture[v[good], u[good]] = (*colour, 255)


def _clip(
    start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the part of a line within a rectangle, or `None` if it is outside (Liang & Barsky 1984)."""
    along, first, last = end - start, 0.0, 1.0
    for axis in (0, 1):
        if abs(along[axis]) < 1e-12:
            if not low[axis] <= start[axis] <= high[axis]:
                return None
            continue
        near, far = sorted((np.array([low[axis], high[axis]]) - start[axis]) / along[axis])
        first, last = max(first, float(near)), min(last, float(far))
    return None if first > last else (start + first * along, start + last * along)
