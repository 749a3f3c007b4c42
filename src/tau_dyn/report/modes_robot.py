"""Mode shapes drawn on the robot: at rest in grey, swung out in colour.

On the screen it swings; on paper, and for those who asked for less motion, it stands swung out. The view is that of
`robot_picture`. Sizes of modes cannot be compared: each is drawn as large as its figure takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from scipy.spatial import ConvexHull, QhullError

from tau_dyn.modes.figure import Skeleton
from tau_dyn.modes.on_robot import Pair, ShapesOnRobot, Swing
from tau_dyn.report.modes_shapes import PERIOD
from tau_dyn.report.robot_picture import project
from tau_dyn.report.svg import tag
from tau_dyn.report.words import number

WIDTH, HEIGHT, MARGIN = 330, 250, 30
REACH = 24.0
"""Largest displacement of a drawing [px]."""
FRAMES = 13
"""Drawings a swing; the browser goes from one to the next in straight lines."""
_ARROW = 1.8
"""Arrows are drawn longer than the body moves, so that they are seen beside it."""


class Drawn(NamedTuple):
    """One mode: drawing and caption as measured, and of the robot file's own; empty where there is none."""

    measured: Markup
    caption: str
    model: Markup
    beside: str


def robot_drawings(shapes: ShapesOnRobot | None, chosen: Sequence[bool]) -> list[Drawn]:
    """Return the drawings of the modes that are chosen; none without a robot."""
    if shapes is None:
        return []
    view, skeleton = _View.of(shapes.skeleton), shapes.skeleton
    pairs = [pair for pair, take in zip(shapes.pairs, chosen, strict=True) if take]
    return [
        Drawn(_drawing(skeleton, p.measured, view, "measured"), _said(p.measured), *_beside(skeleton, p, view))
        for p in pairs
    ]


def _beside(skeleton: Skeleton, pair: Pair, view: _View) -> tuple[Markup, str]:
    if pair.model is None:
        return Markup(""), ""
    return _drawing(skeleton, pair.model, view, "robot file"), f"{_said(pair.model)}, MAC {pair.mac:.2f}"


def _said(swing: Swing) -> str:
    return f"{number(swing.frequency_hz, 4)} Hz, damping {number(100 * swing.damping_ratio, 2)} %"


class _View:
    """Maps points of space to the drawing, and displacements on one scale."""

    def __init__(self, scale: float, shift: np.ndarray) -> None:
        self.scale, self.shift = scale, shift

    @classmethod
    def of(cls, skeleton: Skeleton) -> _View:
        flat = project(np.concatenate([*skeleton.links, *skeleton.rails, skeleton.joints, *_rows(skeleton)]))
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
        scale = float(np.min(room / np.maximum(high - low, 1e-3)))
        return cls(scale, np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2)

    def place(self, points: np.ndarray, moved: np.ndarray | float = 0.0) -> np.ndarray:
        """Return points (n, 3) [m] on the drawing (n, 2) [px], moved by so many pixels' worth (n, 3)."""
        flat = self.scale * project(points) + self.shift
        return flat + project(np.broadcast_to(moved, points.shape))


def _rows(skeleton: Skeleton) -> list[np.ndarray]:
    return [at[None] for at in skeleton.places.values()]


def _drawing(skeleton: Skeleton, swing: Swing, view: _View, who: str) -> Markup:
    pieces = [tag("path", d=_line(view.place(rail)), class_="rail") for rail in skeleton.rails]
    order = sorted(range(len(skeleton.links)), key=lambda k: -len(skeleton.links[k]))
    pieces += [tag("path", d=_outline(view.place(skeleton.links[k])), class_="at-rest") for k in order]
    moving, still = [], []
    for k in order:
        if np.abs(swing.links[k]).max() < 1e-3:
            continue
        class_ = "rod" if len(skeleton.links[k]) == 2 else "plate"
        frames = _frames(skeleton.links[k], swing.links[k], view)
        still.append(tag("path", d=frames[0], class_=class_))
        run = tag("animate", attributeName="d", values=";".join(frames), dur=f"{PERIOD}s", repeatCount="indefinite")
        moving.append(tag("path", run, d=frames[0], class_=class_))
    pieces += [tag("g", *still, class_="still"), tag("g", *moving, class_="moving")]
    spots = view.place(skeleton.joints)
    pieces += [tag("rect", x=float(x) - 6, y=float(y) - 4.5, width=12, height=9, rx=2, class_="cart") for x, y in spots]
    pieces += [_arrow(view.place(at[None])[0], swing.arrows[name]) for name, at in skeleton.places.items()]
    text = f"{who}: {number(swing.frequency_hz, 3)} Hz on the robot"
    return tag(
        "svg", tag("title", text), *pieces, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", class_="robot swinging"
    )  # fmt: skip


def _frames(points: np.ndarray, moved: np.ndarray, view: _View) -> list[str]:
    """Return one outline each for moments of a swing, the first again at the end; hulls keep their corners."""
    corners = _corners(view.place(points))
    angles = np.linspace(0, 2 * np.pi, FRAMES)
    return [_closed(view.place(points, REACH * np.real(moved * np.exp(1j * x)))[corners]) for x in angles]


def _corners(flat: np.ndarray) -> np.ndarray:
    """Return which points (n, 2) are drawn, in order."""
    if len(flat) > 2:
        try:
            return ConvexHull(flat).vertices
        except (QhullError, ValueError):  # all on one line
            pass
    return np.arange(len(flat))


def _outline(flat: np.ndarray) -> str:
    return _closed(flat[_corners(flat)])


def _closed(flat: np.ndarray) -> str:
    return _line(flat) + ("Z" if len(flat) > 2 else "")


def _line(flat: np.ndarray) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in flat)


def _arrow(at: np.ndarray, moved: np.ndarray) -> Markup:
    """Return where a sensor's place swings to and fro: the ends of its way, with heads."""
    tip = _ARROW * REACH * project(np.real(moved)[None])[0]
    size = float(np.hypot(*tip))
    if size < 4:
        return tag("circle", cx=float(at[0]), cy=float(at[1]), r=3, class_="sensor")
    along, across = tip / size, np.array([-tip[1], tip[0]]) / size
    pieces = []
    for side in (1, -1):
        end = at + side * tip
        head = [end - side * 6 * along + 3.5 * across, end, end - side * 6 * along - 3.5 * across]
        pieces += [_line(np.array([at, end])), _line(np.array(head))]
    return tag("path", d="".join(pieces), class_="arrow")
