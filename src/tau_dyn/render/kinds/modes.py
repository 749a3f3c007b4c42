"""Resonances: list and mode shapes, the model with the data, validation of both, and choice of the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.modes import REASON_WITHOUT_SCALE, CorrelationTest, Mode, Modes, OperationalModes, ShapesOnRobot
from tau_dyn.render.kinds import modes_figures as figures
from tau_dyn.render.kinds.modes_words import (
    describe_headline,
    describe_inputs,
    describe_mechanical,
    describe_tests,
    describe_verdict,
    format_damping,
    format_entry,
    format_fit,
    format_frequency,
    format_mode_interval,
    tabulate_modes,
)
from tau_dyn.render.presentation import present_kind, warn

SHAPES = 8
"""Largest number of drawn mode shapes."""
BAR_SPAN = 0.5
"""Relative error of a damping ratio at the end of its bar."""
_MAX_TESTS = 9
"""Largest number of drawn correlation tests."""
_MAX_RESPONSES = 4
"""Largest number of responses in a notebook, and for which a page also draws phases."""
_RESONANCE = r.Key("mode", "resonance")


@present_kind.register
def present_modes(
    found: Modes, *, on_robot: ShapesOnRobot | None = None, logs: Sequence[tuple[str, str]] = ()
) -> r.Presentation:
    """Return the presentation of resonances.

    Args:
        found: The result.
        on_robot: Its modes on a robot, to be drawn there; otherwise they are drawn on the axes of the outputs.
        logs: Name and hash of every log.
    """
    names = list(dict.fromkeys(t.log for t in found.traces))
    sections = [
        *warn(list(map(_tidy, found.warnings))),
        *_list_modes(
            found, on_robot, [t.order for t in found.order_choice.trials if t.order >= found.order] or [found.order]
        ),
        r.Chapter("response", "The response, with and without a model", lambda: _build_response(found), r.On.DRAWN),
        r.Chapter("time", "Measured and simulated", lambda: _build_time(found), r.On.PRINTED),
        r.Chapter("impulse", "Response to a pulse", lambda: _build_impulse(found), when=bool(found.impulse)),
        r.Chapter("order", "How many states", lambda: _build_order(found), when=bool(found.stabilisation)),
        r.Chapter("poles", "Poles and zeros", lambda: _build_poles(found), when=any(q.oscillates for q in found.poles)),
        r.Chapter("tests", "Residuals", lambda: _build_tests(found), when=bool(found.whiteness or found.independence)),
        r.Chapter("mechanical", "Mass, damping, stiffness", lambda: _build_mechanical(found), r.On.PRINTED),
        r.Chapter("why", "Decisions and reasons", lambda: _build_reasons(found), r.On.PRINTED),
    ]
    return r.Presentation(
        "Resonances of", ", ".join(names) or "log", f"{names[0] if names else 'log'}: resonances", describe_headline(found),
        describe_verdict(found), describe_inputs(found), sections, found.warnings,
        provenance=_trace_back(logs, found.why.get("refinement", found.method)), data=lambda: tabulate_modes(found), result=found,
    )  # fmt: skip


@present_kind.register
def present_operational_modes(
    found: OperationalModes, *, on_robot: ShapesOnRobot | None = None, logs: Sequence[tuple[str, str]] = ()
) -> r.Presentation:
    """Return the presentation of resonances from operational modal analysis; options as for `Modes`."""
    name = ", ".join(dict.fromkeys(name for name, _ in logs)) or "log"
    sections = [
        *warn(list(map(_tidy, found.warnings))),
        *_list_modes(found, on_robot, sorted({q.order for q in found.stabilisation})),
        r.Chapter("order", "Stabilisation", lambda: _build_stabilisation(found), r.On.DRAWN),
        r.Chapter(
            "mechanical", "Mass, damping, stiffness", lambda: [r.Text(f"Not identifiable: {REASON_WITHOUT_SCALE}.")]
        ),
    ]
    return r.Presentation(
        "Operational modal analysis of", name, f"{name}: resonances", describe_headline(found), describe_verdict(found),
        describe_inputs(found), sections, found.warnings, provenance=_trace_back(logs, "ssi-cov"),
        data=lambda: tabulate_modes(found), result=found,
    )  # fmt: skip


def _tidy(text: str) -> str:
    return r.end_sentence(r.capitalise(text))


def _trace_back(logs: Sequence[tuple[str, str]], method: str) -> r.Provenance:
    return r.Provenance([("method", method)], [("log", name, sha256 or "not a file") for name, sha256 in logs])


def _list_modes(
    found: Modes | OperationalModes, on_robot: ShapesOnRobot | None, orders: Sequence[int]
) -> list[r.Chapter]:
    if not found.modes:
        return []
    return [r.Chapter("modes", "Resonances", lambda: _build_modes(found, on_robot, orders), r.On.ALL)]


def _build_modes(
    found: Modes | OperationalModes, on_robot: ShapesOnRobot | None, orders: Sequence[int]
) -> Iterator[r.Element]:
    several = len(found.outputs) > 1
    listed = [m for m in found.modes if isinstance(found, OperationalModes) or figures.is_resonance(m)] or found.modes
    most = r.Column("moves most", on=r.On.PRINTED, cell=lambda m: found.outputs[int(np.argmax(np.abs(m.shape)))])
    yield r.tabulate_things(
        listed,
        r.Column("frequency [Hz]", "number", "big", cell=format_frequency),
        r.Column(
            "95 % interval",
            "number",
            spare=True,
            cell=lambda m: format_mode_interval(m.frequency_hz, m.frequency_stderr),
        ),
        r.Column("damping [%]", "number", "strong", cell=format_damping),
        r.Column(
            "95 % interval",
            "number",
            spare=True,
            cell=lambda m: format_mode_interval(100 * m.damping_ratio, 100 * m.damping_stderr),
        ),
        r.Column("", "interval", on=r.On.PAGE, scale="50 %", cell=_build_damping_bar),
        r.Column("rings for", "number", on=r.On.PAGE, cell=_format_decay),
        *([most] if several else []),
        r.Column("seen in", "number", on=r.On.PAGE, cell=lambda m: _count_orders(found, m, orders)),
        state=lambda m: "" if figures.is_resonance(m) else "weak",
        style="modes",
        on=r.On.ALL,
    )
    if len(listed) < len(found.modes):
        more = r.count(len(found.modes) - len(listed), "further pole")
        yield r.Text(
            f"{more} of the model ha{'s' if more.startswith('1 ') else 've'} no known frequency; see --json.", "quiet"
        )
    yield r.explain(
        "Undamped natural frequency and damping as a share of critical damping, ± is one standard error (1 σ). Rings "
        "for: until a swing has fallen to 37 %. Seen in: models of this order and higher that show it too."
    )
    drawn = [m for m in found.modes if isinstance(found, OperationalModes) or figures.is_resonance(m)]
    if on_robot is not None:
        yield from draw_on_robot(on_robot, [any(m is d for d in drawn) for m in found.modes])
    elif several and drawn:
        yield r.Text("How it moves", "heading")
        captions = [(f"{format_frequency(m)} Hz", f"damping {format_damping(m)} %") for m in drawn[:SHAPES]]
        yield r.Figures(
            [r.ShapePicture(m.shape, tuple(found.outputs)) for m in drawn[:SHAPES]], "shapes", captions=captions
        )
        yield r.explain(
            "The measured point's path through one swing, sizes of the axes to each other true, slowed down."
            if r.find_space_axes(found.outputs)
            else "How far each output swings, in its own unit, at the moment of the largest; dashed, half a period later, and an "
            "orange line a quarter of a period later."
        )


def _build_damping_bar(m: Mode) -> r.IntervalBar | None:
    if not np.isfinite(m.damping_stderr) or m.damping_ratio <= 0:
        return None
    spread = r.Z95 * m.damping_stderr / m.damping_ratio / BAR_SPAN
    return r.IntervalBar(max(-spread, -1), min(spread, 1), 0.0)


def _format_decay(m: Mode) -> str:
    decay = 2 * np.pi * m.frequency_hz * m.damping_ratio
    return f"{r.format_number(1 / decay, 2)} s" if decay > 0 else "–"


def _count_orders(found: Modes | OperationalModes, m: Mode, orders: Sequence[int]) -> str:
    alike = {q.order for q in found.stabilisation if abs(q.frequency_hz / m.frequency_hz - 1) < 0.02}
    return f"{len(alike.intersection(orders))} of {len(orders)}"


def draw_on_robot(shapes: ShapesOnRobot, chosen: Sequence[bool]) -> Iterator[r.Element]:
    """Yield the chosen modes on the robot, measured ones next to those of the springs in the robot file."""
    pairs = [pair for pair, take in zip(shapes.pairs, chosen, strict=True) if take][:SHAPES]
    if not pairs:
        return
    yield r.Text("How the robot moves", "heading")
    compared = any(p.model is not None for p in pairs)
    couples: list[r.Element] = []
    for p in pairs:
        drawings, captions = (
            [r.SwingPicture(shapes.skeleton, p.measured, "measured")],
            [("measured", _caption(p.measured))],
        )
        if p.model is not None:
            drawings.append(r.SwingPicture(shapes.skeleton, p.model, "robot file"))
            captions.append(("springs of the robot file", f"{_caption(p.model)}, MAC {p.mac:.2f}"))
        couples.append(r.Figures(drawings, "couple", captions=captions))
        if compared and p.model is None:
            couples.append(r.Text("no mode of the robot file is near", "quiet"))
    yield r.Group(couples, "swings")
    mac = " MAC: likeness of the two shapes over the outputs, 1 for the same, 0 for unlike." if compared else ""
    yield r.explain(
        f"{shapes.robot.name} at home, in grey; slowed down, and each mode as large as its drawing takes. Measured: "
        "where sensors are, arrows to scale; the body that carries the tool is drawn without turning, because "
        f"displacements alone do not show it.{mac}"
    )


def _caption(swing: Any) -> str:
    return f"{r.format_number(swing.frequency_hz, 4)} Hz, damping {r.format_number(100 * swing.damping_ratio, 2)} %"


def _lay_out(found: Modes) -> str:
    return f"bodes bodes-{figures.count_chart_columns(found)}"


def _build_response(found: Modes) -> Iterator[r.Element]:
    pairs, layout = figures.list_pairs(found), _lay_out(found)
    key = [r.Key("data", "data alone"), r.Key("predicted", "model"), r.Key("sure", "95 % band"), _RESONANCE]
    bode = [figures.build_bode_figure(found, i, j) for i, j in pairs]
    yield r.Figures(bode[:_MAX_RESPONSES], on=r.On.NOTEBOOK)
    if len(pairs) <= _MAX_RESPONSES:  # each row of magnitudes is above its phases
        n, phases = figures.count_chart_columns(found), [figures.build_phase_figure(found, i, j) for i, j in pairs]
        bode = [f for k in range(0, len(pairs), n) for f in (*bode[k : k + n], *phases[k : k + n])]
    yield r.Figures(bode, layout, key)
    if np.isfinite(found.empirical.coherence).any():
        yield r.Text("Coherence: how much of each output the inputs explain", "heading")
        yield r.Figures([figures.build_coherence_figure(found, i) for i in range(len(found.outputs))], layout)
    hidden = len(found.inputs) * len(found.outputs) - len(pairs)
    left = f"{hidden} weaker pairs are left out. " if hidden else ""
    yield r.explain(
        f"Data alone: {found.empirical.how}. {left}Good: the dots scatter around the line, and coherence is near one "
        "except where an output hardly moves."
    )


def _build_time(found: Modes) -> Iterator[r.Element]:
    views = [_build_view(found, trace, k) for trace in found.traces for k in range(len(found.outputs))]
    key = r.build_key(measured="measured", predicted="simulated", residual="missed")
    if views:
        yield r.TimeView("measured and simulated outputs over time", views, key)
    judged, held = found.judged, found.holdout is not None
    columns = [
        r.Column("fit by output"),
        r.Column("", "bar", "wide"),
        r.Column("simulated, held out" if held else "simulated", "number", "strong"),
        *([r.Column("in training", "number")] if held else []),
        r.Column("1 sample ahead", "number", on=r.On.PAGE),
        r.Column("10 ahead", "number"),
        r.Column("rms missed", "number", on=r.On.PAGE),
    ]
    rows = []
    for k, name in enumerate(found.outputs):
        fit = float(judged.percent[k])
        cells: list[r.Cell] = [name, r.Bar(min(fit / 100, 1.0)), format_fit(fit)]
        cells += [format_fit(float(found.train.percent[k]))] if held else []
        ahead = [format_fit(float(judged.ahead[n][k])) for n in (1, 10)]
        rows.append(r.Row([*cells, *ahead, r.format_number(float(judged.rms[k]), 3)]))
    yield r.ResultTable(columns, rows, on=r.On.PRINTED)
    yield r.explain(
        "Fit: 100 % is all of the movement, 0 a straight line. A simulation sees the inputs only, and the state at the start; "
        "predictions also see outputs up to so many samples before. Drag across to zoom, double-click for the whole record."
    )


def _build_view(found: Modes, trace: Any, k: int) -> r.View:
    name, y, s = found.outputs[k], trace.measured[:, k], trace.simulated[:, k]
    both = r.build_strip(name, 250, r.Curve("measured", "measured", y), r.Curve("simulated", "predicted", s))
    rest = r.build_strip("missed", 130, r.Curve("missed", "residual", y - s), symmetric=True)
    return r.View(trace.log, name, trace.t, (both, rest), held_out=trace.held_out)


def _build_impulse(found: Modes) -> Iterator[r.Element]:
    drawn = [figures.build_impulse_figure(found, i, j) for i, j in figures.list_pairs(found)]
    held = ", held out" if found.impulse and found.impulse.held_out else ""
    key = r.build_key(measured=f"measured{held}", predicted="model")
    yield r.Figures([figure for figure in drawn if figure is not None], _lay_out(found), key)
    yield r.explain(_tidy(found.impulse.how) if found.impulse else "")


def _key_of_modes(last: str) -> list[r.Key]:
    return r.build_key(stable="stable", ring="frequency only", new="new", mode=last)


def _build_order(found: Modes) -> Iterator[r.Element]:
    yield r.Figures([figures.build_stabilisation_figure(found)], "wide-chart", _key_of_modes("resonance of the model"))
    choices = figures.build_choice_figures(found)
    if choices:
        yield r.Figures(choices, "charts")
    yield r.explain(
        "Above: the modes of models of every order, with 95 % bars; a resonance of the structure stays where it is, "
        "what noise makes wanders. Behind it the data's own response. Below: fit on a quarter of the training data "
        f"that these models had not seen; criteria (BIC blue, AIC orange); the delay. {_tidy(found.order_choice.why)}"
    )


def _build_stabilisation(found: OperationalModes) -> Iterator[r.Element]:
    figure, key = figures.build_stabilisation_figure(found), _key_of_modes("mode of the structure")
    yield r.Figures([figure], "wide-chart", key, on=r.On.DRAWN)
    yield r.explain(
        "Modes of models of every order, with 95 % bars. A mode of the structure stays where it is; what noise makes "
        "wanders."
    )


def _build_poles(found: Modes) -> Iterator[r.Element]:
    figure = figures.build_pole_figure(found)
    yield r.Figures([] if figure is None else [figure], "wide-chart")
    together = " of all transfer functions together" if len(found.inputs) > 1 else ""
    unlike = " (not for unlike numbers of inputs and outputs)" if len(found.inputs) != len(found.outputs) else ""
    yield r.explain(
        f"Crosses: poles, with their 95 % ellipses. Rings: zeros{together}{unlike}. Farther left: faster decay; poles "
        "with a very fast decay are left out."
    )


def _build_tests(found: Modes) -> Iterator[r.Element]:
    yield r.Text(describe_tests(found))
    for title, tests in (
        ("Correlation with the inputs", _select_worst(found.independence)),
        ("Residual whiteness (Ljung-Box)", found.whiteness),
    ):
        if tests:
            yield r.Text(title, "heading")
            yield r.Figures([figures.build_test_figure(found, t) for t in tests], _lay_out(found))
    yield r.explain("99 % bands. Orange dots: the test is significant. Negative lags show feedback and are not tested.")


def _select_worst(tests: Sequence[CorrelationTest]) -> list[CorrelationTest]:
    """Return the tests to draw in their order: all of them if they fit, else the worst."""
    worst = sorted(tests, key=lambda t: t.p_value)[:_MAX_TESTS]
    return [t for t in tests if any(t is w for w in worst)]


def _build_mechanical(found: Modes) -> Iterator[r.Element]:
    yield r.Text(describe_mechanical(found), on=r.On.PRINTED)
    m = found.mechanical
    if m is None or m.M is None or m.D is None or m.K is None:
        return
    spread = [None] * 3 if m.stderr is None else [m.stderr.M, m.stderr.D, m.stderr.K]
    matrices: list[r.Element] = []
    for letter, meaning, values, stderr in zip(
        "MDK", ("mass", "damping", "stiffness"), (m.M, m.D, m.K), spread, strict=True
    ):
        rows = [r.Row([format_entry(values, stderr, i, j) for j in range(len(values))]) for i in range(len(values))]
        columns = [r.Column(kind="number") for _ in values]
        matrices.append(r.ResultTable(columns, rows, style="matrix", caption=f"{letter}, {meaning}"))
    yield r.Group(matrices, "matrices")
    yield r.explain(
        f"In the units of the inputs per {'those of the outputs' if m.unit == 1 else 'm'} (times s² and s), ± is one standard "
        "error (1 σ); order as "
        f"the inputs: {', '.join(found.inputs)}. All three are symmetric, mass and stiffness positive definite, "
        "damping takes energy only."
    )


def _build_reasons(found: Modes) -> Iterator[r.Element]:
    yield r.tabulate_plainly((topic, _tidy(text)) for topic, text in found.why.items())
    yield r.Text(" ".join(_tidy(text) for text in found.why.values()), "dim", on=r.On.TERMINAL)
