"""Controlled actuators, a step of learning, an observed tool, the limits of lead-through."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tau_dyn.control.iterative import ActuatorModels, JointLearning, LearningStep
from tau_dyn.control.lead_through import LeadThroughAdvice
from tau_dyn.control.observers import ToolObservation
from tau_dyn.render.presentation import ZOOM, present_kind
from tau_dyn.results import (
    THIRD,
    WHOLE,
    Z95,
    Axis,
    Chapter,
    Column,
    Curve,
    Dots,
    Element,
    Figure,
    Figures,
    Key,
    Line,
    On,
    Presentation,
    ResultTable,
    Ribbon,
    Row,
    Rule,
    Strokes,
    Text,
    TimeView,
    Verdict,
    View,
    build_strip,
    count,
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
    """Return the presentation of fitted actuators."""
    worst = min(fit.fit_percent for fit in found.fits)
    verdict = Verdict("care" if found.warnings else "good", f"The worst axis is explained to {worst:.3g} %.")
    slowest = min(fit.actuator.bandwidth_hz for fit in found.fits)
    return Presentation(
        "Controlled actuators", ", ".join(found.outputs), "Controlled actuators",
        f"The slowest axis follows its reference up to {slowest:.3g} Hz (-3 dB).", verdict,
        f"{count(len(found.records), 'test')}, a sample every {1e3 * found.dt:g} ms",
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
    """Return the presentation of learning."""
    last = [drive.outcomes[-1] for drive in found.drives]
    low, high = (
        max(getattr(drive.forecast, end) / max(rms, 1e-300) for drive, rms in zip(found.drives, last, strict=True))
        for end in ("low", "high")
    )
    chapters = [Chapter("joints", "Joint by joint", lambda: _build_learning(found), On.ALL)]
    if len(found.errors) > 1:
        chapters.append(Chapter("trials", "Trial by trial", lambda: _build_trials(found)))
    chapters += [
        Chapter("frequencies", "By frequency", lambda: _build_frequencies(found)),
        Chapter("trial", "Last trial and correction", lambda: _build_trial(found)),
    ]
    settings = "no law" if found.gain is None else (
        f"learns up to {found.cutoff_hz:g} Hz, gain {found.gain:g}, "
        + ("inverse of the model" if found.shift is None else f"shift {found.shift} samples")
    )  # fmt: skip
    return Presentation(
        "Learning", ", ".join(found.joints), "Iterative learning: the next correction",
        f"The next trial's error is expected at {format_percent(100 * low)} to {format_percent(100 * high)} of this one's "
        "(95 %, worst joint).",
        _judge_learning(found), f"{count(len(found.errors), 'trial')}; {settings}", chapters,
        found.warnings, data=found.to_rows, result=found,
    )  # fmt: skip


def _judge_learning(found: LearningStep) -> Verdict:
    """Return the verdict that the trials support."""
    actions = [drive.action for drive in found.drives]
    stopped = [j for j, action in zip(found.joints, actions, strict=True) if action == "stop"]
    if stopped:
        return Verdict("care", f"Learning stops: {', '.join(stopped)}.")
    inside, predicted = found.count_inside()
    if not predicted:
        return Verdict("care", "No change of the command has been seen yet; friction may hold a drive.")
    held = f"{inside} of {count(predicted, 'outcome')} within the predicted interval."
    if "change" in actions:
        return Verdict("care", f"A trial missed its prediction; the law is another one. {held}")
    if all(action == "floor" for action in actions):
        return Verdict("good", f"The error is at its floor. {held}")
    growth = max(drive.largest_growth[2] for drive in found.drives)
    sentence = "No frequency grows" if growth < 1 else "A growth at some frequency is not excluded"
    return Verdict("good" if growth < 1 else "care", f"{sentence}: at most {growth:.4g} times a trial (95 %). {held}")


def _milli(x: float) -> str:
    return format_fixed_digits(1e3 * x)


def _describe_filter(row: Mapping[str, Any]) -> str:
    return "inverse" if row["inverts"] else str(row["shift_samples"])


def _build_learning(found: LearningStep) -> Iterator[Element]:
    rows = []
    for r in found.to_rows():
        law = "none" if r["gain"] is None else f"{r['gain']:g}, {_describe_filter(r)}, {r['cutoff_hz']:g} Hz"
        following = " to ".join(_milli(x) for x in r["expected_error_rms_ci95"])
        rows.append([r["joint"], _milli(r["error_rms"]), following, _milli(r["largest_correction"]), law, r["action"]])
    titles = ("joint", "RMS error", "next (95 %)", "largest correction", "gain, shift, cutoff", "action")
    yield _table(titles, rows)
    yield Text("In mm or mrad, where learning acts fully; shift in samples.", "note")


def _build_trials(found: LearningStep) -> Iterator[Element]:
    yield Figures([_draw_trials(joint, drive) for joint, drive in zip(found.joints, found.drives, strict=True)])
    rows = []
    for r in found.to_trial_rows():
        predicted, within = "", ""
        if r["inside"] is not None:
            predicted = " to ".join(_milli(x) for x in r["predicted_rms_ci95"])
            within = "yes" if r["inside"] else "no"
        rows.append([str(r["trial"]), r["joint"], _milli(r["error_rms"]), predicted, within])
    yield _table(("trial", "joint", "RMS error", "predicted (95 %)", "within"), rows)
    yield Text(
        "In mm or mrad. Dots: achieved. Strokes: 95 % intervals from the trials before; last: the next trial.", "note"
    )


def _draw_trials(joint: str, drive: JointLearning) -> Figure:
    """Return one drive's errors by trial with their predicted intervals."""
    n = len(drive.outcomes)
    low, high = (
        np.log10([1e3 * getattr(f, end) for f in (*drive.forecasts[1:], drive.forecast) if f is not None])
        for end in ("low", "high")
    )
    achieved, later = np.log10(1e3 * np.maximum(drive.outcomes, 1e-300)), np.arange(2.0, n + 2)
    marks = (Strokes(later, low, later, high, "predicted"), Dots(np.arange(1.0, n + 1), achieved, size=6.0))
    limits = pad_limits(np.concatenate([low, high, achieved]))
    x, y = Axis("trial", (0.0, n + 2.0)), Axis("log10 RMS error [mm or mrad]", limits)
    return Figure(x, y, marks, joint, (THIRD, 200))


def _build_frequencies(found: LearningStep) -> Iterator[Element]:
    rows = []
    for r in found.to_frequency_rows():
        achieved = "" if r["growth_achieved"] is None else format_fixed_digits(r["growth_achieved"])
        following = " to ".join(format_fixed_digits(x) for x in r["growth_predicted_ci95"])
        band = f"{r['low_hz']:g} to {r['high_hz']:g}"
        rows.append([r["joint"], band, _milli(r["first_error_rms"]), _milli(r["error_rms"]), achieved, following])
    yield _table(("joint", "Hz", "first error", "last error", "last growth", "next growth (95 %)"), rows)
    yield Figures([_draw_growth(joint, drive) for joint, drive in zip(found.joints, found.drives, strict=True)])
    yield Text(
        "Errors in mm or mrad. Growth: an error over that of the trial before; empty within the noise. Area: 95 %.",
        "note",
    )


def _draw_growth(joint: str, drive: JointLearning) -> Figure:
    """Return the growth of one drive's error per trial over frequency."""
    f = drive.response.frequency
    shown = f <= 2 * (drive.law.cutoff_hz if drive.law else 20.0)
    mean, stderr = (x[shown] for x in drive.growth())
    low, high = np.maximum(mean - Z95 * stderr, 0), mean + Z95 * stderr
    x, y = Axis("frequency [Hz]", (0.0, float(f[shown][-1]))), Axis("growth", pad_limits(np.append(high, [0.0, 1.1])))
    return Figure(x, y, (Ribbon(f[shown], low, high), Line(f[shown], mean), Rule("limit", y=1.0)), joint, (THIRD, 200))


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


@present_kind.register
def present_observation(found: ToolObservation) -> Presentation:
    """Return the presentation of an observed tool."""
    half = 1e6 * 1.96 * float(found.stderr.max())
    return Presentation(
        "Observed tool", ", ".join(found.axes), "Observed tool",
        f"The tool is known to ±{format_number(half, 3)} µm (95 % interval of the widest axis).",
        Verdict("care" if found.warnings else "good", f"By a {found.how}."),
        f"{len(found.t)} samples, {found.t[-1]:.3g} s",
        [
            Chapter("axes", "Axis by axis", lambda: _build_observed(found), On.ALL),
            Chapter("way", "Deflection from the actuators' position", lambda: _build_deflection(found)),
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
        "tool less its position from the actuators, over time",
        views,
        [Key("predicted", "deflection"), Key("limit", "95 %")],
    )
    yield Text(f"{ZOOM}Lines: half-width of the 95 % interval around zero deflection.", "note")


@present_kind.register
def present_lead_through(found: LeadThroughAdvice) -> Presentation:
    """Return the presentation of limits of lead-through."""
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
    names = [r["name"].removesuffix("_hz").replace("_", " ") for r in found.to_rows()]
    rows = [
        [
            f"frequency of {name}" if r["name"].endswith("_hz") else name,
            f"{format_number(r['value'], 4)} {format_unit(r['unit'])}",
        ]
        for name, r in zip(names, found.to_rows(), strict=True)
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
