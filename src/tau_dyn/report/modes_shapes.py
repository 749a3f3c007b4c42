"""How the structure moves in each mode: along the tool's axes where the outputs are those, as arrows and bars elsewhere.

A mode's shape is complex: the size is how far an output swings, the angle when. Turned so that the strongest swings at full real
part, what stays real moves in step (or against it), what is imaginary a quarter of a period later.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from tau_dyn.modes import Mode
from tau_dyn.report.svg import format_path, format_tag

AXES = {"x": (0.90, 0.30), "y": (-0.78, 0.42), "z": (0.0, -1.0)}
"""Where the axes of space point on the drawing, y down: seen from above, in front and the right."""
SIZE, REACH = 190, 62.0
PERIOD = 2.4
"""Seconds that one swing takes on the page, whatever it takes in truth."""


def normalise_shape(shape: np.ndarray) -> np.ndarray:
    """Return a shape whose strongest entry is 1 and real."""
    top = shape[np.argmax(np.abs(shape))]
    return shape / top if top != 0 else shape


def draw_shape(mode: Mode, outputs: Sequence[str]) -> Markup:
    """Return the drawing of a mode: a path in space where two or three outputs are axes of one point, else bars."""
    axes = find_space_axes(outputs)
    return _path(normalise_shape(mode.shape), axes) if axes else _bars(normalise_shape(mode.shape), outputs)


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
