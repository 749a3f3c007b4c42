r"""Corners to a hundredth of a pixel: a blurred crossing of two edges is fitted to the grey values about each.

    I(p) = a + g . d + b erf(n1 . d / (sqrt 2 s)) erf(n2 . d / (sqrt 2 s)),   d = p - corner,  n_i = (-sin a_i, cos a_i)

Nine unknowns a corner: its place, two edge directions, blur, light, its gradient and the contrast. A detector's own guess stems
from a neighbourhood that blur and perspective pull to one side; the crossing is symmetric about the corner, so its fit is not.
Gauss-Newton with step limits, all corners at once.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from tau_dyn.vision.pattern import Pattern

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
