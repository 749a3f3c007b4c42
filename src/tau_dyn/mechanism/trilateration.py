r"""A translating plate on three rods: spheres around the points A intersected in closed form; samples last.

The plate keeps its rotation, so each rod ends at `T + r_k` with constant `r_k`, and `|A_k - r_k - T| = L_k`: three
spheres (thesis (4.9); Coope 2000). They meet in two points, mirrored in the plane of the centres; `side` says on which
side of it the plate is, seen along `(C_2 - C_1) x (C_3 - C_1)`, which is the thesis' configuration `c`. Guideways may
have any direction: `q` enters through A alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.tree_arrays import compute_cross_product


class SphereIntersection(NamedTuple):
    """Where three spheres meet.

    Attributes:
        position: (3, N) [m]; nan where they do not.
        height: Squared height of that point over the centres' plane, by the squared longest radius (N,); below zero where
            the spheres do not meet.
    """

    position: np.ndarray
    height: np.ndarray


def intersect_spheres(centres: np.ndarray, lengths: np.ndarray, side: float | np.ndarray) -> SphereIntersection:
    """Intersect spheres around three centres (3, 3, N) [m] with radii (3, N or 1) [m], on one side of their plane."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    square = lengths * lengths
    with np.errstate(all="ignore"):
        inverse = 1.0 / _dot(normal, normal)
        p = (0.5 * inverse) * (_dot(u, u) + (square[0] - square[1]))
        r = (0.5 * inverse) * (_dot(w, w) + (square[0] - square[2]))
        foot = compute_cross_product(w, normal)
        foot *= p
        other = compute_cross_product(normal, u)
        other *= r
        foot += other
        height = square[0] - _dot(foot, foot)
        normal *= side * np.sqrt(height * inverse)
    foot += normal
    foot += centres[0]
    return SphereIntersection(foot, height / square.max(axis=0))


def find_side(centres: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return on which side (N,) of the plane of three centres (3, 3, N) a point (3, N) is: 1, -1 or 0."""
    u: np.ndarray = centres[1] - centres[0]
    w: np.ndarray = centres[2] - centres[0]
    normal = compute_cross_product(u, w)
    return np.sign(_dot(normal, position - centres[0]))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out
