"""Mode shapes drawn on the robot: at rest in grey, swung out in colour.

On the screen it swings; on paper, and for those who asked for less motion, it stands swung out. The view is that of
`projection.py`. Sizes of modes cannot be compared: each is drawn as large as its figure takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from tau_dyn.modes import ModePair, ModeShape, ShapesOnRobot, Skeleton
from tau_dyn.report.formatting import format_number
from tau_dyn.report.modes_shapes import PERIOD
from tau_dyn.report.projection import View, compute_hull, project
from tau_dyn.report.svg import format_path, format_tag

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


def draw_robot_modes(shapes: ShapesOnRobot | None, chosen: Sequence[bool]) -> list[Drawn]:
    """Return the drawings of the modes that are chosen; none without a robot."""
    if shapes is None:
        return []
    view, skeleton = _view(shapes.skeleton), shapes.skeleton
    pairs = [pair for pair, take in zip(shapes.pairs, chosen, strict=True) if take]
    return [
        Drawn(_drawing(skeleton, p.measured, view, "measured"), _said(p.measured), *_beside(skeleton, p, view))
        for p in pairs
    ]


def _beside(skeleton: Skeleton, pair: ModePair, view: View) -> tuple[Markup, str]:
    if pair.model is None:
        return Markup(""), ""
    return _drawing(skeleton, pair.model, view, "robot file"), f"{_said(pair.model)}, MAC {pair.mac:.2f}"


def _said(swing: ModeShape) -> str:
    return f"{format_number(swing.frequency_hz, 4)} Hz, damping {format_number(100 * swing.damping_ratio, 2)} %"


def _view(skeleton: Skeleton) -> View:
    spots = [at[None] for at in skeleton.places.values()]
    return View.of(np.concatenate([*skeleton.links, *skeleton.rails, skeleton.joints, *spots]), WIDTH, HEIGHT, MARGIN)


def _drawing(skeleton: Skeleton, swing: ModeShape, view: View, who: str) -> Markup:
    pieces = [format_tag("path", d=format_path(view.place(rail)), class_="rail") for rail in skeleton.rails]
    order = sorted(range(len(skeleton.links)), key=lambda k: -len(skeleton.links[k]))
    pieces += [format_tag("path", d=_outline(view.place(skeleton.links[k])), class_="at-rest") for k in order]
    moving, still = [], []
    for k in order:
        if np.abs(swing.links[k]).max() < 1e-3:
            continue
        class_ = "rod" if len(skeleton.links[k]) == 2 else "plate"
        frames = _frames(skeleton.links[k], swing.links[k], view)
        still.append(format_tag("path", d=frames[0], class_=class_))
        run = format_tag(
            "animate", attributeName="d", values=";".join(frames), dur=f"{PERIOD}s", repeatCount="indefinite"
        )
        moving.append(format_tag("path", run, d=frames[0], class_=class_))
    pieces += [format_tag("g", *still, class_="still"), format_tag("g", *moving, class_="moving")]
    spots = view.place(skeleton.joints)
    pieces += [
        format_tag("rect", x=float(x) - 6, y=float(y) - 4.5, width=12, height=9, rx=2, class_="cart") for x, y in spots
    ]
    pieces += [_arrow(view.place(at[None])[0], swing.arrows[name]) for name, at in skeleton.places.items()]
    text = f"{who}: {format_number(swing.frequency_hz, 3)} Hz on the robot"
    return format_tag(
        "svg", format_tag("title", text), *pieces, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", class_="robot swinging"
    )  # fmt: skip


def _frames(points: np.ndarray, moved: np.ndarray, view: View) -> list[str]:
    """Return one outline each for moments of a swing, the first again at the end; hulls keep their corners."""
    flat = view.place(points)
    corners = _corners(flat)
    angles = np.linspace(0, 2 * np.pi, FRAMES)
    return [_around((flat + REACH * project(np.real(moved * np.exp(1j * x))))[corners]) for x in angles]


def _corners(flat: np.ndarray) -> np.ndarray:
    """Return which points (n, 2) are drawn, in order."""
    around = compute_hull(flat) if len(flat) > 2 else None
    return np.arange(len(flat)) if around is None else around


def _outline(flat: np.ndarray) -> str:
    return _around(flat[_corners(flat)])


def _around(flat: np.ndarray) -> str:
    return format_path(flat, closed=len(flat) > 2)


def _arrow(at: np.ndarray, moved: np.ndarray) -> Markup:
    """Return where a sensor's place swings to and fro: the ends of its way, with heads."""
    tip = _ARROW * REACH * project(np.real(moved)[None])[0]
    size = float(np.hypot(*tip))
    if size < 4:
        return format_tag("circle", cx=float(at[0]), cy=float(at[1]), r=3, class_="sensor")
    along, across = tip / size, np.array([-tip[1], tip[0]]) / size
    pieces = []
    for side in (1, -1):
        end = at + side * tip
        head = [end - side * 6 * along + 3.5 * across, end, end - side * 6 * along - 3.5 * across]
        pieces += [format_path(np.array([at, end])), format_path(np.array(head))]
    return format_tag("path", d="".join(pieces), class_="arrow")
