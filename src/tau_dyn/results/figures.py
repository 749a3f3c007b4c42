"""Figures as data: axes, marks on them, strips of a time view. Renderers draw them.

Coordinates are data in the [unit] of the axis; an `ink` names a colour and a thickness of the style sheet.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

THIRD, HALF, WHOLE = 344, 520, 1060
"""Widths of drawings, three, two or one in a row of a card [px]."""
SMALL = (THIRD, 240)
"""Width and height of a drawing in a row of several [px]."""


@dataclass(frozen=True)
class Drawing:
    """Anything that can be drawn."""


@dataclass(frozen=True, eq=False)
class Line:
    """A line through points (n,), interrupted where y is NaN."""

    x: np.ndarray
    y: np.ndarray
    ink: str = "predicted"


@dataclass(frozen=True, eq=False)
class Dots:
    """Many points (n,): round, or `cross`, `ring` or `square` of a size [px]."""

    x: np.ndarray
    y: np.ndarray
    ink: str = "mean"
    shape: str = "dot"
    size: float = 4.0


@dataclass(frozen=True, eq=False)
class Strokes:
    """Straight strokes from (x0, y0) to (x1, y1), each (n,): error bars, stems, arrows."""

    x0: np.ndarray
    y0: np.ndarray
    x1: np.ndarray
    y1: np.ndarray
    ink: str


@dataclass(frozen=True, eq=False)
class Ribbon:
    """The area between two curves, x, low and high (n,)."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    ink: str = "sure"


@dataclass(frozen=True)
class Spans:
    """Shaded stretches of the horizontal axis, full height."""

    intervals: Sequence[tuple[float, float]]
    ink: str


@dataclass(frozen=True)
class Rule:
    """A line through the whole figure at one x or one y."""

    ink: str
    x: float | None = None
    y: float | None = None


@dataclass(frozen=True, eq=False)
class Ring:
    """A closed line through points (n, 2)."""

    points: np.ndarray
    ink: str


@dataclass(frozen=True)
class Label:
    """Text at a point; `anchor` is `start`, `middle` or `end`."""

    x: float
    y: float
    words: str
    ink: str = ""
    anchor: str = "start"


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of an even grid, u (nu,) and v (nv,), in the inks of their classes `of` (nu, nv); a negative class is not drawn."""

    u: np.ndarray
    v: np.ndarray
    of: np.ndarray
    inks: Sequence[str]


@dataclass(frozen=True, eq=False)
class Levels:
    """Values (nv, nu) over u (nu,) and v (nv,), NaN outside, as bands of colour with level lines between them."""

    u: np.ndarray
    v: np.ndarray
    values: np.ndarray
    levels: np.ndarray


Mark = Line | Dots | Strokes | Ribbon | Spans | Rule | Ring | Label | Cells | Levels


@dataclass(frozen=True)
class Axis:
    """An axis: quantity and unit, the data at its ends, and whether it is logarithmic."""

    label: str
    limits: tuple[float, float]
    log: bool = False


@dataclass(frozen=True)
class Figure(Drawing):
    """Marks on two axes.

    Attributes:
        x: The horizontal axis.
        y: The vertical axis.
        marks: The marks, the first one at the bottom.
        title: Description of the contents, in a corner; also read out by screen readers.
        size: Width and height [px at 100 %].
        unit: Unit of the values of `Levels`, above their scale.
        style: Further style of the drawing, such as `vectors`.
    """

    x: Axis
    y: Axis
    marks: Sequence[Mark]
    title: str = ""
    size: tuple[int, int] = SMALL
    unit: str = ""
    style: str = ""


@dataclass(frozen=True, eq=False)
class ColourScale(Drawing):
    """A scale of colours from low to high: their inks, and numbers at even distances."""

    inks: Sequence[str]
    numbers: Sequence[str]


@dataclass(frozen=True, eq=False)
class RobotPicture(Drawing):
    """A robot at home as a line drawing, some of its joints in another colour."""

    robot: Any
    named: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SwingPicture(Drawing):
    """A mode's shape on a robot: at rest, and deflected in both directions.

    Attributes:
        skeleton: The robot as lines: `modes.Skeleton`.
        swing: The displacements: `modes.ModeShape`.
        who: The owner of the mode.
    """

    skeleton: Any
    swing: Any
    who: str


@dataclass(frozen=True, eq=False)
class ShapePicture(Drawing):
    """A mode's shape by itself: complex displacements (p,) of named outputs."""

    shape: np.ndarray
    outputs: tuple[str, ...]


def find_space_axes(outputs: Sequence[str]) -> dict[str, int]:
    """Return the axes of one point that outputs measure: `x_tool y_tool`, `ax_tool ay_tool az_tool`; empty if they are not."""
    found: dict[str, dict[str, int]] = {}
    for k, name in enumerate(outputs):
        match = re.fullmatch(r"([av]?)([xyz])(?:_(\w+))?", name)
        if match:
            found.setdefault(f"{match[1]} {match[3]}", {})[match[2]] = k
    best = max(found.values(), key=len, default={})
    return best if len(best) >= 2 and len(best) == len(outputs) else {}


@dataclass(frozen=True, eq=False)
class VectorPicture(Drawing):
    """Vectors (n, 3) at places (n, 3) [m] in space, drawn enlarged by a factor."""

    places: np.ndarray
    vectors: np.ndarray
    times: float


@dataclass(frozen=True, eq=False)
class SpacePicture(Drawing):
    """A workspace in space with the robot at home in it: `kinematics.workspace.Study`."""

    study: Any


@dataclass(frozen=True, eq=False)
class PolarPicture(Drawing):
    """A closed line around a point: angles (n,) [rad] and distances (n,) [deg]."""

    angle: np.ndarray
    degrees: np.ndarray
    title: str


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a time view.

    Attributes:
        name: Name of the line, for the readout.
        ink: Its colour's name: `measured`, `predicted` or `residual`.
        values: Its values (n,), NaN where missing.
    """

    name: str
    ink: str
    values: np.ndarray


@dataclass(frozen=True)
class Strip:
    """Curves on one vertical axis.

    Attributes:
        label: Quantity and unit.
        curves: The curves, the first one at the bottom.
        limits: Range of the axis.
        height: Height on the screen [px].
        masked: Whether unused stretches are shaded here.
        bounds: Limits of the robot, drawn if they are near.
    """

    label: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float]
    height: int
    masked: bool = False
    bounds: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class View:
    """One joint in one stretch of time.

    Attributes:
        log: The log's name.
        joint: The joint.
        t: Even times (n,) [s].
        strips: The strips, top down.
        held_out: Whether all of it is held-out data.
        bands: Stretches [s] to shade by their use, and the shade's name: `held` or `confirm`.
        usable: Samples that are used (n,); strips with `masked` shade the others. None for all.
    """

    log: str
    joint: str
    t: np.ndarray
    strips: tuple[Strip, ...]
    held_out: bool = False
    bands: tuple[tuple[float, float, str], ...] = field(default=())
    usable: np.ndarray | None = None


def build_strip(
    label: str, height: int, *curves: Curve, masked: bool = False, bounds: Sequence[float] = (), symmetric: bool = False
) -> Strip:
    """Return a strip whose axis contains all curves, and the bounds that are not far outside."""
    low, high = pad_limits(*(c.values for c in curves))
    if symmetric:
        low, high = -max(-low, high), max(-low, high)
    near = tuple(
        float(b) for b in bounds if np.isfinite(b) and low - 0.5 * (high - low) <= b <= high + 0.5 * (high - low)
    )
    limits = pad_limits(np.array([low, high, *near]), share=0.02) if near else (low, high)
    return Strip(label, curves, limits, height, masked, near)


def pad_limits(*arrays: np.ndarray, share: float = 0.06) -> tuple[float, float]:
    """Return limits that contain all values with a margin."""
    values = np.concatenate([np.ravel(a) for a in arrays])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    air = share * (high - low) or share * abs(high) or 1.0
    return low - air, high + air


def average_in_bins(x: np.ndarray, y: np.ndarray, bins: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean x, mean y and y's deviation in steps of x that do not straddle zero; steps of few samples are left out."""
    index = np.floor(x / (float(np.ptp(x)) / bins or 1.0)).astype(int)
    rows = []
    for i in np.unique(index):
        members = index == i
        if members.sum() >= 5:
            rows.append((x[members].mean(), y[members].mean(), y[members].std()))
    at, mean, deviation = np.array(rows).T if rows else np.empty((3, 0))
    return at, mean, deviation


def build_histogram(edges: np.ndarray, heights: np.ndarray, ink: str = "histogram") -> Line:
    """Return the outline of a histogram's columns: edges (n + 1,), heights (n,)."""
    x, y = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])
    return Line(x, y, ink)
