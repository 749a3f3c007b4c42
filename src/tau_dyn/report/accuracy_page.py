"""The page of `tau-dyn accuracy`: the map, every method on the same errors, where simple bounds fail, what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.report import accuracy_charts as charts
from tau_dyn.report.accuracy_words import (
    METHOD_WORDS,
    describe_headline,
    describe_inputs,
    describe_place,
    describe_verdict,
    format_sentence,
    format_share,
    format_size,
)
from tau_dyn.report.formatting import format_number
from tau_dyn.report.html_page import PageHeader, render_page

SHOWN_OFF = 0.002
"""Departure from exact below which a map of it would show rounding."""


def build_accuracy_page(found: AccuracyResult, *, files: Sequence[tuple[str, str]] = (), command_line: str = "") -> str:
    """Return accuracy as one HTML page.

    Args:
        found: The result.
        files: Name and hash of every measured file.
        command_line: The command that repeats it, for the provenance.
    """
    judged, badge = describe_verdict(found)
    a = found.accuracy
    return render_page(
        "accuracy.html.j2",
        f"{found.robot.name}: accuracy",
        PageHeader(
            f"{describe_headline(found).rstrip('.')}.", judged.level, badge, judged.sentence, describe_inputs(found)
        ),
        [],
        robot=found.robot,
        logs=[("measured", name, sha256) for name, sha256 in files],
        command_line=command_line,
        name=found.robot.name,
        found=found,
        maps=_maps(found),
        off_maps=_off_maps(found),
        rows=[] if a is None else [_row(found, m) for m in a.largest],
        turns=[] if a is None else [(m, _milli(np.nanmedian(x)), _milli(np.nanmax(x))) for m, x in a.turned.items()],
        left_out={} if a is None else a.left_out,
        samples=0 if a is None else a.samples,
        assumed=_assumed(found),
        growth=charts.draw_growth_chart(found),
        held=_held(found),
        styles=charts.COMPARED,
        bodies=[_body(found, k) for k in range(len(found.bodies))],
        guideways=[(g, _line_row(g), charts.draw_guideway_charts(g)) for g in found.measured.guideways],
        sentences=[format_sentence(s) for s in found.measured.sentences],
        orientation=None
        if found.measured.orientation is None
        else charts.draw_orientation_chart(found.measured.orientation),
        near_pole=found.measured.orientation is not None and found.measured.orientation.near_pole,
    )


def _maps(found: AccuracyResult) -> list[Any]:
    a = found.accuracy
    if a is None or found.grid is None:
        return []
    maps = [charts.draw_error_map(found, a.best_method)]
    maps += [charts.draw_usual_map(found)] if a.usual.size and np.isfinite(a.usual).any() else []
    return [*maps, *([charts.turn_map(found)] if a.turned else [])]


def _off_maps(found: AccuracyResult) -> list[Any]:
    a = found.accuracy
    if a is None or found.grid is None or "exact" not in a.largest:
        return []
    tried = [m for m in ("linear", "parallelepiped", "ellipsoid") if m in a.largest and np.isfinite(a.off(m)).any()]
    return [charts.draw_departure_map(found, m) for m in tried if np.nanmax(np.abs(a.off(m))) > SHOWN_OFF]


def _row(found: AccuracyResult, method: str) -> dict[str, Any]:
    a, s = found.accuracy, found.summary(method)
    assert a is not None
    off = a.off(method) if "exact" in a.largest and method != "exact" else np.full(1, np.nan)
    there = np.isfinite(off).any()
    return {
        "name": method,
        "what": METHOD_WORDS[method],
        "least": format_size(s.least),
        "median": format_size(s.median),
        "most": format_size(s.most),
        "where": describe_place(a.position[s.worst_pose]) if np.isfinite(s.most) else "–",
        "unanswered": s.unanswered or "",
        "low": format_share(float(np.nanmin(off))) if there else "",
        "high": format_share(float(np.nanmax(off))) if there else "",
    }


def _milli(radians: float) -> str:
    return f"{format_number(1e3 * float(radians), 3)} mrad" if np.isfinite(radians) else "–"


def _assumed(found: AccuracyResult) -> list[tuple[str, str]]:
    a = found.accuracy
    if a is None:
        return []
    rows = []
    for joint, error in a.errors.actuators.items():
        unit = found.robot.position_units[found.robot.actuated.index(joint)]
        if error.axes is not None:
            said = ", ".join(f"{format_size(x)} in {axis}" for axis, x in zip("xyz", error.axes, strict=True))
        elif unit == "rad":
            said = f"{format_number(1e3 * error.along, 3)} mrad"
        elif error.across is None:
            said = f"{format_size(error.along)} along its motion"
        elif error.across == error.along:
            said = f"{format_size(error.along)} in all directions"
        else:
            said = f"{format_size(error.along)} along, {format_size(error.across)} across its motion"
        rows.append((joint, said))
    for rod, error in a.errors.rods.items():
        parts = (("length", error.length), ("base joint", error.base), ("plate joint", error.plate))
        rows.append((rod, ", ".join(f"{what} {format_size(x)}" for what, x in parts if x)))
    return rows


def _held(found: AccuracyResult) -> list[tuple[str, str, str]]:
    """Return for each bound up to which enlargement of the errors it stays within 1 % and 10 %."""
    g = found.growth
    if g is None:
        return []
    tried = [m for m in ("linear", "parallelepiped", "ellipsoid") if m in g.largest]
    return [(m, _times(g.holds_to(m, 0.01)), _times(g.holds_to(m, 0.1))) for m in tried]


def _times(factor: float) -> str:
    return f"× {format_number(factor, 4)}" if np.isfinite(factor) else "never"


def _body(found: AccuracyResult, k: int) -> dict[str, Any]:
    a, body = found.accuracy, found.bodies[k]
    assert a is not None
    single = len(found.bodies) == 1
    title = "worst pose, nearest home" if single else ("nearest home", "worst pose")[k]
    return {"title": title, "where": describe_place(a.position[body.pose]), "charts": charts.draw_body_charts(body),
            "size": format_size(float(np.linalg.norm(body.worst))), "boxed": len(body.corners) > 0}  # fmt: skip


def _line_row(line: Any) -> dict[str, str]:
    along, across = line.bounds()
    scale, stderr = line.scale
    return {
        "n": str(len(line.q)),
        "mean": format_size(float(line.sizes.mean())),
        "std": format_size(float(line.sizes.std(ddof=1))),
        "along": format_size(along),
        "across": format_size(across),
        "bow": f"{format_size(line.bow.size)} ± {format_size(line.bow.stderr)}",
        "scale": f"{format_number(1e6 * scale, 3)} ± {format_number(1e6 * stderr, 2)}",
        "cycle": "–"
        if line.cycle is None or line.cycle.p_value > 0.01
        else f"amplitude {format_size(line.cycle.amplitude)}, period {format_size(line.cycle.period)}",
        "aliases": ""
        if line.cycle is None or not line.cycle.aliases
        else ", ".join(format_size(x) for x in line.cycle.aliases),
        "backlash": "–"
        if line.backlash is None
        else f"{format_size(line.backlash.size)} ± {format_size(line.backlash.stderr)}",
    }
