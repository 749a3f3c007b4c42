"""What a colleague would say about a robot's accuracy: lengths in a fitting unit, the headline, the verdict."""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.report.formatting import (
    UseRecommendation,
    count,
    format_list,
    format_number,
    format_percent,
    replace_minus_signs,
)

SMALL_SHARE = 0.1
"""Departure from the exact worst case up to which a linear bound counts as good."""

METHOD_WORDS = {
    "linear": "Jacobian of the actuators; along their motion only",
    "parallelepiped": "all errors, to first order (A.4)",
    "ellipsoid": "ellipsoidal shells intersected (A.2)",
    "exact": "all errors, constraints solved",
    "certified": "proved upper bound",
    "montecarlo": "worst of the random draws",
}


def format_size(metres: float, digits: int = 3) -> str:
    """Return a length in um, mm or m, whichever reads best."""
    if not np.isfinite(metres):
        return "none"
    factor, unit = next(
        ((f, u) for f, u, top in ((1e6, "µm", 1e-3), (1e3, "mm", 1.0)) if abs(metres) < top), (1.0, "m")
    )
    return f"{format_number(factor * metres, digits)} {unit}"


def scale_of(values: np.ndarray) -> tuple[float, str]:
    """Return factor and unit for a set of lengths [m]."""
    there = np.abs(values[np.isfinite(values)])
    top = float(np.quantile(there, 0.98)) if there.size else 0.0
    return (1e6, "µm") if top < 2e-3 else (1e3, "mm") if top < 2 else (1.0, "m")


def format_share(value: float) -> str:
    """Return a departure from the exact value, such as `−12 %`, `< 0.1 %`."""
    if not np.isfinite(value):
        return "–"
    if abs(value) < 0.001:
        return "< 0.1 %"
    return f"{'+' if value > 0 else '−'}{format_percent(100 * abs(value))}"


def format_sentence(sentence: str) -> str:
    """Return a sentence of a result with the signs that a person would write."""
    return sentence.replace("+-", "±").replace(" um", " µm").replace(" deg", "°")


def describe_place(position: np.ndarray) -> str:
    """Return a tool position in words."""
    return (
        ", ".join(
            f"{name} {format_number(round(float(x), 4) + 0.0, 3)}" for name, x in zip("xyz", position, strict=True)
        )
        + " m"
    )


def describe_headline(found: AccuracyResult) -> str:
    """Return the one sentence above everything."""
    a = found.accuracy
    if a is None:
        return found.measured.sentences[0] if found.measured.sentences else "Nothing was measured."
    if not np.isfinite(a.largest[a.best_method]).any():
        return "No pose keeps its assembly mode for all errors within the bounds"
    s = found.summary(a.best_method)
    start = f"The tool is off by {format_size(s.most)} at most, by {format_size(s.median)} at the median pose"
    if found.lost.any():
        start = (
            f"Where the robot keeps its pose, the tool is off by {format_size(s.most)} at most, "
            f"{format_size(s.median)} at the median pose"
        )
    usual = (
        f"; 95 % of random errors stay below {format_size(float(np.nanmax(a.usual)))}"
        if np.isfinite(a.usual).any()
        else ""
    )
    return start + usual


def describe_verdict(found: AccuracyResult) -> tuple[UseRecommendation, str]:
    """Return how far the numbers hold, and the badge."""
    a = found.accuracy
    if a is None:
        seen = found.measured
        wrong = any(p.sure for p in seen.parallel) or any(g.shape < 0.01 or g.bow.sure for g in seen.guideways)
        said = "The nominal model's assumptions fail beyond the scatter; the sections below say by how much."
        return (UseRecommendation("care", said), "Assumptions fail") if wrong else (
            UseRecommendation("good", "No assumption fails beyond the scatter of these points."), "Assumptions hold")  # fmt: skip
    lost = int(found.lost.sum())
    if lost:
        said = f"At {count(lost, 'pose')} of {len(a.q)} errors within the bounds can reach a singularity; no bound exists there."
        return UseRecommendation("poor", said), "May lose its pose"
    if "exact" not in a.largest:
        return UseRecommendation(
            "care", "Without the exact worst case nothing here tells how good the other bounds are."
        ), "Not compared"
    off = {m: a.off(m) for m in ("linear", "parallelepiped", "ellipsoid") if m in a.largest}
    worst = {m: float(np.nanmax(np.abs(x))) for m, x in off.items() if np.isfinite(x).any()}
    bad = [m for m, x in worst.items() if x > SMALL_SHARE]
    if bad:
        words = format_list([f"{m} by up to {format_percent(100 * worst[m])}" for m in bad])
        said = f"Simple bounds are off: {words}; the exact worst case is the one to use."
        return UseRecommendation("care", said), "Use the exact bound"
    said = "The linear bounds are as good as exact here; errors are small against the rods and no singularity is near."
    proved = "certified" in a.largest and bool(np.isfinite(a.largest["certified"]).all())
    return UseRecommendation("good", said), "Bound proved" if proved else "Bound not proved"


def describe_inputs(found: AccuracyResult) -> str:
    """Return what went in."""
    a = found.accuracy
    if a is None:
        return f"{found.robot.source}; measured points only, no errors to carry to the tool."
    where = (
        count(len(a.q), "pose")
        if found.grid is None
        else f"{count(len(a.q), 'pose')} of the section {replace_minus_signs(found.grid.section.words)}"
    )
    source = ", from measured points" if found.from_measured else ""
    names = [*a.errors.actuators, *a.errors.rods]
    return f"{found.robot.source}, {where}; errors of {format_list(names)}{source}."
