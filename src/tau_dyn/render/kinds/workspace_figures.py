"""Cross-sections of a workspace as figures: where the tool can be and why not elsewhere, and maps with their scales."""

from __future__ import annotations

import numpy as np

from tau_dyn import results as r
from tau_dyn.kinematics.workspace import KINDS, QUANTITIES, Section, Study

TALLEST = 420
"""Height of a section's plot at most [px]."""
LEVELS = 16
"""Colours of a map."""
SHOWN_UNITS = {
    "N/m": (1e-6, "N/µm"),
    "m/s": (1.0, "m/s"),
    "m": (1e6, "µm"),
    "Hz": (1.0, "Hz"),
    "N": (1.0, "N"),
    "1": (1.0, ""),
}
"""Factor and unit in which quantities are shown; files stay in SI."""
_AXES = "xyz"
_MIN_LOG_RATIO = 12.0  # largest over least from which a map is drawn in logarithms


def get_reason_ink(kind: str) -> str:
    """Return the ink of a reason."""
    return "w-" + kind.replace(" ", "-")


def choose_window(found: Study, s: Section) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the part of a section that is drawn: the workspace with a fifth around it, within the box, and the carts."""
    marks = _find_marks(found)[:, [s.across, s.up]]
    limits = []
    for k, (x, used) in enumerate(((s.u, s.inside.any(axis=1)), (s.v, s.inside.any(axis=0)))):
        there = x[used] if used.any() else x
        air = 0.2 * max(float(np.ptp(there)), 1e-3)
        low, high = max(float(there.min()) - air, float(x[0])), min(float(there.max()) + air, float(x[-1]))
        thin = 0.03 * (high - low)
        limits.append((min(low, float(marks[:, k].min()) - thin), max(high, float(marks[:, k].max()) + thin)))
    return limits[0], limits[1]


def _build_figure(found: Study, s: Section, marks: list[r.Mark], style: str = "") -> r.Figure:
    """Return marks on a section, both axes to one scale, with the carts and the tool at home."""
    xlim, ylim = choose_window(found, s)
    wide = r.THIRD - 56
    tall = wide * (ylim[1] - ylim[0]) / (xlim[1] - xlim[0])
    if tall > TALLEST:  # keep the scale of both axes equal: widen
        air = (tall / TALLEST - 1) * (xlim[1] - xlim[0]) / 2
        xlim, tall = (xlim[0] - air, xlim[1] + air), TALLEST
    spots = _find_marks(found)[:, [s.across, s.up]]
    at_home = (
        r.Dots(spots[:-1, 0], spots[:-1, 1], "w-cart", "square", 3.5),
        r.Dots(spots[-1:, 0], spots[-1:, 1], "w-home", "plus", 4.0),
    )
    x, y = r.Axis(f"{_AXES[s.across]} [m]", xlim), r.Axis(f"{_AXES[s.up]} [m]", ylim)
    return r.Figure(x, y, (*marks, *at_home), r.replace_minus_signs(s.name), (r.THIRD, round(tall) + 54), style=style)


def build_section_figure(found: Study, s: Section) -> r.Figure:
    """Return a section: the workspace, what excludes the rest, the rods' joints on their guideways as squares."""
    kinds = [kind for kind in KINDS if kind != "out of reach"]
    of = np.full(s.code.shape, -1)
    for code, kind, _ in found.workspace.reasons.items():
        if kind in kinds:
            of[s.code == code] = kinds.index(kind)
    of[s.inside] = len(kinds)
    cells = r.Cells(s.u, s.v, of, (*map(get_reason_ink, kinds), "w-in"))
    return _build_figure(found, s, [cells])


def list_reasons(found: Study) -> list[str]:
    """Return the reasons that any section shows, in their order."""
    codes = np.unique(np.concatenate([s.code.ravel() for s in found.sections])) if found.sections else []
    there = {kind for code, kind, _ in found.workspace.reasons.items() if code in codes}
    return [kind for kind in KINDS if kind in there and kind != "out of reach"]


def choose_map_scale(found: Study, name: str) -> tuple[float, float, bool]:
    """Return the ends of a map's colours over all sections, and whether they run in logarithms."""
    values = np.concatenate([s.maps[name][np.isfinite(s.maps[name])] for s in found.sections])
    if not len(values):
        return 0.0, 1.0, False
    low, high = (float(v) for v in np.quantile(values, [0.01, 0.99]))
    logarithmic = low > 0 and high > _MIN_LOG_RATIO * low
    return low, high if high > low else low + max(abs(low), 1e-9) * 1e-3, logarithmic


def build_map_figure(found: Study, s: Section, name: str) -> r.Figure:
    """Return a map of one quantity in a section."""
    low, high, logarithmic = choose_map_scale(found, name)
    values = s.maps[name]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.log(values / low) / np.log(high / low)) if logarithmic else (values - low) / (high - low)
    level = np.clip(np.floor(np.nan_to_num(share, nan=-1.0, posinf=1.0) * LEVELS), 0, LEVELS - 1).astype(int)
    cells = r.Cells(s.u, s.v, np.where(np.isnan(values), -1, level), [f"m{k}" for k in range(LEVELS)])
    return _build_figure(found, s, [cells], "over-map")


def build_scale(found: Study, name: str) -> r.ColourScale:
    """Return a map's scale: its colours from low to high with numbers."""
    low, high, logarithmic = choose_map_scale(found, name)
    factor, _ = SHOWN_UNITS[QUANTITIES[name].unit]
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    values = [low * (high / low) ** x if logarithmic else low + x * (high - low) for x in shares]
    return r.ColourScale([f"m{k}" for k in range(LEVELS)], [r.format_number(factor * x, 3) for x in values])


def _find_marks(found: Study) -> np.ndarray:
    """Return where the rods' joints on their carts (or an arm's actuators) are at home, then the tool (n + 1, 3)."""
    machine = found.workspace.machine
    tool = machine.home.position
    if machine.rods is None:
        return np.concatenate([np.zeros((1, 3)), tool])
    return np.concatenate([machine.rods.base_points(machine.robot.home[None])[0], tool])
