r"""Fit of blurred corners of black squares to grey values, by Gauss-Newton with step limits for all corners at once.

    I(p) = a + g . d + b W(x1, x2),   d = p - corner,   x_i = n_i . d / s_i,   n_i = (-sin a_i, cos a_i)

A single corner is a wedge `n1 . d > 0, n2 . d > 0` blurred by a Gaussian of covariance `B`: `W = Phi2(x1, x2; rho)`, the
bivariate normal distribution with `s_i^2 = n_i' B n_i` and `rho = n1' B n2 / (s1 s2)`; this is exact, and its derivatives are
Plackett's (1954). A crossing is two opposite wedges and symmetric about the corner, so the round blur of
`W = Phi(x1) Phi(x2) + Phi(-x1) Phi(-x2)` gives an unbiased position at any angle. Motion blurs along one direction, which all
corners of an image share (`estimate_blur`); a round blur would bias a single corner of a moving plate by a tenth of a pixel.

A corner's standard error is that of least squares, with the noise estimated from the residual of the window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

_MAX_ITERATIONS = 15  # a good start needs five
_SETTLED_PX = 5e-3  # [px] last step of a corner that converged
_MIN_BLUR_PX, _MAX_BLUR_PX = 0.3, 4.0  # [px] standard deviation of the blur
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
"""Gauss-Legendre quadrature over the correlation: exact to 1e-5 up to a correlation of 0.8, edges that meet at 37 degrees."""
_MAX_CORRELATION = 0.9  # edges that meet at 26 degrees
_N_PARAMETERS = 11
"""Corner, two directions, two blurs, grey value, gradient, contrast, and correlation beyond that of a round blur."""
_KNOWN_BLUR = np.delete(np.eye(_N_PARAMETERS), [4, 5, 10], axis=1)
_ONE_BLUR = np.insert(_KNOWN_BLUR, 4, np.isin(np.arange(_N_PARAMETERS), [4, 5]), axis=1)
"""Columns of the parameters that are fitted if the blur is round; `_KNOWN_BLUR` holds those for a known blur."""


class CornerFit(NamedTuple):
    """Fitted corners.

    Attributes:
        place: Positions (n, 2) [px] relative to the windows' centres; nan if the fit failed.
        stderr: Standard error of a coordinate (n,) [px].
        blur: Standard deviation of the blur across both edges (n, 2) [px].
        correlation: Correlation of the blur across both edges (n,).
        directions: Directions of the edges (n, 2) [rad].
        contrast: Grey value inside the first wedge minus that outside (n,).
    """

    place: np.ndarray
    stderr: np.ndarray
    blur: np.ndarray
    correlation: np.ndarray
    directions: np.ndarray
    contrast: np.ndarray


def fit_corners(
    grey: np.ndarray,
    at: np.ndarray,
    start: np.ndarray,
    directions: np.ndarray,
    crossing: np.ndarray,
    *,
    blur: np.ndarray | None = None,
    each_edge: bool = False,
) -> CornerFit:
    """Fit a corner in each window.

    Args:
        grey: Grey values (n, w).
        at: Offsets of a window's pixels from its centre (w, 2) [px].
        start: Initial corners relative to the windows' centres (n, 2) [px].
        directions: Directions `a1 a2` of the edges (n, 2) [rad]; the first wedge is left of both.
        crossing: Mask of corners whose opposite wedge has the same colour (n,).
        blur: Covariance of the blur (2, 2) [px^2]; if None, a round blur is fitted at each corner.
        each_edge: Whether the blur of each corner may have any covariance, rather than being round.
    """
    n = len(grey)
    basis = _KNOWN_BLUR if blur is not None else np.eye(_N_PARAMETERS) if each_edge else _ONE_BLUR
    size = basis.shape[1]
    theta = np.column_stack([start, directions, np.full((n, 2), 0.8), grey.mean(1), np.zeros((n, 4))])
    shape = _model(theta, at, crossing, blur)[1][..., 9]
    theta[:, 9] = ((grey - grey.mean(1, keepdims=True)) * shape).sum(1) / np.maximum((shape**2).sum(1), 1e-9)
    limit = np.array([0.5, 0.5, 0.2, 0.2, 0.3, 0.3, np.inf, np.inf, np.inf, np.inf, 0.2])
    step, normal = np.zeros_like(theta), np.zeros((n, size, size))
    residual = grey
    for _ in range(_MAX_ITERATIONS):
        value, jacobian = _model(theta, at, crossing, blur)
        jacobian, residual = jacobian @ basis, grey - value
        normal = np.einsum("nwi,nwj->nij", jacobian, jacobian)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(size) + 1e-12 * np.eye(size)
        step = np.linalg.solve(normal, np.einsum("nwi,nw->ni", jacobian, residual)[..., None])[..., 0] @ basis.T
        step = np.clip(step, -limit, limit)
        theta = theta + step
        theta[:, 4:6] = theta[:, 4:6].clip(_MIN_BLUR_PX, _MAX_BLUR_PX)
        theta[:, 10] = theta[:, 10].clip(-_MAX_CORRELATION, _MAX_CORRELATION)
        if np.abs(step[:, :2]).max() < 1e-4:
            break
    still = np.abs(step[:, :2]).max(axis=1) < _SETTLED_PX
    variance = (residual**2).sum(axis=1) / max(grey.shape[1] - size, 1)
    spread = np.diagonal(np.linalg.inv(normal), axis1=1, axis2=2)[:, :2].mean(axis=1)
    place, stderr = np.where(still[:, None], theta[:, :2], np.nan), np.sqrt(variance * spread.clip(0))
    correlation = np.cos(theta[:, 3] - theta[:, 2]) + theta[:, 10]
    return CornerFit(place, stderr, theta[:, 4:6], correlation, theta[:, 2:4], theta[:, 9])


def estimate_blur(fit: CornerFit, crossing: np.ndarray) -> np.ndarray:
    """Return the covariance `B` (2, 2) [px^2] of the common blur of an image.

    The widths of edges give `s^2 = n' B n`. Edges of a pattern have two directions, so the third element of `B` needs single
    corners: their correlation gives `n1' B n2`.

    Args:
        fit: Corners with one blur each.
        crossing: Mask of crossings (n,).
    """
    x, y = -np.sin(fit.directions), np.cos(fit.directions)
    pairs = [(0, 0, slice(None)), (1, 1, slice(None)), (0, 1, ~crossing)]
    rows = np.concatenate(
        [
            np.column_stack([x[w, a] * x[w, b], x[w, a] * y[w, b] + y[w, a] * x[w, b], y[w, a] * y[w, b]])
            for a, b, w in pairs
        ]
    )
    shown = np.concatenate([*(fit.blur.T**2), (fit.correlation * fit.blur.prod(axis=1))[~crossing]])
    weight, found = np.ones(len(shown)), np.zeros(3)
    for _ in range(5):  # least absolute deviations: robust to a few corners with a wrong blur
        found = np.linalg.lstsq(weight[:, None] * rows, weight * shown, rcond=None)[0]
        weight = 1 / np.sqrt(np.abs(shown - rows @ found) + 1e-2 * np.abs(shown).mean())
    values, vectors = np.linalg.eigh(np.array([[found[0], found[1]], [found[1], found[2]]]))
    return (vectors * values.clip(_MIN_BLUR_PX**2)) @ vectors.T


def _model(
    theta: np.ndarray, at: np.ndarray, crossing: np.ndarray, blur: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return grey values (n, w) and their derivatives (n, w, 11), in the order of `_N_PARAMETERS`."""
    d = at[None] - theta[:, None, :2]
    b = theta[:, 9, None]
    normals = [np.column_stack([-np.sin(theta[:, k]), np.cos(theta[:, k])]) for k in (2, 3)]
    turn = theta[:, 3] - theta[:, 2]
    if blur is None:
        s = [theta[:, 4, None], theta[:, 5, None]]
        rho = np.cos(turn) + theta[:, 10]
    else:
        s = [np.sqrt(np.einsum("ni,ij,nj->n", n, blur, n))[:, None] for n in normals]
        rho = np.einsum("ni,ij,nj->n", normals[0], blur, normals[1]) / (s[0] * s[1])[:, 0]
    rho = np.where(crossing, 0.0, rho.clip(-_MAX_CORRELATION, _MAX_CORRELATION))[:, None]
    x = [(d * n[:, None]).sum(-1) / width for n, width in zip(normals, s, strict=True)]
    along = [-(n[:, 1, None] * d[..., 0] - n[:, 0, None] * d[..., 1]) / w for n, w in zip(normals, s, strict=True)]
    w, by_x, by_rho = _blur_wedges(x[0], x[1], rho, crossing[:, None])
    of_x = [b * slope for slope in by_x]
    of_rho = np.where(crossing[:, None], 0.0, b * by_rho * np.sin(turn)[:, None])
    out = np.empty((*d.shape[:2], _N_PARAMETERS))
    for axis in (0, 1):
        across = sum(slope * n[:, axis, None] / width for slope, n, width in zip(of_x, normals, s, strict=True))
        out[..., axis] = -across - theta[:, 7 + axis, None]
        out[..., 7 + axis] = d[..., axis]
    out[..., 2], out[..., 3] = of_x[0] * along[0] + of_rho, of_x[1] * along[1] - of_rho
    out[..., 4], out[..., 5] = -of_x[0] * x[0] / s[0], -of_x[1] * x[1] / s[1]
    out[..., 6], out[..., 9] = 1.0, w
    out[..., 10] = np.where(crossing[:, None], 0.0, b * by_rho)
    value = theta[:, 6, None] + (theta[:, None, 7:9] * d).sum(-1) + b * w
    return value, out


def _blur_wedges(
    x: np.ndarray, y: np.ndarray, rho: np.ndarray, crossing: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return blurred wedges (n, w), their derivatives by both coordinates and by the correlation (of single wedges)."""
    px, py = ndtr(x), ndtr(y)
    k = np.sqrt(1 - rho**2)
    fx, fy = (np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi) for z in (x, y))
    across = (ndtr((y - rho * x) / k), ndtr((x - rho * y) / k))
    w = px * py
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        w = w + 0.5 * weight * rho * _density(x, y, 0.5 * rho * (1 + node))
    w = np.where(crossing, px * py + (1 - px) * (1 - py), w)
    slopes = tuple(f * np.where(crossing, 2 * p - 1, p) for f, p in zip((fx, fy), across, strict=True))
    return w, (slopes[0], slopes[1]), _density(x, y, rho)


def _density(x: np.ndarray, y: np.ndarray, rho: np.ndarray) -> np.ndarray:
    """Return the bivariate normal density with unit variances."""
    rest = 1 - rho**2
    return np.exp(-0.5 * (x**2 - 2 * rho * x * y + y**2) / rest) / (2 * np.pi * np.sqrt(rest))
