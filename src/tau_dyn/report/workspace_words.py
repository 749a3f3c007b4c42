"""A workspace in sentences: its size with bounds, and what limits it."""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.workspace import QUANTITIES, Study
from tau_dyn.report.formatting import Level, UseRecommendation, count, format_list, format_number, format_percent

SHOWN_UNITS = {"N/m": (1e-6, "N/µm"), "m/s": (1.0, "m/s"), "N": (1.0, "N"), "1": (1.0, "")}
"""Factor and unit in which quantities are shown; files stay in SI."""

SIZE_UNITS = {"m3": "m³", "m2": "m²", "m": "m", "1": "points"}
"""How the unit of a size is shown, by the workspace's dimension."""


def format_shown_value(name: str, value: float, digits: int = 3) -> str:
    """Return a quantity's value with its unit as a person would read it."""
    if not np.isfinite(value):
        return "–" if np.isnan(value) else "∞"
    factor, unit = SHOWN_UNITS[QUANTITIES[name].unit]
    return f"{format_number(factor * value, digits)} {unit}".strip()


def describe_size(found: Study) -> str:
    """Return the size with its bounds, such as `1.98 m³ (1.93 … 2.03)`."""
    size, (_, unit) = found.workspace.size, found.workspace.measure
    half = (size.high - size.low) / 2
    digits = int(np.clip(np.ceil(-np.log10(max(half, 1e-9))) + 1, 0, 6))
    return f"{size.value:.{digits}f} {SIZE_UNITS[unit]} ({size.low:.{digits}f} … {size.high:.{digits}f})"


def describe_headline(found: Study) -> str:
    """Return the one sentence above everything."""
    space = found.workspace
    extent = space.upper - space.lower
    sides = " × ".join(f"{x:.2f}" for x, n in zip(extent, space.lattice.shape, strict=True) if n > 1)
    return f"The tool reaches {describe_size(found)} within {sides} m, connected to home."


def describe_verdict(found: Study) -> UseRecommendation:
    """Return how far the numbers may be relied on."""
    space = found.workspace
    half = (space.size.high - space.size.low) / 2 / max(space.size.value, 1e-12)
    level: Level = "good" if half < 0.1 else "care" if half < 0.25 else "poor"
    words = f"Bounds of its size: {format_percent(100 * half)} to either side"
    advice = "" if level == "good" else f"; half the step of {format_number(space.lattice.step, 2)} m halves them"
    return UseRecommendation(level, f"{words}{advice}. {describe_limits(found)}")


def describe_limits(found: Study) -> str:
    """Return what cuts the workspace most, beside the robot's reach."""
    rows = [row for row in found.workspace.counts() if row["reason"] != "out of reach"]
    rows.sort(key=lambda row: -row["points"])
    if not rows:
        return "Only the robot's reach limits it."
    named = [f"{row['reason']} ({format_percent(100 * row['share'])})" for row in rows[:3]]
    return f"Besides reach it is limited by {format_list(named)} of the box searched."


def describe_inputs(found: Study) -> str:
    """Return what was done."""
    space = found.workspace
    size = " × ".join(str(n) for n in space.lattice.shape)
    return (
        f"{size} points every {format_number(space.lattice.step, 3)} m, {count(space.judge.n_judged, 'pose')} evaluated; "
        "the rest follows from neighbours and a random check"
    )


def describe_badge(level: Level) -> str:
    """Return the judgement in a word or three."""
    return {"good": "Sharp", "care": "Rough", "poor": "Too rough"}[level]
