"""The picture of a plane: the homography between points on it and pixels, by direct linear transformation (Hartley 1997)."""

from __future__ import annotations

import numpy as np


def estimate_homography(flat: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return `H` (3, 3) with pixels ~ H [flat; 1], least squares, from points (n, 2) and pixels (n, 2), n >= 4."""
    (a, ta), (b, tb) = _normalised(flat), _normalised(pixels)
    one, zero = np.ones(len(a)), np.zeros((len(a), 3))
    p = np.column_stack([a, one])
    rows = np.concatenate([np.hstack([p, zero, -b[:, :1] * p]), np.hstack([zero, p, -b[:, 1:] * p])])
    h = np.linalg.inv(tb) @ np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3) @ ta
    return h / np.linalg.norm(h)


def apply(h: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Return pixels (n, 2) of points (n, 2)."""
    at = np.column_stack([flat, np.ones(len(flat))]) @ h.T
    return at[:, :2] / at[:, 2:]


def estimate_focal_length(homographies: list[np.ndarray], middle: np.ndarray) -> float | None:
    """Return the focal length [px] of square pixels with the principal point at `middle` (2,), None where planes do not tell it.

    Zhang 2000, (3) and (4): the plane's axes are orthogonal and of one length, two equations a picture in 1 / f^2.
    """
    shift = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, 1.0]])
    a, b = [], []
    for h in homographies:
        g = shift @ h
        g = g / np.linalg.norm(g[:, :2])
        for x, y in ((g[:, 0], g[:, 1]), (g[:, 0] + g[:, 1], g[:, 0] - g[:, 1])):
            a.append(x[0] * y[0] + x[1] * y[1])
            b.append(-x[2] * y[2])
    square = np.dot(a, a)
    inverse = np.dot(a, b) / square if square > 0 else 0.0
    return float(1 / np.sqrt(inverse)) if inverse > 0 else None


def compute_plane_pose(h: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and position (3,) of a plane before a pinhole `k` (fx, fy, cx, cy), from its homography."""
    m = np.linalg.inv(np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1.0]])) @ h
    m = m / np.sqrt(np.linalg.norm(m[:, 0]) * np.linalg.norm(m[:, 1]))
    m = -m if m[2, 2] < 0 else m
    u, _, vt = np.linalg.svd(np.column_stack([m[:, 0], m[:, 1], np.cross(m[:, 0], m[:, 1])]))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, m[:, 2]


def compute_mirrored_tilt(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the other rotation that looks alike from far: the plate's normal mirrored about the line of sight.

    Schweighofer & Pinz 2006: a small or far plane has two poses of almost one picture.
    """
    sight = position / np.linalg.norm(position)
    normal = rotation[:, 2]
    mirrored = 2 * (normal @ sight) * sight - normal
    axis = np.cross(normal, mirrored)
    s, c = np.linalg.norm(axis), float(normal @ mirrored)
    if s < 1e-9:
        return rotation
    axis = axis / s
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return (np.eye(3) + s * cross + (1 - c) * cross @ cross) @ rotation


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points about their middle at a mean distance of sqrt 2, and the transformation (3, 3) that did it."""
    middle = points.mean(axis=0)
    scale = np.sqrt(2) / np.linalg.norm(points - middle, axis=1).mean()
    t = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
    return scale * (points - middle), t
