"""The page of `tau-dyn check`: whether the log is usable, its problems and their fixes, and the log itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.log import CheckFinding, Log, LogCheck, examine_clock
from tau_dyn.report.check_words import check_headline, describe_check, order_worst_first
from tau_dyn.report.formatting import Level, count, format_fixed_digits, format_list, format_number, format_percent
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.svg import THIRD, Chart, pad_limits
from tau_dyn.report.time_view import Curve, View, resample_evenly, strip
from tau_dyn.robot import Robot

MAX_STEP_RATIO = 5.0
"""Steps longer than so many usual ones stand in the histogram's last bar."""
STEP_DOTS = 1500  # time steps drawn at most, half of them the worst


def check_page(log: Log, checked: LogCheck, *, robot: Robot | None = None, command_line: str = "") -> str:
    """Return the check of a log as one HTML page.

    Args:
        log: The log as read.
        checked: What `check_log` says of it.
        robot: The robot it was checked against; gives units and the picture.
        command_line: The command that repeats it, for the provenance.
    """
    joints = list(dict.fromkeys((*log.joints("q"), *log.joints("tau"))))
    units = _units(joints, robot)
    found = order_worst_first(checked)
    return render_page(
        "check.html.j2",
        f"{log.name}: check",
        _opening(log, checked, joints),
        _views(log, joints, units),
        robot=robot,
        logs=[("log", log.name, log.sha256 or "held in memory")],
        command_line=command_line,
        name=log.name,
        problems=[(f, _said(f, log)) for f in found if f.severity != "ok"],
        fine=_alike([f for f in found if f.severity == "ok"], log),
        badges={"fault": "poor", "warning": "care"},
        rows=[_row(log, checked, j, *units[j]) for j in joints],
        has_reference=any(log.has("q_ref", [j]) for j in joints),
        clock=_clock_words(log),
        step_charts=_step_charts(log),
    )


def _opening(log: Log, checked: LogCheck, joints: list[str]) -> PageHeader:
    faults = [f for f in checked.findings if f.severity == "fault"]
    doubts = [f for f in checked.findings if f.severity == "warning"]
    level: Level = "poor" if faults else "care" if doubts else "good"
    badge = {"good": "Usable", "care": "Usable with warnings", "poor": "Not usable"}[level]
    topics = format_list(dict.fromkeys(f.topic for f in [*faults, *doubts]))
    judgement = (
        f"Problems: {topics}." if topics else "Clock, channels, units and motion meet the needs of identification."
    )
    summary = (
        f"{format_number(log.duration, 4)} s at {format_number(log.rate_hz, 4)} Hz, {count(log.n_samples, 'sample')}, "
        f"{count(len(joints), 'joint')}: {format_list(joints)}."
    )
    return PageHeader(check_headline(checked, "This log"), level, badge, judgement, summary)


def _units(joints: list[str], robot: Robot | None) -> dict[str, tuple[str, str]]:
    """Return the units of position and force by joint; open ones where no robot tells them."""
    units = [] if robot is None else zip(robot.position_units, robot.force_units, strict=True)
    known = dict(zip(() if robot is None else robot.actuated, units, strict=True))
    return {j: known.get(j, ("m or rad", "N or N m")) for j in joints}


def _views(log: Log, joints: list[str], units: dict[str, tuple[str, str]]) -> list[View]:
    wanted = [f"{s}_{j}" for j in joints for s in ("q", "q_ref", "tau") if log.has(s, [j])]
    t, channels, there = resample_evenly(log, wanted)
    views = []
    for joint in joints:
        curves = {s: channels.get(f"{s}_{joint}") for s in ("q_ref", "q", "tau")}
        motion = [("reference", "measured", curves["q_ref"]), ("position", "predicted", curves["q"])]
        drawn = [Curve(name, ink, x) for name, ink, x in motion if x is not None]
        strips = [strip(f"position [{units[joint][0]}]", 230, *drawn, masked=True)] if drawn else []
        if curves["tau"] is not None:
            force = Curve("force", "residual", curves["tau"])
            strips.append(strip(f"force [{units[joint][1]}]", 230, force, masked=True))
        views.append(View(log.name, joint, t, tuple(strips), usable=None if there.all() else there))
    return views


def _said(finding: CheckFinding, log: Log) -> str:
    """Return a finding's sentence with a capital in front, where it begins with a word and not a channel's name."""
    text = describe_check(finding, log.name)
    first = text.split(" ", 1)[0]
    return text[:1].upper() + text[1:] if first.isalpha() else text


def _alike(findings: Sequence[CheckFinding], log: Log) -> list[tuple[str, list[str]]]:
    """Return sentences by topic, channels without a fault named together."""
    topics: dict[str, list[str]] = {}
    for f in findings:
        topics.setdefault(f.topic, []).append(_said(f, log))
    no_fault = ": no fault found."
    for topic, said in topics.items():
        faultless = [s.removesuffix(no_fault) for s in said if s.endswith(no_fault)]
        rest = [s for s in said if not s.endswith(no_fault)]
        joined = f"{format_list(faultless, 24)}{no_fault}"
        topics[topic] = ([joined] if faultless else []) + rest
    return list(topics.items())


def _row(log: Log, checked: LogCheck, joint: str, position: str, force: str) -> dict[str, str]:
    f: dict[str, Any] = checked.numbers.get("joints", {}).get(joint, {})
    tau = log.channels.get(f"tau_{joint}")
    row = {"joint": joint, "unit": position, "force_unit": force}
    if f:
        row |= {
            "range": f"{format_fixed_digits(f['range'][0])} … {format_fixed_digits(f['range'][1])}",
            "speed": format_fixed_digits(f["speed"][1]),
            "reversals": str(f["n_reversals"]),
            "forward": format_percent(100 * f["forward_share"]),
            "noise": format_number(f["encoder_noise"], 2),
            "step": format_number(f["quantisation"], 2) if f["quantisation"] else "none found",
            "lag": "" if f["lag"] is None else f"{format_number(1000 * f['lag'], 2)} ms",
            "acceleration": _times(f["acceleration_rms"], f["acceleration_noise"]),
        }
    if tau is not None:
        peak = float(np.max(np.abs(tau)))
        row |= {"force": format_number(peak, 3), "force_rms": format_number(float(np.sqrt(np.mean(tau**2))), 3)}
    return row


def _times(signal: float, noise: float) -> str:
    return f"{format_number(signal / noise, 3)} ×" if noise > 0 else "no noise found"


def _clock_words(log: Log) -> str:
    clock = examine_clock(log)
    text = f"{format_number(1000 * clock.dt, 6)} ms from sample to sample"
    if clock.rounded:
        return f"{text}; uniform clock, rounded stamps."
    if clock.even:
        most = max(1e6 * clock.jitter * clock.dt, 0.01)
        return f"{text}, off by {format_number(most, 2)} µs at most; no sample is missing."
    parts = [f"steps differ by up to {format_percent(100 * clock.jitter)}"]
    parts += [f"{count(clock.n_missing, 'sample')} missing"] if clock.n_missing else []
    parts += [count(len(clock.gaps), "gap")] if clock.gaps else []
    return f"{text}; {format_list(parts)}."


def _step_charts(log: Log) -> list[Markup]:
    """Return the histogram of the sampling steps and the steps over time; nothing where the clock is even."""
    clock = examine_clock(log)
    if clock.even and not clock.rounded:
        return []
    steps, limit = 1000 * np.diff(log.t), 1000 * clock.dt * MAX_STEP_RATIO
    shown = np.minimum(steps, limit)
    low, high = pad_limits(shown, share=0.04)
    counts, edges = np.histogram(shown, np.linspace(max(0.0, low), high, 61))
    decades = np.log10(1 + counts)
    chart = Chart(THIRD, 240, (float(edges[0]), float(edges[-1])), (0.0, 1.08 * float(decades.max())), "how often", "step [ms]",
                  "log₁₀(1 + samples)")  # fmt: skip
    x, y = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(decades, 2), [0.0]])
    worst = np.argsort(-np.abs(steps - np.median(steps)))[: STEP_DOTS // 2]
    some = np.unique(np.concatenate([worst, np.arange(0, len(steps), max(1, 2 * len(steps) // STEP_DOTS))]))
    when = Chart(720, 240, (float(log.t[0]), float(log.t[-1])), (max(0.0, low), high), "when", "time [s]", "step [ms]")
    return [chart.render(chart.line(x, y, "histogram")), when.render(when.dots(log.t[some], shown[some], "steps"))]
