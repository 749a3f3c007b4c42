"""Controlled actuators, a step of learning, an observed tool, the limits of lead-through."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tau_dyn.control.iterative import ActuatorModels, LearningStep
from tau_dyn.control.lead_through import LeadThroughAdvice
from tau_dyn.control.observers import ToolObservation
from tau_dyn.render.presentation import ZOOM, present_kind
from tau_dyn.results import (
    WHOLE,
    Axis,
    Chapter,
    Column,
    Curve,
    Element,
    Figure,
    Figures,
    Key,
    Line,
    On,
    Presentation,
    ResultTable,
    Row,
    Text,
    TimeView,
    Verdict,
    View,
    build_strip,
    format_fixed_digits,
    format_number,
    format_percent,
    format_unit,
    format_with_uncertainty,
    pad_limits,
)


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> ResultTable:
    columns = [Column(titles[0]), *(Column(title, "number") for title in titles[1:])]
    return ResultTable(columns, [Row(row) for row in rows], on=On.ALL)


@present_kind.register
def present_actuators(found: ActuatorModels) -> Presentation:
    """Return how fitted actuators are presented."""
    worst = min(fit.fit_percent for fit in found.fits)
    verdict = Verdict("care" if found.warnings else "good", f"The worst axis is explained to {worst:.3g} %.")
    slowest = min(fit.actuator.bandwidth_hz for fit in found.fits)
    return Presentation(
        "Controlled actuators", ", ".join(found.outputs), "Controlled actuators",
        f"The slowest axis follows its reference up to {slowest:.3g} Hz (-3 dB).", verdict,
        f"{len(found.records)} tests, a sample every {1e3 * found.dt:g} ms",
        [
            Chapter("axes", "Axis by axis", lambda: _build_axes(found), On.ALL),
            Chapter("tests", "Measured and fitted", lambda: _build_tests(found)),
        ],
        found.warnings, data=found.to_rows, result=found,
    )  # fmt: skip


def _build_axes(found: ActuatorModels) -> Iterator[Element]:
    rows = []
    for name, fit in zip(found.outputs, found.fits, strict=True):
        a, e = fit.actuator, fit.stderr
        rows.append([
            name, format_with_uncertainty(a.gain, e.gain),
            f"{format_with_uncertainty(1e3 * a.time_constant, 1e3 * e.time_constant)} ms",
            f"{format_with_uncertainty(1e3 * a.delay, 1e3 * e.delay)} ms",
            f"{format_with_uncertainty(a.bandwidth_hz, fit.bandwidth_stderr_hz)} Hz", format_percent(fit.fit_percent),
        ])  # fmt: skip
    yield _table(("axis", "gain", "time constant", "delay", "bandwidth", "fit"), rows)
    yield Text("± is one standard error; coloured noise is allowed for.", "note")


def _build_tests(found: ActuatorModels) -> Iterator[Element]:
    views = []
    for k, name in enumerate(found.outputs):
        for record, rest in zip(found.records, found.fits[k].residuals, strict=False):
            t, y = np.arange(len(record.y)) * record.dt, record.y[:, k]
            if len(rest) == len(y):
                curves = (Curve("measured", "measured", y), Curve("fitted", "predicted", y - rest))
                strips = (
                    build_strip("position", 180, *curves),
                    build_strip("residual", 90, Curve("", "residual", rest)),
                )
                views.append(View(record.name, name, t, strips))
    key = [Key("measured", "measured"), Key("predicted", "fitted"), Key("residual", "measured - fitted")]
    if views:
        yield TimeView("measured and fitted positions over time", views, key)
        yield Text(ZOOM, "note")


@present_kind.register
def present_learning(found: LearningStep) -> Presentation:
    """Return how a step of learning is presented."""
    checked = found.convergence
    sentence = (
        f"Every iteration comes closer: largest singular value {max(checked.singular):.3g}."
        if checked.monotone
        else f"Learning converges (spectral radius {checked.radius:.3g}), but not in every iteration."
    )
    now, then = (float(np.sqrt(np.mean(found.rms(x) ** 2))) for x in (found.error, found.expected))
    return Presentation(
        "Learning", ", ".join(found.joints), "Iterative learning: the next correction",
        f"The next trial's error is expected at {format_percent(100 * then / max(now, 1e-300))} of this one's.",
        Verdict("good" if checked.monotone and not found.warnings else "care", sentence),
        f"learns up to {found.cutoff_hz:g} Hz, gain {found.gain:g}, shift {found.shift} samples",
        [
            Chapter("joints", "Joint by joint", lambda: _build_learning(found), On.ALL),
            Chapter("trial", "Trial and correction", lambda: _build_trial(found)),
        ],
        found.warnings, data=found.to_rows, result=found,
    )  # fmt: skip


def _build_learning(found: LearningStep) -> Iterator[Element]:
    names = ("error_rms", "expected_error_rms", "largest_correction")
    rows = [[r["joint"], *(format_fixed_digits(r[n]) for n in names)] for r in found.to_rows()]
    yield _table(("joint", "RMS error", "expected next", "largest correction"), rows)
    yield Text("In m or rad, where learning acts fully.", "note")


def _build_trial(found: LearningStep) -> Iterator[Element]:
    t, views = np.arange(len(found.error)) * found.dt, []
    for k, joint in enumerate(found.joints):
        error = (
            Curve("this trial", "residual", found.error[:, k]),
            Curve("expected next", "predicted", found.expected[:, k]),
        )
        strips = (
            build_strip("error", 180, *error),
            build_strip("correction", 120, Curve("correction", "measured", found.correction[:, k])),
        )
        views.append(View("trial", joint, t, strips))
    key = [
        Key("residual", "error of this trial"), Key("predicted", "expected of the next"), Key("measured", "next correction"),
    ]  # fmt: skip
    yield TimeView("errors and correction over time", views, key)
    picture = found.convergence.picture
    if picture is not None:
        x = Axis("frequency [Hz]", (0.0, float(picture.frequency[-1])))
        y = Axis("growth of an error in an iteration", pad_limits(picture.growth, np.array([0.0, 1.1])))
        marks = (Line(np.array(x.limits), np.ones(2), "limit"), Line(picture.frequency, picture.growth))
        yield Figures([Figure(x, y, marks, "convergence", (WHOLE, 240))], "wide-chart")
        yield Text("Dashed: above it an error grows.", "note")


@present_kind.register
def present_observation(found: ToolObservation) -> Presentation:
    """Return how an observed tool is presented."""
    half = 1e6 * 1.96 * float(found.stderr.max())
    return Presentation(
        "Observed tool", ", ".join(found.axes), "Observed tool",
        f"The tool is known to ±{format_number(half, 3)} µm (95 % interval of the widest axis).",
        Verdict("care" if found.warnings else "good", f"By a {found.how}."),
        f"{len(found.t)} samples, {found.t[-1]:.3g} s",
        [
            Chapter("axes", "Axis by axis", lambda: _build_observed(found), On.ALL),
            Chapter("way", "Beside the actuators' tool", lambda: _build_deflection(found)),
        ],
        found.warnings, data=found.to_rows, result=found,
    )  # fmt: skip


def _build_observed(found: ToolObservation) -> Iterator[Element]:
    names = ("deflection_rms", "deflection_max", "half_width95")
    rows = [[r["axis"], *(f"{format_fixed_digits(1e6 * r[n])} µm" for n in names)] for r in found.to_rows()]
    yield _table(("axis", "RMS deflection", "largest", "95 % half-width"), rows)


def _build_deflection(found: ToolObservation) -> Iterator[Element]:
    views = []
    for k, axis in enumerate(found.axes):
        deflection, half = 1e6 * (found.position - found.kinematic)[:, k], 1.96e6 * found.stderr[k]
        strip = build_strip("deflection [µm]", 200, Curve("deflection", "predicted", deflection), bounds=(-half, half))
        views.append(View("log", axis, found.t, (strip,)))
    yield TimeView(
        "tool less what the actuators say, over time", views, [Key("predicted", "deflection"), Key("limit", "95 %")]
    )
    yield Text(f"{ZOOM}Lines: half-width of the 95 % interval around zero deflection.", "note")


@present_kind.register
def present_lead_through(found: LeadThroughAdvice) -> Presentation:
    """Return how limits of lead-through are presented."""
    share = float(found.settings.gain[0, 0]) / found.limit.gain
    return Presentation(
        "Lead-through", "force loop", "Lead-through: stability limit and settings",
        f"The loop oscillates from {found.limit.gain:.3g} m/s per N on, at {found.limit.hz:.3g} Hz.",
        Verdict("care" if found.warnings else "good", f"The settings use {format_percent(100 * share)} of that."),
        f"contact of {found.settings.contact_stiffness:.4g} N/m, servo of {found.settings.loop.servo_hz:.3g} Hz",
        [
            Chapter("settings", "Settings and limits", lambda: _build_settings(found), On.ALL),
            Chapter("stiffness", "Stiffer and softer contacts", lambda: _build_stiffness(found)),
        ],
        found.warnings, data=found.to_rows, result=found,
    )  # fmt: skip


def _build_settings(found: LeadThroughAdvice) -> Iterator[Element]:
    rows = [
        [r["name"].replace("_", " "), f"{format_number(r['value'], 4)} {format_unit(r['unit'])}"]
        for r in found.to_rows()
    ]
    yield _table(("", "value"), rows)


def _build_stiffness(found: LeadThroughAdvice) -> Iterator[Element]:
    stiffness, gain = (np.log10(x) for x in found.limits_over_stiffness())
    x, y = (
        Axis("log10 contact stiffness [N/m]", pad_limits(stiffness)),
        Axis("log10 gain [m/s per N]", pad_limits(gain)),
    )
    own = np.log10(found.settings.contact_stiffness)
    at = Line(np.array([own, own]), np.array(pad_limits(gain)), "expected")
    yield Figures([Figure(x, y, (Line(stiffness, gain, "limit"), at), "stability limit", (WHOLE, 240))], "wide-chart")
    yield Text("Above the line the loop oscillates.", "note")
