"""Volume, centre and moments of the solid inside a triangle mesh, as MuJoCo computes them (mesh attribute `inertia`).

The solid is the sum of tetrahedra from the triangles to a point. Signed volumes are exact for closed surfaces (`exact`); absolute
ones, about the surface's centroid for the centre and about that for the rest, are MuJoCo's default (`legacy`), which also holds
for surfaces with wrongly turned triangles.
Reference: Mirtich 1996, J. Graphics Tools 1(2).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes

_MAX_BYTES = 200_000_000
"""Largest mesh file."""
_HEADER, _RECORD = 84, 50  # bytes of a binary STL file before its triangles, and of each of them
FORMS = ("legacy", "exact")
"""Ways of summing volumes, MuJoCo's default first."""


def measure_mesh(triangles: np.ndarray, form: str = FORMS[0]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the volume [m^3], its centre (3,) [m] and its inertia (3, 3) about the centre at unit density [m^5].

    Args:
        triangles: Corners (n, 3, 3) [m], counter-clockwise seen from outside.
        form: One of `FORMS`.
    """
    normal = (
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2
    )  # its length is the area
    middle, area = triangles.mean(axis=1), np.linalg.norm(normal, axis=1)
    apex = area @ middle / max(float(area.sum()), 1e-300)
    volumes = _sum_volumes(normal, middle - apex, form)
    volume = float(volumes.sum())
    if not volume > 0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    centre = volumes @ (3 / 4 * middle + apex / 4) / volume
    corners = triangles - centre
    volumes = _sum_volumes(normal, corners.mean(axis=1), form)
    total = corners.sum(axis=1)
    second = np.einsum("n,nki,nkj->ij", volumes, corners, corners) + np.einsum("n,ni,nj->ij", volumes, total, total)
    second /= 20
    return float(volumes.sum()), centre, np.trace(second) * np.eye(3) - second


def _sum_volumes(normal: np.ndarray, middle: np.ndarray, form: str) -> np.ndarray:
    """Return the volume (n,) of each triangle's tetrahedron, from the middles' positions (n, 3) relative to its apex."""
    volumes = np.einsum("ni,ni->n", normal, middle) / 3
    return volumes if form == "exact" else np.abs(volumes)


def read_triangles(path: Path) -> np.ndarray:
    """Return the triangles (n, 3, 3) of a binary STL or an OBJ file, in its units.

    Raises:
        InputError: The file is missing, too large, of another format, or has no triangles.
    """
    try:
        data = read_bytes(path, _MAX_BYTES)
    except OSError as error:
        said = f"{path}: {error.strerror or error}; a body without <inertial> takes its mass from this mesh"
        raise InputError("cannot_read", said) from None
    try:
        triangles = _read_obj(data) if path.suffix.lower() == ".obj" else _read_stl(data)
    except (ValueError, IndexError):
        triangles = np.zeros((0, 3, 3))
    if not len(triangles) or not np.isfinite(triangles).all():
        raise InputError("file_format", f"{path} has no triangles of a binary STL or an OBJ file")
    return triangles


def _read_stl(data: bytes) -> np.ndarray:
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) != _HEADER + _RECORD * count:
        raise ValueError
    rows = np.frombuffer(data, np.dtype("<u1"), offset=_HEADER).reshape(count, _RECORD)[:, 12:48]
    return np.ascontiguousarray(rows).view("<f4").reshape(count, 3, 3).astype(float)


def _read_obj(data: bytes) -> np.ndarray:
    points: list[list[float]] = []
    faces: list[list[int]] = []
    for line in data.decode("utf-8", "replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(x) for x in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.partition("/")[0]) for word in words[1:]]
            corners = [k - 1 if k > 0 else len(points) + k for k in corners]
            if min(corners) < 0 or max(corners) >= len(points):
                raise ValueError
            faces += [[corners[0], *pair] for pair in zip(corners[1:-1], corners[2:], strict=True)]
    return np.array(points)[np.array(faces, int)]
