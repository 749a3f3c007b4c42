"""The page of operational modal analysis: the resonances, how the structure moves in them, the stabilisation diagram."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tau_dyn.modes import REASON_WITHOUT_SCALE, Mode, OperationalModes, ShapesOnRobot
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.modes_model_charts import draw_operational_stabilisation_chart
from tau_dyn.report.modes_page import SHAPES, describe_mode
from tau_dyn.report.modes_robot import draw_robot_modes
from tau_dyn.report.modes_shapes import draw_shape, find_space_axes
from tau_dyn.report.modes_text import (
    describe_badge,
    describe_headline,
    describe_inputs,
    describe_verdict,
    format_damping,
    format_frequency,
)


def build_operational_modes_page(
    found: OperationalModes,
    *,
    on_robot: ShapesOnRobot | None = None,
    logs: Sequence[tuple[str, str]] = (),
    command_line: str = "",
) -> str:
    """Return resonances from responses alone as one HTML page.

    Args:
        found: The result.
        on_robot: Its modes on a robot, to be drawn there; without, they are drawn on the axes of the outputs.
        logs: Name and hash of every log.
        command_line: The command that repeats it, for the provenance.
    """
    judged = describe_verdict(found)
    name = ", ".join(dict.fromkeys(name for name, _ in logs)) or "log"
    opening = PageHeader(
        describe_headline(found), judged.level, describe_badge(found), judged.sentence, describe_inputs(found)
    )
    swinging = draw_robot_modes(on_robot, [True for _ in found.modes])[:SHAPES]
    return render_page(
        "operational_modes.html.j2",
        f"{name}: resonances",
        opening,
        [],
        logs=[("log", name, sha256 or "not a file") for name, sha256 in logs],
        command_line=command_line,
        provenance={"method": "ssi-cov"},
        name=name,
        found=found,
        columns=1,
        modes=[_row(found, m) for m in found.modes],
        shapes=[
            (f"{format_frequency(m)} Hz", f"{format_damping(m)} %", draw_shape(m, found.outputs))
            for m in found.modes
            if len(found.outputs) > 1 and not swinging
        ][:SHAPES],
        swinging=swinging,
        robot_name=on_robot.robot.name if on_robot and swinging else "",
        in_space=bool(find_space_axes(found.outputs)),
        stabilisation=draw_operational_stabilisation_chart(found),
        reason=REASON_WITHOUT_SCALE,
    )


def _row(found: OperationalModes, mode: Mode) -> dict[str, Any]:
    return describe_mode(mode, found.outputs, sorted({q.order for q in found.stabilisation}), found.stabilisation)
