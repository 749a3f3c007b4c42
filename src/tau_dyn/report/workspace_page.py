"""The page of `tau-dyn workspace`: size, cross-sections, the cloud with the robot in it, maps, what excludes the rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from tau_dyn.kinematics.workspace import QUANTITIES, Study
from tau_dyn.report import workspace_charts as charts
from tau_dyn.report.formatting import format_list, format_number, format_percent, replace_minus_signs
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.workspace_space import draw_space_picture, draw_tilt_chart
from tau_dyn.report.workspace_words import (
    SHOWN_UNITS,
    SIZE_UNITS,
    describe_badge,
    describe_headline,
    describe_inputs,
    describe_verdict,
    format_shown_value,
)

MAP_WORDS = {
    "condition": "How much better the best direction is than the worst; 1 is isotropic, large is near a singularity.",
    "manipulability": "Product of the Jacobian's singular values: how much the tool moves for a move of the actuators.",
    "singularity": "Least singular value of the homogenised closure: how far it is from a matrix that is singular; 0 is there.",
    "stiffness": "Force per displacement along the direction that gives way most, the tool free to turn.",
    "speed": "Speed that the actuators' limits allow in every direction, without turning.",
    "force": "Force that the actuators' limits hold in every direction; gravity not counted.",
}


def build_workspace_page(found: Study, *, command_line: str = "") -> str:
    """Return a workspace as one HTML page.

    Args:
        found: The result.
        command_line: The command that repeats it, for the provenance.
    """
    judged, space = describe_verdict(found), found.workspace
    robot = space.machine.robot
    return render_page(
        "workspace.html.j2",
        f"{robot.name}: workspace",
        PageHeader(
            describe_headline(found),
            judged.level,
            describe_badge(judged.level),
            judged.sentence,
            describe_inputs(found),
        ),
        [],
        robot=robot,
        command_line=command_line,
        name=robot.name,
        levels=range(charts.LEVELS),
        rods=space.machine.rods is not None,
        colours=COLOURS,
        warnings=[text[:1].upper() + text[1:] for text in (*robot.warnings, *found.warnings)],
        sections=[charts.draw_section_chart(found, s) for s in found.sections],
        kinds=[(charts.get_reason_class(kind), kind) for kind in charts.list_reasons(found)],
        areas=[(replace_minus_signs(s.name), f"{format_number(s.area, 3)} m²") for s in found.sections],
        space=draw_space_picture(found),
        obstacles=[o.name for o in space.judge.demands.surroundings.obstacles],
        reasons=_reasons(found),
        facts=_facts(found),
        figures=_figures(found),
        ellipsoid=_ellipsoid(found),
        elasticity=found.catalogue.elasticity,
        length=found.catalogue.length,
        maps=[_map(found, name) for name in found.maps] if found.sections else [],
        tilt=None if found.tilt is None else draw_tilt_chart(found.tilt),
        tilt_words="" if found.tilt is None else _tilt_words(found),
        demands=_demands(found),
    )


COLOURS = (
    "#440154", "#481668", "#482878", "#433d84", "#3b528b", "#33638d", "#2b738e", "#25838e",
    "#1f948c", "#21a585", "#35b779", "#57c666", "#82d34d", "#b0dd2f", "#dde318", "#fde725",
)  # fmt: skip
"""A scale that keeps its order in grey and to the colour-blind."""


def _reasons(found: Study) -> list[dict[str, Any]]:
    return [
        {
            "class": charts.get_reason_class(row["reason"]),
            "reason": row["reason"],
            "share": format_percent(100 * row["share"]),
            "width": f"{100 * row['share']:.1f}",
            "by": ", ".join(
                f"{name} ({format_percent(100 * n / row['points'])})" for name, n in list(row["culprits"].items())[:4]
            ),
        }
        for row in found.workspace.counts()
    ]


def _facts(found: Study) -> list[tuple[str, str, str]]:
    """Return what stands in large numbers: words, number, unit."""
    space, frame = found.workspace, found.workspace.footprint
    name, unit = space.measure
    rows = [(name, format_number(space.size.value, 3), SIZE_UNITS[unit])]
    if space.dimension == 3 and frame.area > 0:
        rows.append(("workspace per footprint", format_number(space.size.value / frame.area, 2), "m³/m²"))
        if frame.height > 0:
            rows.append(
                ("workspace per installation", format_number(space.size.value / frame.area / frame.height, 2), "")
            )
    for quantity, which, words in (("stiffness", 0, "least"), ("speed", 0, "least"), ("condition", 1, "median")):
        if quantity in found.catalogue.rows:
            value, _, shown_unit = format_shown_value(quantity, found.catalogue.rows[quantity][0][which]).partition(" ")
            rows.append((f"{quantity}, {words}", value, shown_unit))
    return rows[:6]


def _figures(found: Study) -> list[dict[str, str]]:
    rows = []
    for name, (spread, home) in found.catalogue.rows.items():
        values = [format_shown_value(name, v) for v in (*spread, home)]
        rows.append(
            dict(zip(("least", "median", "most", "home"), values, strict=True)) | {"what": QUANTITIES[name].words}
        )
    return rows


def _ellipsoid(found: Study) -> list[tuple[str, str, str]]:
    """Return main stiffnesses at home, softest first, with their directions."""
    if found.catalogue.stiffness_at_home is None:
        return []
    values, axes = found.catalogue.stiffness_at_home
    names = ("softest", "between", "stiffest")
    return [
        (name, format_shown_value("stiffness", float(value)), ", ".join(f"{c:+.2f}".replace("-", "−") for c in axis))
        for name, value, axis in zip(names, values, axes.T, strict=True)
    ]


def _map(found: Study, name: str) -> dict[str, Any]:
    quantity = QUANTITIES[name]
    unit = SHOWN_UNITS[quantity.unit][1]
    return {
        "title": quantity.words + (f" [{unit}]" if unit else ""),
        "words": MAP_WORDS[name],
        "scale": charts.scale_bar(found, name),
        "charts": [charts.map_chart(found, s, name) for s in found.sections],
    }


def _tilt_words(found: Study) -> str:
    assert found.tilt is not None
    rows = found.tilt.to_dict()
    place = ", ".join(f"{x:.3g}" for x in found.tilt.place)
    by = format_list(sorted({r for r in found.tilt.reason if r}), 4)
    limited = f" Stopped by {by}." if by else ""
    return (
        f"At ({place}) m the tool leans {rows['every_way_deg']:.0f}° towards every side and {rows['best_way_deg']:.0f}° "
        f"towards the best.{limited}"
    )


def _demands(found: Study) -> list[tuple[str, str]]:
    space = found.workspace
    demands, frame = space.judge.demands, space.footprint
    rows = [("actuators", "within the robot file's limits" if demands.actuators else "not limited")]
    if space.judge.balls is not None:
        limits = np.rad2deg(np.unique(space.judge.balls.limits[np.isfinite(space.judge.balls.limits)]))
        axes = "given by the robot file" if space.judge.balls.given.all() else "the rods' directions at home"
        rows.append(("ball joints", f"{format_list([f'{x:.4g}°' for x in limits])} from their axes, which are {axes}"))
    apart = f"come closer than {1e3 * demands.clearance:.4g} mm" if demands.clearance else "touch"
    pairs = (
        f"none of {len(space.judge.pairs)} pairs of solids may {apart}" if space.judge.pairs else "no solids to test"
    )
    rows.append(("collisions", pairs if demands.collisions else "not asked"))
    rows.append(("singularities", f"same side as home, condition number below {demands.condition:g}"))
    around = demands.surroundings
    ends = [f"{a} {lo:.4g} to {hi:.4g} m" for a, lo, hi in zip("xyz", around.lower, around.upper, strict=True)
            if np.isfinite([lo, hi]).any()]  # fmt: skip
    rows += [("tool", format_list(ends))] if ends else []
    rows += [("obstacles", format_list([o.name for o in around.obstacles], 12))] if around.obstacles else []
    rows += [("border", f"{demands.border:g} m kept")] if demands.border else []
    size = frame.upper - frame.lower
    if frame.area > 0:
        rows.append(
            (
                "footprint",
                f"{size[0]:.3g} × {size[1]:.3g} m = {frame.area:.3g} m², {frame.height:.3g} m high: {frame.what}",
            )
        )
    return rows
