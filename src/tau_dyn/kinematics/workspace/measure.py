r"""Size, box, connection and border of a set of lattice points.

A cell with all corners inside is counted in, one with none is counted out; the others lie between, half their volume is the
bound:

    low = h^d #{all corners in},   high = h^d #{any corner in},   V = h^d sum over cells of the share of corners in,

and the share of filled points that may be wrong (see `lattice`) widens both. The bound shrinks with the surface's share, as
h.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from tau_dyn.kinematics.workspace.lattice import ClassifiedLattice, combine_cells


class Size(NamedTuple):
    """A volume [m^3], or an area or a length where the set is flat; it lies between `low` and `high`."""

    value: float
    low: float
    high: float


def measure_size(inside: np.ndarray, step: float, missed: float = 0.0) -> Size:
    """Return the size of a set.

    Args:
        inside: Whether each lattice point belongs (lattice shape).
        step: Distance of neighbours [m].
        missed: Size that may have been missed or counted wrongly, from random points [m^d].
    """
    dimension = sum(n > 1 for n in inside.shape)
    if dimension == 0:
        return Size(0.0, 0.0, 0.0)
    unit = step**dimension
    low = unit * float(combine_cells(inside, np.logical_and).sum())
    high = unit * float(combine_cells(inside, np.logical_or).sum())
    value = unit * float(combine_cells(inside.astype(np.uint8), np.add).sum()) / 2**dimension
    return Size(value, max(low - missed, 0.0), high + missed)


def bound_missed_size(found: ClassifiedLattice) -> float:
    """Return the size [m^d] that filled points may have wrong, with 95 %: all of them drawn from the same filled region."""
    filled = float((~found.asked).sum()) * found.lattice.step**found.lattice.dimension
    return found.missed_share * filled


def find_connected(inside: np.ndarray, home: tuple[int, ...]) -> np.ndarray:
    """Return which points are reached from `home` by steps along the axes through points that belong."""
    labels = np.zeros(inside.shape, np.int32)
    ndimage.label(inside, output=labels)
    return (labels == labels[home]) & inside


def erode_by_margin(inside: np.ndarray, step: float, margin: float) -> np.ndarray:
    """Return which points keep a distance [m] from every point that does not belong; the lattice's edge is none."""
    far = ndimage.distance_transform_edt(inside, sampling=step)
    return np.asarray(far) >= margin


def compute_bounding_box(inside: np.ndarray, low: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates (3,) [m] of a set that is not empty, half a step beyond its last points."""
    ends = []
    for k in range(inside.ndim):
        there = np.flatnonzero(inside.any(axis=tuple(i for i in range(inside.ndim) if i != k)))
        half = step / 2 if inside.shape[k] > 1 else 0.0
        ends.append((low[k] + step * there[0] - half, low[k] + step * there[-1] + half))
    lower, upper = np.array(ends).T
    return lower, upper
