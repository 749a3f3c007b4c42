"""Colours by what a part does, and the scale that colours numbers."""

from __future__ import annotations

from html import escape

import numpy as np

Rgb = tuple[int, int, int]

ROLES: dict[str, Rgb] = {
    "frame": (150, 158, 170),
    "driven": (36, 98, 176),
    "rod": (58, 63, 72),
    "plate": (240, 150, 40),
    "passive": (120, 140, 165),
    "ball": (214, 218, 224),
}
"""What a part of the robot does -> its colour; the robot files' own materials are the same."""
CASING: Rgb = (226, 229, 233)
"""An arm's meshes of which the robot file gives no colour."""
NAMED: Rgb = (214, 40, 57)
GHOST: Rgb = (22, 160, 110)
QUIET: Rgb = (196, 202, 210)
"""Where a finding lives, the simulated or commanded robot, and what steps back so that something else is seen."""

_VIRIDIS = np.array(
    [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
     [110, 206, 88], [181, 222, 43], [253, 231, 37]]
)  # fmt: skip


def map_to_colours(value: np.ndarray | None, n: int) -> np.ndarray:
    """Return colours (n, 3) of values (n,) from violet (least) to yellow (most); one colour where there are none."""
    if value is None or not np.isfinite(value).any():
        return np.tile(np.array([90, 140, 200], np.uint8), (n, 1))
    low, high = compute_scale_limits(value)
    share = np.nan_to_num((value - low) / (high - low if high > low else 1.0))
    at = np.clip(share, 0, 1) * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    return np.column_stack([np.interp(at, steps, channel) for channel in _VIRIDIS.T]).round().astype(np.uint8)


def compute_scale_limits(value: np.ndarray) -> tuple[float, float]:
    """Return where the scale begins and ends: all values but the outermost hundredth, which would flatten the rest."""
    low, high = np.nanquantile(value[np.isfinite(value)], [0.01, 0.99])
    return float(low), float(high)


def format_legend(name: str, value: np.ndarray) -> str:
    """Return the scale as HTML: name, bar, both ends. The name is escaped."""
    low, high = compute_scale_limits(value)
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in _VIRIDIS)
    bar = f'<div style="height:10px;border-radius:5px;background:linear-gradient(90deg,{stops})"></div>'
    ends = (
        f'<div style="display:flex;justify-content:space-between"><span>{low:.4g}</span><span>{high:.4g}</span></div>'
    )
    return format_panel(f"<b>{escape(name)}</b>{bar}{ends}")


def format_keys(rows: dict[str, Rgb]) -> str:
    """Return names beside their colours as HTML. The names are escaped."""
    style = "display:inline-block;width:10px;height:10px;border-radius:5px;margin-right:6px"
    dot = f'<span style="{style};background:rgb({{}},{{}},{{}})"></span>'
    return format_panel("".join(f"<div>{dot.format(*rgb)}{escape(name)}</div>" for name, rgb in rows.items()))


def escape_html(text: str) -> str:
    """Return one sentence from outside as HTML that is only text."""
    return format_panel(escape(" ".join(text.split())))


def format_panel(html: str) -> str:
    """Return HTML in the window's small type; whoever calls has escaped what came from outside."""
    return f'<div style="font-size:0.85em;line-height:1.45;padding:0.2em 0.9em 0.4em">{html}</div>'
