"""Points of space on a flat drawing: the view that all drawings of robots share, how it is fitted, outlines, axes.

Orthographic, from the front right and above; z is up, the drawing's y points down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from scipy.spatial import ConvexHull, QhullError

from tau_dyn.report.svg import format_path, format_tag

_AZIMUTH, _ELEVATION = np.deg2rad(-62.0), np.deg2rad(18.0)
_CA, _SA, _CE, _SE = np.cos(_AZIMUTH), np.sin(_AZIMUTH), np.cos(_ELEVATION), np.sin(_ELEVATION)
_SCREEN = np.array([[-_SA, _CA, 0.0], [_CA * _SE, _SA * _SE, -_CE], [_CA * _CE, _SA * _CE, _SE]])
"""Rows: right, down, towards the viewer."""
BOX_EDGES = tuple((i, i | 1 << a) for i in range(8) for a in range(3) if not i >> a & 1)
"""Pairs of corners, as `compute_box_corners` counts them."""


def project(points: np.ndarray) -> np.ndarray:
    """Return screen coordinates (n, 2) [m], right and down."""
    return np.atleast_2d(points) @ _SCREEN[:2].T


def project_with_depth(points: np.ndarray) -> np.ndarray:
    """Return screen coordinates, right and down, and the distance towards the viewer (n, 3) [m]."""
    return np.atleast_2d(points) @ _SCREEN.T


class View(NamedTuple):
    """Maps points of space to a drawing.

    Attributes:
        scale: Drawing units a metre.
        shift: Where the origin lies (2,).
    """

    scale: float
    shift: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, width: float, height: float, margin: float) -> View:
        """Return the view in which points (n, 3) [m] fill a drawing but for its margins."""
        flat, sheet = project(points), np.array([width, height])
        low, high = flat.min(axis=0), flat.max(axis=0)
        scale = float(np.min((sheet - 2 * margin) / np.maximum(high - low, 1e-3)))
        return cls(scale, sheet / 2 - scale * (low + high) / 2)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Return points (n, 3) [m] on the drawing (n, 2)."""
        return self.scale * project(points) + self.shift


def compute_hull(flat: np.ndarray) -> np.ndarray | None:
    """Return which points (n, 2) lie around all, in order; None where they are on one line."""
    try:
        return ConvexHull(flat).vertices
    except (QhullError, ValueError):
        return None


def draw_outline(flat: np.ndarray) -> str:
    """Return the path around points (n, 2) of the drawing, or through them where they are on one line."""
    around = compute_hull(flat)
    return format_path(flat) if around is None else format_path(flat[around], closed=True)


def compute_box_corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box; bit a of a corner's number says at which end of axis a it lies."""
    return np.array([[(lower, upper)[k >> a & 1][a] for a in range(3)] for k in range(8)])


def draw_triad(x: float, y: float, length: float) -> Markup:
    """Return the axes of space, drawn small from a point of the drawing."""
    origin, pieces = np.array([x, y]), []
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        way = project(axis)[0]
        pieces.append(format_tag("path", d=format_path(np.array([origin, origin + length * way])), class_="triad"))
        at = origin + (length + 9) * way
        pieces.append(
            format_tag("text", name, x=float(at[0]), y=float(at[1]) + 3, text_anchor="middle", class_="triad-name")
        )
    return Markup("").join(pieces)
