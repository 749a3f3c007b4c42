"""Cross-sections of a workspace as drawings: where the tool can be and why not elsewhere, and maps with scale bars."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from tau_dyn.kinematics.workspace import KINDS, QUANTITIES, Section, Study
from tau_dyn.report.formatting import format_number, replace_minus_signs
from tau_dyn.report.svg import BOTTOM, LEFT, RIGHT, THIRD, TOP, Chart, format_tag
from tau_dyn.report.workspace_words import SHOWN_UNITS

WIDTH, TALLEST = THIRD, 420
LEVELS = 16
"""Colours of a map."""
_AXES = "xyz"
_LOG = 12.0  # largest over least from which a map is drawn in logarithms


def get_reason_class(kind: str) -> str:
    """Return the style class of a reason."""
    return "w-" + kind.replace(" ", "-")


def choose_window(found: Study, s: Section) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the part of a section that is drawn: the workspace with a fifth around it, within the box, and the carts."""
    marks = _marks(found)[:, [s.across, s.up]]
    limits = []
    for k, (x, used) in enumerate(((s.u, s.inside.any(axis=1)), (s.v, s.inside.any(axis=0)))):
        there = x[used] if used.any() else x
        air = 0.2 * max(float(np.ptp(there)), 1e-3)
        low, high = max(float(there.min()) - air, float(x[0])), min(float(there.max()) + air, float(x[-1]))
        thin = 0.03 * (high - low)
        limits.append((min(low, float(marks[:, k].min()) - thin), max(high, float(marks[:, k].max()) + thin)))
    return limits[0], limits[1]


def _chart(found: Study, s: Section, title: str) -> Chart:
    xlim, ylim = choose_window(found, s)
    wide = WIDTH - LEFT - RIGHT
    tall = wide * (ylim[1] - ylim[0]) / (xlim[1] - xlim[0])
    if tall > TALLEST:  # keep the scale of both axes equal: widen
        air = (tall / TALLEST - 1) * (xlim[1] - xlim[0]) / 2
        xlim, tall = (xlim[0] - air, xlim[1] + air), TALLEST
    return Chart(
        WIDTH, round(tall) + TOP + BOTTOM, xlim, ylim, title, f"{_AXES[s.across]} [m]", f"{_AXES[s.up]} [m]"
    )  # fmt: skip


def draw_section_chart(found: Study, s: Section) -> Markup:
    """Return a section: the workspace, what excludes the rest, the rods' joints on their guideways as squares."""
    chart = _chart(found, s, replace_minus_signs(s.name))
    pieces = []
    kinds: dict[str, list[int]] = {}
    for code, kind, _ in found.workspace.reasons.items():
        if kind != "out of reach":
            kinds.setdefault(kind, []).append(code)
    for kind, codes in kinds.items():
        pieces.append(_area(chart, s, np.isin(s.code, codes), get_reason_class(kind)))
    pieces.append(_area(chart, s, s.inside, "w-in"))
    return chart.render(*pieces, *_drawn_marks(found, chart, s))


def list_reasons(found: Study) -> list[str]:
    """Return the reasons that any section shows, in their order."""
    codes = np.unique(np.concatenate([s.code.ravel() for s in found.sections])) if found.sections else []
    there = {kind for code, kind, _ in found.workspace.reasons.items() if code in codes}
    return [kind for kind in KINDS if kind in there and kind != "out of reach"]


def map_scale(found: Study, name: str) -> tuple[float, float, bool]:
    """Return the ends of a map's colours over all sections, and whether they run in logarithms."""
    values = np.concatenate([s.maps[name][np.isfinite(s.maps[name])] for s in found.sections])
    if not len(values):
        return 0.0, 1.0, False
    low, high = (float(v) for v in np.quantile(values, [0.01, 0.99]))
    logarithmic = low > 0 and high > _LOG * low
    return low, high if high > low else low + max(abs(low), 1e-9) * 1e-3, logarithmic


def map_chart(found: Study, s: Section, name: str) -> Markup:
    """Return a map of one quantity in a section."""
    chart = _chart(found, s, replace_minus_signs(s.name))
    low, high, logarithmic = map_scale(found, name)
    values = s.maps[name]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.log(values / low) / np.log(high / low)) if logarithmic else (values - low) / (high - low)
    level = np.clip(np.floor(np.nan_to_num(share, nan=-1.0, posinf=1.0) * LEVELS), 0, LEVELS - 1).astype(int)
    pieces = [_area(chart, s, (level == k) & ~np.isnan(values), f"m{k}") for k in range(LEVELS)]
    return chart.render(*pieces, *_drawn_marks(found, chart, s))


def scale_bar(found: Study, name: str) -> Markup:
    """Return a map's scale: its colours from low to high with numbers."""
    low, high, logarithmic = map_scale(found, name)
    factor, _ = SHOWN_UNITS[QUANTITIES[name].unit]
    pieces, width = [], 15.0
    for k in range(LEVELS):
        pieces.append(format_tag("rect", x=4 + k * width, y=2, width=width + 0.5, height=11, class_=f"m{k}"))
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        value = low * (high / low) ** share if logarithmic else low + share * (high - low)
        x = 4 + share * LEVELS * width
        anchor = "start" if share == 0 else "end" if share == 1 else "middle"
        pieces.append(format_tag("text", format_number(factor * value, 3), x=x, y=26, text_anchor=anchor))
    size = 8 + LEVELS * width
    return format_tag(
        "svg", *pieces, viewBox=f"0 0 {size:.0f} 30", width=int(size), height=30, class_="scale", role="img"
    )


def _area(chart: Chart, s: Section, there: np.ndarray, class_: str) -> Markup:
    """Return the cells of a set as one path, rows of neighbours joined."""
    if not there.any():
        return Markup("")
    half_u, half_v = _half(s.u), _half(s.v)
    d = []
    for j in np.flatnonzero(there.any(axis=0) & (s.v >= chart.ylim[0]) & (s.v <= chart.ylim[1])):
        row = np.concatenate([[False], there[:, j], [False]])
        edges = np.flatnonzero(np.diff(row.astype(int)))
        top, bottom = float(chart.y(s.v[j] + half_v)), float(chart.y(s.v[j] - half_v))
        for start, end in zip(edges[::2], edges[1::2] - 1, strict=True):
            left, right = float(chart.x(s.u[start] - half_u)), float(chart.x(s.u[end] + half_u))
            left, right = max(left, float(LEFT)), min(right, float(chart.width - RIGHT))
            if right > left:
                d.append(f"M{left:.1f} {top:.1f}H{right:.1f}V{bottom + 0.15:.1f}H{left:.1f}Z")
    return format_tag("path", d="".join(d), class_=class_) if d else Markup("")


def _half(x: np.ndarray) -> float:
    return float(x[1] - x[0]) / 2 if len(x) > 1 else 0.005


def _marks(found: Study) -> np.ndarray:
    """Return where the rods' joints on their carts (or an arm's actuators) are at home, then the tool (n + 1, 3)."""
    machine = found.workspace.machine
    tool = machine.home.position
    if machine.rods is None:
        return np.concatenate([np.zeros((1, 3)), tool])
    return np.concatenate([machine.rods.base_points(machine.robot.home[None])[0], tool])


def _drawn_marks(found: Study, chart: Chart, s: Section) -> list[Markup]:
    marks = _marks(found)[:, [s.across, s.up]]
    x, y = chart.x(marks[:, 0]), chart.y(marks[:, 1])
    squares = "".join(f"M{a - 3.5:.1f} {b - 3.5:.1f}h7v7h-7Z" for a, b in zip(x[:-1], y[:-1], strict=True))
    cross = f"M{x[-1] - 4:.1f} {y[-1]:.1f}h8m-4 -4v8"
    return [format_tag("path", d=squares, class_="w-cart"), format_tag("path", d=cross, class_="w-home")]
