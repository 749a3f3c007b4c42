"""A lattice of points in a box, refined along the border of a set, and the set's size.

Classification starts on a coarse lattice. A cell with corners inside and outside the set is divided; a cell with equal
corners is filled without evaluation. If a point evaluated later contradicts a filled cell, that cell is divided too, so a
border is followed once it is found. At the end random filled points are evaluated: they find parts of the set and holes that
are entirely within a coarse cell, and bound the share that may still be missed (no error in n points: below 3 / n with 95 %).

Cells with all corners inside count as inside, cells with all corners outside as outside. The others are undecided: half of their
volume is the bound, which shrinks with h. The share of filled points that may be wrong widens it:

    low = h^d #{all corners in},   high = h^d #{any corner in},   V = h^d sum over cells of the share of corners in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from tau_dyn.exceptions import InputError

INSIDE = 0
"""Code of a point in the set; every other code is a reason why a point is outside."""
MAX_LATTICE_POINTS = 60_000_000
"""Largest number of points of a lattice, within the memory of usual computers."""
MAX_REDRAWS = 6
"""Largest number of repeated random tests after contradictions."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points `low + step * index`.

    Attributes:
        low: First point (3,) [m].
        step: Distance of neighbours [m].
        shape: Points along each axis; 1 along an axis in which the set is flat.
        stride: Coarsest distance in steps, a power of two.
    """

    low: np.ndarray
    step: float
    shape: tuple[int, int, int]
    stride: int

    def points(self, index: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) [m] of indices (N, 3)."""
        return self.low + self.step * np.asarray(index)

    @property
    def dimension(self) -> int:
        """Number of axes along which it extends."""
        return sum(n > 1 for n in self.shape)

    def axis(self, k: int) -> np.ndarray:
        """Return the coordinates along one axis (n,) [m]."""
        return self.low[k] + self.step * np.arange(self.shape[k])

    def nearest(self, point: np.ndarray) -> tuple[int, ...]:
        """Return the index of the point nearest to a place (3,) [m]."""
        index = np.rint((np.asarray(point) - self.low) / self.step).astype(int)
        return tuple(np.clip(index, 0, np.array(self.shape) - 1).tolist())


def build_lattice(lower: np.ndarray, upper: np.ndarray, through: np.ndarray, step: float, stride: int = 4) -> Lattice:
    """Return the lattice that holds a box and has a point of its coarsest level at `through`.

    Args:
        lower: Corner of the box (3,) [m].
        upper: Opposite corner; an axis with equal coordinates is flat.
        through: A place in the box (3,) [m].
        step: Finest distance of neighbours [m].
        stride: Coarsest distance in steps, a power of two.

    Raises:
        InputError: The lattice would have too many points.
    """
    extends = upper - lower > 1e-9
    coarse = step * stride
    before = np.where(extends, np.ceil((through - lower) / coarse - 1e-9), 0).astype(int)
    after = np.where(extends, np.ceil((upper - through) / coarse - 1e-9), 0).astype(int)
    before, after = np.maximum(before, 0), np.maximum(after, 0)
    counts = (before + after) * stride + 1
    total = float(np.prod(counts.astype(float)))
    if total > MAX_LATTICE_POINTS:
        finest = step * (total / MAX_LATTICE_POINTS) ** (1 / max(int(extends.sum()), 1))
        raise InputError(
            "invalid_value",
            f"a resolution of {step:g} m gives {total:.1e} points; take {finest:.2g} m or more, or narrow the tool's limits",
        )
    return Lattice(through - before * coarse, step, tuple(int(n) for n in counts), stride)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class ClassifiedLattice:
    """A classified lattice.

    Attributes:
        lattice: The points.
        code: Code of every point (lattice shape); INSIDE or a reason.
        asked: Whether the point was classified itself, not filled from its cell (lattice shape).
        missed_share: Upper 95 % bound of the share of filled points that are wrong.
    """

    lattice: Lattice
    code: np.ndarray
    asked: np.ndarray
    missed_share: float

    @property
    def inside(self) -> np.ndarray:
        """Whether each point belongs (lattice shape)."""
        return self.code == INSIDE


Classify = Callable[[np.ndarray], np.ndarray]


def classify_lattice(lattice: Lattice, classify: Classify, *, probes: int = 1500, seed: int = 0) -> ClassifiedLattice:
    """Classify a lattice, densely only along the borders of the set.

    Args:
        lattice: The points.
        classify: Function from points (N, 3) [m] to codes (N,), INSIDE or a reason.
        probes: Number of random points evaluated at the end.
        seed: Seed of these points.
    """
    code = np.full(lattice.shape, INSIDE, np.uint16)
    asked = np.zeros(lattice.shape, bool)

    def ask(wanted: np.ndarray, stride: int) -> None:
        index = np.argwhere(wanted) * stride
        if len(index):
            code[tuple(index.T)] = classify(lattice.points(index))
            asked[tuple(index.T)] = True

    coarse = _every(asked, lattice.stride)
    ask(np.ones(coarse.shape, bool), lattice.stride)
    stride = lattice.stride
    while stride > 1:
        _divide(code, asked, ask, stride)
        stride //= 2
    share = _probe(code, asked, ask, probes, np.random.default_rng(seed))
    return ClassifiedLattice(lattice, code, asked, share)


def combine_cells(corners: np.ndarray, reduce: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Return one value per cell from the values at its corners, such as their `np.minimum` or `np.add`."""
    for axis, n in enumerate(corners.shape):
        if n > 1:
            low = np.take(corners, range(n - 1), axis)
            high = np.take(corners, range(1, n), axis)
            corners = reduce(low, high)
    return corners


def _every(array: np.ndarray, stride: int) -> np.ndarray:
    return array[tuple(slice(None, None, stride) if n > 1 else slice(None) for n in array.shape)]


def _mixed(inside: np.ndarray) -> np.ndarray:
    return combine_cells(inside, np.logical_or) & ~combine_cells(inside, np.logical_and)


def _offsets(shape: tuple[int, ...], width: int) -> Iterator[tuple[slice, ...]]:
    """Return, for every point of a cell `width` intervals wide, the slice that takes it from all cells at once."""
    for offset in product(*(range(width + 1) if n > 1 else (0,) for n in shape)):
        yield tuple(
            slice(o, n - width + o, width) if n > 1 else slice(None) for o, n in zip(offset, shape, strict=True)
        )


def _divide(code: np.ndarray, asked: np.ndarray, ask: Callable[[np.ndarray, int], None], stride: int) -> None:
    """Halve the stride: evaluate points within mixed cells and cells that a new point contradicts, fill the others."""
    half = stride // 2
    fine_code, fine_asked = _every(code, half), _every(asked, half)
    corner = _every(code, stride)
    inside = corner == INSIDE
    mixed, belongs = _mixed(inside), combine_cells(inside, np.logical_and)
    wanted_now = mixed
    while wanted_now.any():
        wanted = np.zeros(fine_code.shape, bool)
        for at in _offsets(fine_code.shape, 2):
            wanted[at] |= wanted_now
        ask(wanted & ~fine_asked, half)
        against = np.zeros(mixed.shape, bool)
        for at in _offsets(fine_code.shape, 2):
            against |= fine_asked[at] & ((fine_code[at] == INSIDE) != belongs)
        wanted_now = against & ~mixed
        mixed = mixed | wanted_now
    lowest = corner[tuple(slice(0, -1) if n > 1 else slice(None) for n in corner.shape)]
    for at in _offsets(fine_code.shape, 2):
        free = ~fine_asked[at] & ~mixed
        fine_code[at] = np.where(free, lowest, fine_code[at])


def _probe(
    code: np.ndarray, asked: np.ndarray, ask: Callable[[np.ndarray, int], None], probes: int, rng: np.random.Generator
) -> float:
    """Evaluate random filled points, repair around wrong ones, and return the share that may still be wrong."""
    _mend(code, asked, ask)
    share = 0.0
    for _ in range(MAX_REDRAWS):
        filled = np.flatnonzero(~asked)
        if not len(filled) or probes < 1:
            return 0.0
        drawn = rng.choice(filled, min(probes, len(filled)), replace=False)
        before = code.ravel()[drawn] == INSIDE
        wanted = np.zeros(code.shape, bool)
        wanted.ravel()[drawn] = True
        ask(wanted, 1)
        wrong = int(np.sum(before != (code.ravel()[drawn] == INSIDE)))
        share = (3.0 + 2.0 * wrong) / len(drawn) if len(drawn) < len(filled) else 0.0
        _mend(code, asked, ask)
        if not wrong:
            break
    return share


def _mend(code: np.ndarray, asked: np.ndarray, ask: Callable[[np.ndarray, int], None]) -> None:
    """Evaluate every point of a cell whose corners differ, until no new border appears."""
    while True:
        mixed = _mixed(code == INSIDE)
        wanted = np.zeros(code.shape, bool)
        for at in _offsets(code.shape, 1):
            wanted[at] |= mixed
        wanted &= ~asked
        if not wanted.any():
            return
        ask(wanted, 1)


class Size(NamedTuple):
    """A volume [m^3], or an area or a length if the set is flat, with the bounds `low` and `high`."""

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
    """Return the upper 95 % bound of the size [m^d] of wrong filled points, all drawn from the same filled region."""
    filled = float((~found.asked).sum()) * found.lattice.step**found.lattice.dimension
    return found.missed_share * filled


def find_connected(inside: np.ndarray, home: tuple[int, ...]) -> np.ndarray:
    """Return which points are reached from `home` by steps along the axes through points of the set."""
    labels = np.zeros(inside.shape, np.int32)
    ndimage.label(inside, output=labels)
    return (labels == labels[home]) & inside


def erode_by_margin(inside: np.ndarray, step: float, margin: float) -> np.ndarray:
    """Return which points keep a distance [m] from every point outside the set; the lattice's edge does not count as outside."""
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
