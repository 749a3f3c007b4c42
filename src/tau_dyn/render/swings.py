"""Mode shapes: on the robot, at rest in grey and swung out in colour, or by themselves, as a path in space or as bars.

On the screen they swing; on paper, and for those who asked for less motion, they stand swung out. Sizes of modes cannot be
compared: each is drawn as large as its figure takes. A shape is complex: its size is how far an output swings, its angle when.
Turned so that the strongest swings at full real part, what stays real moves in step, what is imaginary a quarter of a period
later.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.render.sketch import Projection, compute_hull, project
from tau_dyn.render.svg import format_path, format_tag
from tau_dyn.results import ShapePicture, SwingPicture, format_number

WIDTH, HEIGHT, MARGIN = 330, 250, 30
_MAX_REACH = 24.0
"""Largest displacement of a drawing [px]."""
FRAMES = 13
"""Drawings a swing; the browser goes from one to the next in straight lines."""
_ARROW = 1.8
"""Arrows are drawn longer than the body moves, so that they are seen beside it."""
AXES = {"x": (0.90, 0.30), "y": (-0.78, 0.42), "z": (0.0, -1.0)}
"""Where the axes of space point on the drawing, y down: seen from above, in front and the right."""
SIZE, REACH = 190, 62.0
PERIOD = 2.4
"""Seconds that one swing takes on the page, whatever it takes in truth."""


def _project(skeleton: Any) -> Projection:
    spots = [at[None] for at in skeleton.places.values()]
    return Projection.of(
        np.concatenate([*skeleton.links, *skeleton.rails, skeleton.joints, *spots]), WIDTH, HEIGHT, MARGIN
    )


def draw_swing(picture: SwingPicture) -> Markup:
    """Return a mode on the robot: outlines at rest, the swing, carts, and arrows where sensors are."""
    skeleton, swing = picture.skeleton, picture.swing
    view = _project(skeleton)
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
    text = f"{picture.who}: {format_number(swing.frequency_hz, 3)} Hz on the robot"
    return format_tag(
        "svg", format_tag("title", text), *pieces, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", class_="robot swinging"
    )  # fmt: skip


def _frames(points: np.ndarray, moved: np.ndarray, view: Projection) -> list[str]:
    """Return one outline each for moments of a swing, the first again at the end; hulls keep their corners."""
    flat = view.place(points)
    corners = _corners(flat)
    angles = np.linspace(0, 2 * np.pi, FRAMES)
    return [_around((flat + _MAX_REACH * project(np.real(moved * np.exp(1j * x))))[corners]) for x in angles]


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
    tip = _ARROW * _MAX_REACH * project(np.real(moved)[None])[0]
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


def normalise_shape(shape: np.ndarray) -> np.ndarray:
    """Return a shape whose strongest entry is 1 and real."""
    top = shape[np.argmax(np.abs(shape))]
    return shape / top if top != 0 else shape


def draw_shape(picture: ShapePicture) -> Markup:
    """Return the drawing of a mode: a path in space where two or three outputs are axes of one point, else bars."""
    axes, shape = find_space_axes(picture.outputs), normalise_shape(picture.shape)
    return _path(shape, axes) if axes else _bars(shape, picture.outputs)


def find_space_axes(outputs: Sequence[str]) -> dict[str, int]:
    """Return which output is which axis of one point: `x_tool y_tool`, `ax_tool ay_tool az_tool`; empty where they are not."""
    found: dict[str, dict[str, int]] = {}
    for k, name in enumerate(outputs):
        match = re.fullmatch(r"([av]?)([xyz])(?:_(\w+))?", name)
        if match:
            found.setdefault(f"{match[1]} {match[3]}", {})[match[2]] = k
    best = max(found.values(), key=len, default={})
    return best if len(best) >= 2 and len(best) == len(outputs) else {}


def _path(shape: np.ndarray, axes: dict[str, int]) -> Markup:
    """Return the tool's path through one swing, an ellipse seen in perspective, with a dot that runs along it."""
    middle = np.array([SIZE / 2, SIZE / 2])
    angle = np.linspace(0, 2 * np.pi, 73)
    swing = np.zeros((len(angle), 2))
    for axis, k in axes.items():
        swing += np.outer(np.real(shape[k] * np.exp(1j * angle)), AXES[axis])
    path = middle + REACH * swing / max(float(np.abs(swing).max()), 1e-12)
    d = format_path(path, closed=True)
    pieces = []
    for axis, (a, b) in AXES.items():
        if axis not in axes:
            continue
        end = middle + 84 * np.array([a, b])
        start = middle - 84 * np.array([a, b])
        pieces.append(format_tag("path", d=f"M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}", class_="axis"))
        pieces.append(format_tag("text", axis, x=float(end[0]) + 4, y=float(end[1]) + 4))
    flat = path - middle
    far = flat[np.argmax(np.hypot(*flat.T))]
    wide = float(np.abs(flat @ np.array([-far[1], far[0]])).max() / max(float(far @ far), 1e-12))
    pieces.append(format_tag("path", d=d, class_="swing wide" if wide > 0.03 else "swing"))
    pieces.append(format_tag("path", d=f"M{middle[0]:.1f} {middle[1]:.1f}m-4 0h8m-4-4v8", class_="rest"))
    run = format_tag("animateMotion", path=d, dur=f"{PERIOD}s", repeatCount="indefinite")
    pieces.append(format_tag("circle", run, r=6, class_="tool"))
    return _drawing(pieces, "path of the tool through one swing", SIZE, SIZE)


def _bars(shape: np.ndarray, outputs: Sequence[str]) -> Markup:
    """Return one swinging bar an output: full where it moves in step, pale what comes a quarter of a period later."""
    p = len(outputs)
    width = max(SIZE, 16 + 30 * p)
    step = (width - 16) / p
    base = 92.0
    pieces = [format_tag("path", d=f"M6 {base:.1f}H{width - 6:.1f}", class_="axis")]
    for k, (name, value) in enumerate(zip(outputs, shape, strict=True)):
        x = 8 + step * (k + 0.5)
        up, late = -REACH * float(value.real), -REACH * float(value.imag)
        half = min(9.0, 0.3 * step)
        ghost = f"M{x - half:.1f} {base:.1f}V{base - up:.1f}H{x + half:.1f}V{base:.1f}Z"
        pieces.append(format_tag("path", d=ghost, class_="ghost"))
        pieces.append(
            format_tag(
                "path", d=f"M{x - half:.1f} {base:.1f}V{base + up:.1f}H{x + half:.1f}V{base:.1f}Z", class_="bar-now"
            )
        )
        if abs(late) > 2:
            pieces.append(format_tag("path", d=f"M{x + half + 3:.1f} {base:.1f}V{base + late:.1f}", class_="late"))
        at = {"x": x, "y": SIZE - 6.0, "text_anchor": "middle"}
        pieces.append(format_tag("text", name if len(name) <= 9 else f"{name[:8]}…", **at))
    return _drawing(pieces, "swing of every output", width, SIZE)


def _drawing(pieces: Sequence[Markup], title: str, width: float, height: float) -> Markup:
    return format_tag(
        "svg", format_tag("title", title), *pieces, viewBox=f"0 0 {width:.0f} {height:.0f}", role="img", class_="shape"
    )  # fmt: skip
