"""Resonances: which there are and how they move, the model over the data, how far to trust both, and how it was decided."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

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
from tau_dyn.render.pictures import find_space_axes
from tau_dyn.render.presentation import present_kind, warn
from tau_dyn.results import (
    Z95,
    Bar,
    Cell,
    Chapter,
    Column,
    Curve,
    Element,
    Figures,
    Group,
    IntervalBar,
    Key,
    On,
    Presentation,
    Provenance,
    ResultTable,
    Row,
    ShapePicture,
    SwingPicture,
    Text,
    TimeView,
    View,
    build_strip,
    capitalise,
    end_sentence,
    format_number,
)

SHAPES = 8
"""Modes whose shapes are drawn."""
BAR_SPAN = 0.5
"""Relative error of a damping ratio at the end of its bar."""
_MAX_TESTS = 9
"""Correlation tests that are drawn."""
_MAX_RESPONSES = 4
"""Responses that a notebook shows, and below which a page draws phases, too."""
_RESONANCE = Key("mode", "resonance")


@present_kind.register
def present_modes(
    found: Modes, *, on_robot: ShapesOnRobot | None = None, logs: Sequence[tuple[str, str]] = ()
) -> Presentation:
    """Return how resonances are presented.

    Args:
        found: The result.
        on_robot: Its modes on a robot, to be drawn there; without, they are drawn on the axes of the outputs.
        logs: Name and hash of every log.
    """
    names = list(dict.fromkeys(t.log for t in found.traces))
    sections = [
        *warn(list(map(_tidy, found.warnings))),
        *_list_modes(
            found, on_robot, [t.order for t in found.order_choice.trials if t.order >= found.order] or [found.order]
        ),
        Chapter(
            "response", "The response, with and without a model", lambda: _build_response(found), On.PAGE | On.NOTEBOOK
        ),
        Chapter("time", "Measured and simulated", lambda: _build_time(found), On.PAGE | On.TERMINAL),
        *([Chapter("impulse", "Response to a pulse", lambda: _build_impulse(found))] if found.impulse else []),
        *([Chapter("order", "How many states", lambda: _build_order(found))] if found.stabilisation else []),
        *(
            [Chapter("poles", "Poles and zeros", lambda: _build_poles(found))]
            if any(q.oscillates for q in found.poles)
            else []
        ),
        *(
            [Chapter("tests", "Residuals", lambda: _build_tests(found))]
            if found.whiteness or found.independence
            else []
        ),
        Chapter("mechanical", "Mass, damping, stiffness", lambda: _build_mechanical(found), On.PAGE | On.TERMINAL),
        Chapter("why", "What was decided, and why", lambda: _build_reasons(found), On.PAGE | On.TERMINAL),
    ]
    return Presentation(
        "Resonances of", ", ".join(names) or "log", f"{names[0] if names else 'log'}: resonances", describe_headline(found),
        describe_verdict(found), describe_inputs(found), sections, found.warnings,
        provenance=_trace_back(logs, found.why.get("refinement", found.method)), data=lambda: tabulate_modes(found), result=found,
    )  # fmt: skip


@present_kind.register
def present_operational_modes(
    found: OperationalModes, *, on_robot: ShapesOnRobot | None = None, logs: Sequence[tuple[str, str]] = ()
) -> Presentation:
    """Return how resonances from responses alone are presented; options as for `Modes`."""
    name = ", ".join(dict.fromkeys(name for name, _ in logs)) or "log"
    sections = [
        *warn(list(map(_tidy, found.warnings))),
        *_list_modes(found, on_robot, sorted({q.order for q in found.stabilisation})),
        Chapter("order", "Stabilisation", lambda: _build_stabilisation(found), On.PAGE | On.NOTEBOOK),
        Chapter("mechanical", "Mass, damping, stiffness", lambda: [Text(f"Not identifiable: {REASON_WITHOUT_SCALE}.")]),
    ]
    return Presentation(
        "Operational modal analysis of", name, f"{name}: resonances", describe_headline(found), describe_verdict(found),
        describe_inputs(found), sections, found.warnings, provenance=_trace_back(logs, "ssi-cov"),
        data=lambda: tabulate_modes(found), result=found,
    )  # fmt: skip


def _tidy(text: str) -> str:
    return end_sentence(capitalise(text))


def _trace_back(logs: Sequence[tuple[str, str]], method: str) -> Provenance:
    return Provenance([("method", method)], [("log", name, sha256 or "not a file") for name, sha256 in logs])


def _list_modes(
    found: Modes | OperationalModes, on_robot: ShapesOnRobot | None, orders: Sequence[int]
) -> list[Chapter]:
    if not found.modes:
        return []
    return [Chapter("modes", "Resonances", lambda: _build_modes(found, on_robot, orders), On.ALL)]


def _build_modes(
    found: Modes | OperationalModes, on_robot: ShapesOnRobot | None, orders: Sequence[int]
) -> Iterator[Element]:
    several = len(found.outputs) > 1
    columns = [
        Column("frequency [Hz]", "number", "big"),
        Column("95 % interval", "number", spare=True),
        Column("damping [%]", "number", "strong"),
        Column("95 % interval", "number", spare=True),
        Column("", "interval", on=On.PAGE, scale="50 %"),
        Column("rings for", "number", on=On.PAGE),
        *([Column("moves most", on=On.PAGE | On.TERMINAL)] if several else []),
        Column("seen in", "number", on=On.PAGE),
    ]
    yield ResultTable(columns, [_build_mode(found, m, orders, several) for m in found.modes], style="modes", on=On.ALL)
    yield Text(
        "Undamped natural frequency and damping as a share of critical damping, ± is one standard error (1 σ). "
        "Rings for: until a "
        "swing has fallen to 37 %. Seen in: models of this order and higher that show it too.",
        "note",
    )
    drawn = [m for m in found.modes if isinstance(found, OperationalModes) or figures.is_resonance(m)]
    if on_robot is not None:
        yield from draw_on_robot(on_robot, [any(m is d for d in drawn) for m in found.modes])
    elif several and drawn:
        yield Text("How it moves", "heading")
        captions = [(f"{format_frequency(m)} Hz", f"damping {format_damping(m)} %") for m in drawn[:SHAPES]]
        yield Figures(
            [ShapePicture(m.shape, tuple(found.outputs)) for m in drawn[:SHAPES]], "shapes", captions=captions
        )
        yield Text(
            "The measured point's path through one swing, sizes of the axes to each other true, slowed down."
            if find_space_axes(found.outputs)
            else "How far each output swings, in its own unit, at the moment of the largest; dashed, half a period later, and an "
            "orange line what comes a quarter of a period later.",
            "note",
        )


def _build_mode(found: Modes | OperationalModes, m: Mode, orders: Sequence[int], several: bool) -> Row:
    known = np.isfinite(m.damping_stderr) and m.damping_ratio > 0
    spread = Z95 * m.damping_stderr / m.damping_ratio / BAR_SPAN if known else 0.0
    decay = 2 * np.pi * m.frequency_hz * m.damping_ratio
    seen = sum(
        any(q.order == n and abs(q.frequency_hz / m.frequency_hz - 1) < 0.02 for q in found.stabilisation)
        for n in orders
    )
    cells: list[Cell] = [
        format_frequency(m),
        format_mode_interval(m.frequency_hz, m.frequency_stderr),
        format_damping(m),
        format_mode_interval(100 * m.damping_ratio, 100 * m.damping_stderr),
        IntervalBar(max(-spread, -1), min(spread, 1), 0.0) if known else None,
        f"{format_number(1 / decay, 2)} s" if decay > 0 else "–",
        *([found.outputs[int(np.argmax(np.abs(m.shape)))]] if several else []),
        f"{seen} of {len(orders)}",
    ]
    return Row(cells, "" if figures.is_resonance(m) else "weak")


def draw_on_robot(shapes: ShapesOnRobot, chosen: Sequence[bool]) -> Iterator[Element]:
    """Give the chosen modes on the robot, measured and of the robot file's own springs side by side."""
    pairs = [pair for pair, take in zip(shapes.pairs, chosen, strict=True) if take][:SHAPES]
    if not pairs:
        return
    yield Text("How the robot moves", "heading")
    compared = any(p.model is not None for p in pairs)
    couples: list[Element] = []
    for p in pairs:
        drawings, captions = (
            [SwingPicture(shapes.skeleton, p.measured, "measured")],
            [("measured", _caption(p.measured))],
        )
        if p.model is not None:
            drawings.append(SwingPicture(shapes.skeleton, p.model, "robot file"))
            captions.append(("springs of the robot file", f"{_caption(p.model)}, MAC {p.mac:.2f}"))
        couples.append(Figures(drawings, "couple", captions=captions))
        if compared and p.model is None:
            couples.append(Text("no mode of the robot file is near", "quiet"))
    yield Group(couples, "swings")
    mac = " MAC: likeness of the two shapes over the outputs, 1 for the same, 0 for unlike." if compared else ""
    yield Text(
        f"{shapes.robot.name} at home, in grey; slowed down, and each mode as large as its drawing takes. "
        "Measured: where sensors "
        "are, arrows to scale; the body that carries the tool is drawn without turning, because displacements "
        f"alone do not show it.{mac}",
        "note",
    )


def _caption(swing: Any) -> str:
    return f"{format_number(swing.frequency_hz, 4)} Hz, damping {format_number(100 * swing.damping_ratio, 2)} %"


def _lay_out(found: Modes) -> str:
    return f"bodes bodes-{figures.count_chart_columns(found)}"


def _build_response(found: Modes) -> Iterator[Element]:
    pairs, layout = figures.list_pairs(found), _lay_out(found)
    key = [Key("data", "data alone"), Key("predicted", "model"), Key("sure", "95 % band"), _RESONANCE]
    bode = [figures.build_bode_figure(found, i, j) for i, j in pairs]
    yield Figures(bode[:_MAX_RESPONSES], on=On.NOTEBOOK)
    if len(pairs) <= _MAX_RESPONSES:  # each row of magnitudes above its phases
        n, phases = figures.count_chart_columns(found), [figures.build_phase_figure(found, i, j) for i, j in pairs]
        bode = [f for k in range(0, len(pairs), n) for f in (*bode[k : k + n], *phases[k : k + n])]
    yield Figures(bode, layout, key)
    if np.isfinite(found.empirical.coherence).any():
        yield Text("Coherence: how much of each output the inputs explain", "heading")
        yield Figures([figures.build_coherence_figure(found, i) for i in range(len(found.outputs))], layout)
    hidden = len(found.inputs) * len(found.outputs) - len(pairs)
    left = f"{hidden} weaker pairs are left out. " if hidden else ""
    yield Text(
        f"Data alone: {found.empirical.how}. {left}Good: the dots scatter around the line, and coherence is near "
        "one except where "
        "an output hardly moves.",
        "note",
    )


def _build_time(found: Modes) -> Iterator[Element]:
    views = [_build_view(found, trace, k) for trace in found.traces for k in range(len(found.outputs))]
    key = [Key("measured", "measured"), Key("predicted", "simulated"), Key("residual", "missed")]
    if views:
        yield TimeView("measured and simulated outputs over time", views, key)
    judged, held = found.judged, found.holdout is not None
    columns = [
        Column("fit by output"),
        Column("", "bar", "wide"),
        Column("simulated, held out" if held else "simulated", "number", "strong"),
        *([Column("in training", "number")] if held else []),
        Column("1 sample ahead", "number", on=On.PAGE),
        Column("10 ahead", "number"),
        Column("rms missed", "number", on=On.PAGE),
    ]
    rows = []
    for k, name in enumerate(found.outputs):
        fit = float(judged.percent[k])
        cells: list[Cell] = [name, Bar(min(fit / 100, 1.0)), format_fit(fit)]
        cells += [format_fit(float(found.train.percent[k]))] if held else []
        ahead = [format_fit(float(judged.ahead[n][k])) for n in (1, 10)]
        rows.append(Row([*cells, *ahead, format_number(float(judged.rms[k]), 3)]))
    yield ResultTable(columns, rows, on=On.PAGE | On.TERMINAL)
    yield Text(
        "Fit: 100 % is all of the movement, 0 a straight line. A simulation sees the inputs only, and the state at the start; "
        "predictions also see outputs up to so many samples before. Drag across to zoom, double-click for the whole record.",
        "note",
    )


def _build_view(found: Modes, trace: Any, k: int) -> View:
    name, y, s = found.outputs[k], trace.measured[:, k], trace.simulated[:, k]
    both = build_strip(name, 250, Curve("measured", "measured", y), Curve("simulated", "predicted", s))
    rest = build_strip("missed", 130, Curve("missed", "residual", y - s), symmetric=True)
    return View(trace.log, name, trace.t, (both, rest), held_out=trace.held_out)


def _build_impulse(found: Modes) -> Iterator[Element]:
    drawn = [figures.build_impulse_figure(found, i, j) for i, j in figures.list_pairs(found)]
    held = ", held out" if found.impulse and found.impulse.held_out else ""
    key = [Key("measured", f"measured{held}"), Key("predicted", "model")]
    yield Figures([figure for figure in drawn if figure is not None], _lay_out(found), key)
    yield Text(_tidy(found.impulse.how) if found.impulse else "", "note")


def _key_of_modes(last: str) -> list[Key]:
    return [Key("stable", "stable"), Key("ring", "frequency only"), Key("new", "new"), Key("mode", last)]


def _build_order(found: Modes) -> Iterator[Element]:
    yield Figures([figures.build_stabilisation_figure(found)], "wide-chart", _key_of_modes("resonance of the model"))
    choices = figures.build_choice_figures(found)
    if choices:
        yield Figures(choices, "charts")
    yield Text(
        "Above: the modes of models of every order, with 95 % bars; a resonance of the structure stays where it "
        "is, what noise makes "
        "wanders. Behind it the data's own response. Below: fit on a quarter of the training data that these "
        "models had not seen; "
        f"criteria (BIC blue, AIC orange); the delay. {_tidy(found.order_choice.why)}",
        "note",
    )


def _build_stabilisation(found: OperationalModes) -> Iterator[Element]:
    figure, key = figures.build_stabilisation_figure(found), _key_of_modes("mode of the structure")
    yield Figures([figure], "wide-chart", key, on=On.PAGE | On.NOTEBOOK)
    yield Text(
        "Modes of models of every order, with 95 % bars. A mode of the structure stays where it is; what noise "
        "makes wanders.",
        "note",
    )


def _build_poles(found: Modes) -> Iterator[Element]:
    figure = figures.build_pole_figure(found)
    yield Figures([] if figure is None else [figure], "wide-chart")
    together = " of all transfer functions together" if len(found.inputs) > 1 else ""
    unlike = " (none for unlike numbers of inputs and outputs)" if len(found.inputs) != len(found.outputs) else ""
    yield Text(
        f"Crosses: poles, with their 95 % ellipses. Rings: zeros{together}{unlike}. Farther left: faster decay; "
        "poles with a very "
        "fast decay are left out.",
        "note",
    )


def _build_tests(found: Modes) -> Iterator[Element]:
    yield Text(describe_tests(found))
    for title, tests in (
        ("Correlation with the inputs", _select_worst(found.independence)),
        ("Residual whiteness (Ljung-Box)", found.whiteness),
    ):
        if tests:
            yield Text(title, "heading")
            yield Figures([figures.build_test_figure(found, t) for t in tests], _lay_out(found))
    yield Text(
        "99 % bands. Orange dots: the test is significant. Negative lags show feedback and are not tested.", "note"
    )


def _select_worst(tests: Sequence[CorrelationTest]) -> list[CorrelationTest]:
    """Return the tests to draw: all where they fit, else the worst, in their own order."""
    worst = sorted(tests, key=lambda t: t.p_value)[:_MAX_TESTS]
    return [t for t in tests if any(t is w for w in worst)]


def _build_mechanical(found: Modes) -> Iterator[Element]:
    yield Text(describe_mechanical(found), on=On.PAGE | On.TERMINAL)
    m = found.mechanical
    if m is None or m.M is None or m.D is None or m.K is None:
        return
    spread = [None] * 3 if m.stderr is None else [m.stderr.M, m.stderr.D, m.stderr.K]
    matrices: list[Element] = []
    for letter, meaning, values, stderr in zip(
        "MDK", ("mass", "damping", "stiffness"), (m.M, m.D, m.K), spread, strict=True
    ):
        rows = [Row([format_entry(values, stderr, i, j) for j in range(len(values))]) for i in range(len(values))]
        columns = [Column(kind="number") for _ in values]
        matrices.append(ResultTable(columns, rows, style="matrix", caption=f"{letter}, {meaning}"))
    yield Group(matrices, "matrices")
    yield Text(
        "In the units of the inputs per those of the outputs (times s² and s), ± is one standard error (1 σ); "
        "order as the inputs: "
        f"{', '.join(found.inputs)}. All three are symmetric, mass and stiffness positive definite, damping takes energy only.",
        "note",
    )


def _build_reasons(found: Modes) -> Iterator[Element]:
    yield ResultTable(
        [Column(), Column()], [Row([topic, _tidy(text)]) for topic, text in found.why.items()], style="plain"
    )
    yield Text(" ".join(_tidy(text) for text in found.why.values()), "dim", on=On.TERMINAL)
