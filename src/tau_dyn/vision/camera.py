r"""A camera: a pinhole and a lens (Brown 1966; the field's usual five coefficients), with the derivatives a fit needs.

    x = X / Z,  y = Y / Z,  r^2 = x^2 + y^2,  g = 1 + k1 r^2 + k2 r^4 + k3 r^6
    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = fx x' + cx,   v = fy y' + cy

Pixels are counted from the middle of the first one; z looks out of the camera, y down.
"""

from __future__ import annotations

import numpy as np

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Names of a camera's nine numbers; the first four in pixels."""

LENSES = {"none": 4, "radial": 6, "brown": 8, "brown3": 9}
"""Lens models, and how many of the numbers above they leave free."""


def project(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return pixels (..., 2) of points (..., 3) in the camera's frame [m]; `intrinsics` (..., 9) broadcast."""
    k = np.moveaxis(np.asarray(intrinsics, float), -1, 0)
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    xd, yd = apply_distortion(x, y, k)
    return np.stack([k[0] * xd + k[2], k[1] * yd + k[3]], axis=-1)


def apply_distortion(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the lens puts ideal image points; `k` are the nine numbers, first axis."""
    r2 = x * x + y * y
    g = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    return x * g + 2 * k[6] * x * y + k[7] * (r2 + 2 * x * x), y * g + k[6] * (r2 + 2 * y * y) + 2 * k[7] * x * y


def compute_rays(pixels: np.ndarray, intrinsics: np.ndarray, iterations: int = 15) -> np.ndarray:
    """Return the ideal image points `x y` (..., 2) behind pixels (..., 2), by fixed-point iteration; nan where it runs away."""
    k = np.asarray(intrinsics, float)
    target = (pixels - k[2:4]) / k[0:2]
    at = target.copy()
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            at = at + target - np.stack(apply_distortion(at[..., 0], at[..., 1], k), axis=-1)
        off = np.abs(target - np.stack(apply_distortion(at[..., 0], at[..., 1], k), axis=-1)).max(axis=-1)
    return np.where((off < 1e-6)[..., None], at, np.nan)


def project_with_jacobians(points: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (..., 2), their derivative by the point (..., 2, 3) and by the nine numbers (..., 2, 9)."""
    k = np.moveaxis(np.asarray(intrinsics, float), -1, 0)
    x, y, z = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2], points[..., 2]
    xd, yd = apply_distortion(x, y, k)
    by_image = _by_image(x, y, k)
    by_point = np.empty((*points.shape[:-1], 2, 3))
    by_point[..., :, :2] = by_image / z[..., None, None]
    by_point[..., :, 2] = -(by_image @ np.stack([x, y], axis=-1)[..., None])[..., 0] / z[..., None]
    pixels = np.stack([k[0] * xd + k[2], k[1] * yd + k[3]], axis=-1)
    return pixels, by_point, _by_intrinsics(x, y, xd, yd, k)


def _by_image(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> np.ndarray:
    r2 = x * x + y * y
    g = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    slope = 2 * (k[4] + r2 * (2 * k[5] + 3 * k[8] * r2))  # dg/dx = slope x
    cross = slope * x * y + 2 * k[6] * x + 2 * k[7] * y
    out = np.empty((*x.shape, 2, 2))
    out[..., 0, 0] = k[0] * (g + slope * x * x + 2 * k[6] * y + 6 * k[7] * x)
    out[..., 0, 1] = k[0] * cross
    out[..., 1, 0] = k[1] * cross
    out[..., 1, 1] = k[1] * (g + slope * y * y + 6 * k[6] * y + 2 * k[7] * x)
    return out


def _by_intrinsics(x: np.ndarray, y: np.ndarray, xd: np.ndarray, yd: np.ndarray, k: np.ndarray) -> np.ndarray:
    r2 = x * x + y * y
    out = np.zeros((*x.shape, 2, 9))
    out[..., 0, 0], out[..., 1, 1] = xd, yd
    out[..., 0, 2] = out[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2**2), (8, r2**3)):
        out[..., 0, column], out[..., 1, column] = k[0] * x * power, k[1] * y * power
    out[..., 0, 6], out[..., 1, 6] = k[0] * 2 * x * y, k[1] * (r2 + 2 * y * y)
    out[..., 0, 7], out[..., 1, 7] = k[0] * (r2 + 2 * x * x), k[1] * 2 * x * y
    return out
