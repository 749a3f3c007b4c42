"""The page of `tau-dyn modes`: the resonances, the model over the data, how far to trust both, and how it was decided."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.modes import Mode, Modes, ShapesOnRobot, StabilityPoint, Trace
from tau_dyn.report import modes_charts as charts, modes_model_charts as model_charts
from tau_dyn.report.formatting import Z95, format_number, format_percent, round_to_stderr
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.identification_charts import draw_interval_bar
from tau_dyn.report.modes_robot import draw_robot_modes
from tau_dyn.report.modes_shapes import draw_shape, find_space_axes
from tau_dyn.report.modes_text import (
    describe_badge,
    describe_headline,
    describe_inputs,
    describe_mechanical,
    describe_verdict,
    fit_words,
    format_damping,
    format_frequency,
    format_interval,
    is_resonance,
)
from tau_dyn.report.time_view import Curve, View, strip

SHAPES = 8
"""Modes whose shapes are drawn."""
BAR_SPAN = 0.5
"""Relative error of a damping ratio at the end of its bar."""


def build_modes_page(
    found: Modes, *, on_robot: ShapesOnRobot | None = None, logs: Sequence[tuple[str, str]] = (), command_line: str = ""
) -> str:
    """Return resonances as one HTML page.

    Args:
        found: The result.
        on_robot: Its modes on a robot, to be drawn there; without, they are drawn on the axes of the outputs.
        logs: Name and hash of every log.
        command_line: The command that repeats it, for the provenance.
    """
    judged = describe_verdict(found)
    opening = PageHeader(
        describe_headline(found), judged.level, describe_badge(found), judged.sentence, describe_inputs(found)
    )
    drawn = charts.list_pairs(found)
    swinging = draw_robot_modes(on_robot, [is_resonance(m) for m in found.modes])[:SHAPES]
    names = [t.log for t in found.traces]
    return render_page(
        "modes.html.j2",
        f"{names[0] if names else 'log'}: resonances",
        opening,
        _views(found),
        logs=[("log", name, sha256 or "not a file") for name, sha256 in logs],
        command_line=command_line,
        provenance={"method": found.why.get("refinement", found.method)},
        name=", ".join(dict.fromkeys(names)) or "log",
        found=found,
        modes=[describe_mode(m, found.outputs, _orders_above(found), found.stabilisation) for m in found.modes],
        shapes=[
            (f"{format_frequency(m)} Hz", f"{format_damping(m)} %", draw_shape(m, found.outputs))
            for m in found.modes
            if is_resonance(m) and len(found.outputs) > 1 and not swinging
        ][:SHAPES],
        swinging=swinging,
        robot_name=on_robot.robot.name if on_robot and swinging else "",
        in_space=bool(find_space_axes(found.outputs)),
        bode=[(charts.draw_bode_chart(found, i, j), charts.draw_phase_chart(found, i, j)) for i, j in drawn],
        columns=charts.count_chart_columns(found),
        hidden_pairs=len(found.inputs) * len(found.outputs) - len(drawn),
        coherence=[charts.draw_coherence_chart(found, i) for i in range(len(found.outputs))]
        if _coherent(found)
        else [],
        stabilisation=model_charts.draw_stabilisation_chart(found) if found.stabilisation else Markup(""),
        choices=_choices(found),
        poles=model_charts.draw_pole_chart(found),
        whiteness=[charts.draw_test_chart(found, t) for t in found.whiteness],
        independence=[charts.draw_test_chart(found, t) for t in _worst(found)],
        impulse=[charts.draw_impulse_chart(found, i, j) for i, j in drawn] if found.impulse else [],
        fits=_fits(found),
        mechanical=_mechanical(found),
        mechanical_words=describe_mechanical(found),
        test_words=describe_tests(found),
        why=[(topic, text[:1].upper() + text[1:]) for topic, text in found.why.items()],
    )


def _choices(found: Modes) -> list[Markup]:
    orders = (
        [model_charts.order_chart(found), model_charts.draw_criterion_chart(found)]
        if len(found.order_choice.trials) > 1
        else []
    )
    return [*orders, *([model_charts.draw_delay_chart(found)] if len(found.delay_choice.scan) > 1 else [])]


def _orders_above(found: Modes) -> list[int]:
    return [t.order for t in found.order_choice.trials if t.order >= found.order] or [found.order]


def _coherent(found: Modes) -> bool:
    return bool(np.isfinite(found.empirical.coherence).any())


def _worst(found: Modes, most: int = 9) -> list[Any]:
    """Return the tests to draw: all where they fit, else the worst, in their own order."""
    if len(found.independence) <= most:
        return list(found.independence)
    worst = sorted(found.independence, key=lambda t: t.p_value)[:most]
    return [t for t in found.independence if any(t is w for w in worst)]


def describe_mode(
    m: Mode, outputs: Sequence[str], orders: Sequence[int], stabilisation: Sequence[StabilityPoint]
) -> dict[str, Any]:
    """Return a row of the table of modes; `orders` are those in which it is looked for."""
    known = np.isfinite(m.damping_stderr) and m.damping_ratio > 0
    spread = Z95 * m.damping_stderr / m.damping_ratio / BAR_SPAN if known else 0.0
    decay = 2 * np.pi * m.frequency_hz * m.damping_ratio
    seen = sum(
        any(q.order == n and abs(q.frequency_hz / m.frequency_hz - 1) < 0.02 for q in stabilisation) for n in orders
    )
    return {
        "frequency": f"{format_frequency(m)} Hz",
        "frequency_interval": format_interval(m.frequency_hz, m.frequency_stderr),
        "damping": f"{format_damping(m)} %",
        "damping_interval": format_interval(100 * m.damping_ratio, 100 * m.damping_stderr),
        "bar": draw_interval_bar(max(-spread, -1), min(spread, 1), 0.0, 0.0, "", False) if known else Markup(""),
        "rings": f"{format_number(1 / decay, 2)} s" if decay > 0 else "–",
        "most": outputs[int(np.argmax(np.abs(m.shape)))],
        "seen": f"{seen} of {len(orders)}",
        "weak": not is_resonance(m),
    }


def _fits(found: Modes) -> list[dict[str, Any]]:
    judged = found.judged
    return [
        {
            "name": name,
            "held": fit_words(float(judged.percent[k])),
            "width": float(np.clip(judged.percent[k], 0, 100)),
            "train": fit_words(float(found.train.percent[k])),
            "ahead": {n: fit_words(float(v[k])) for n, v in judged.ahead.items()},
            "rms": format_number(float(judged.rms[k]), 3),
        }
        for k, name in enumerate(found.outputs)
    ]


def _mechanical(found: Modes) -> list[tuple[str, str, list[list[str]]]]:
    """Return name, meaning and entries with standard errors of M, D and K."""
    m = found.mechanical
    if m is None or m.M is None or m.D is None or m.K is None:
        return []
    stderr = [None] * 3 if m.stderr is None else [m.stderr.M, m.stderr.D, m.stderr.K]
    named = zip("MDK", ("mass", "damping", "stiffness"), (m.M, m.D, m.K), stderr, strict=True)
    return [(name, meaning, _entries(values, spread)) for name, meaning, values, spread in named]


def _entries(values: np.ndarray, spread: np.ndarray | None) -> list[list[str]]:
    def entry(i: int, j: int) -> str:
        value = float(values[i, j])
        if spread is None or not np.isfinite(spread[i, j]) or spread[i, j] <= 0:
            return format_number(value, 4)
        return f"{round_to_stderr(value, float(spread[i, j]))} ± {round_to_stderr(float(spread[i, j]), float(spread[i, j]))}"

    return [[entry(i, j) for j in range(values.shape[1])] for i in range(values.shape[0])]


def _views(found: Modes) -> list[View]:
    return [_view(found, trace, k) for trace in found.traces for k in range(len(found.outputs))]


def _view(found: Modes, trace: Trace, k: int) -> View:
    name = found.outputs[k]
    y, s = trace.measured[:, k], trace.simulated[:, k]
    both = strip(name, 250, Curve("measured", "measured", y), Curve("simulated", "predicted", s))
    rest = strip("missed", 130, Curve("missed", "residual", y - s), symmetric=True)
    return View(trace.log, name, trace.t, (both, rest), held_out=trace.held_out)


def describe_tests(found: Modes) -> str:
    """Return what the tests say, in a sentence or two."""
    on = "held-out" if found.tested_on == "holdout" else "training"
    failed = [t for t in found.independence if not t.passed]
    n = len(found.independence)
    said = (
        f"On {on} data, the residual of the simulation is not correlated with the inputs: no linear dynamics are missing."
        if not failed
        else f"On {on} data, in {len(failed)} of {n} pairs the residual is correlated with the input: "
        "linear dynamics are missing, or the structure is nonlinear."
    )
    coloured = [t.output for t in found.whiteness if not t.passed]
    share = format_percent(100 * max((t.outside for t in found.whiteness), default=0.0))
    if coloured:
        return (
            f"{said} One-step errors of {', '.join(coloured)} keep some memory ({share} of the lags outside the band)."
        )
    return f"{said} One-step errors are white."
