"""A log and its check: whether it is usable, problems and fixes, and the log itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.log import CheckFinding, Log, LogCheck, examine_clock
from tau_dyn.render.presentation import ZOOM, present_kind, warn
from tau_dyn.render.time_view import decimate_min_max
from tau_dyn.robot import Robot

MAX_STEP_RATIO = 5.0
"""Ratio to the usual step above which steps are counted in the histogram's last bar."""
STEP_DOTS = 1500  # time steps drawn at most, half of them the worst
_MAX_TRACES = 4  # channels that a notebook draws
_MAX_VIEWS = 12  # channels of a log without joints that a page draws
_LEVELS: dict[str, r.Level] = {"fault": "poor", "warning": "care", "ok": "good"}
_ORDER = ("fault", "warning", "ok")


@present_kind.register
def present_log(log: Log, *, robot: Robot | None = None) -> r.Presentation:
    """Return the presentation of a log, without a verdict.

    Args:
        log: The log.
        robot: Gives units and the picture.
    """
    joints = _list_joints(log)
    sections = [
        *warn(log.warnings),
        *_list_signals(log, joints, robot),
        r.Chapter("channels", "Channels", lambda: [_build_channels(log)], r.On.ALL),
        r.Chapter(
            "traces",
            "",
            lambda: [r.Figures([_draw_trace(log, n) for n in _select_traced(log)], on=r.On.NOTEBOOK)],
            r.On.NOTEBOOK,
        ),
        r.Chapter("clock", "Clock", lambda: _build_clock(log)),
    ]
    return r.Presentation(
        "Log", log.name, f"{log.name}: log", "", None, _summarise(log, joints), sections, log.warnings,
        None if robot is None else r.RobotPicture(robot), _trace_back(log, robot), log.to_frame, log,
    )  # fmt: skip


@present_kind.register
def present_check(checked: LogCheck, *, log: Log | None = None, robot: Robot | None = None) -> r.Presentation:
    """Return the presentation of the check of a log.

    Args:
        checked: The result of `check_log`.
        log: The log as read; without it only the findings are shown.
        robot: The robot of the check; gives units and the picture.
    """
    bad = [f for f in order_worst_first(checked) if f.severity != "ok"]
    level = _LEVELS[bad[0].severity] if bad else "good"
    badge = {"good": "Usable", "care": "Usable with warnings", "poor": "Not usable"}[level]
    topics = r.format_list(dict.fromkeys(f.topic for f in bad))
    said = f"Problems: {topics}." if topics else "Clock, channels, units and motion meet the needs of identification."
    title, on = ("Problems and fixes", r.On.ALL) if bad else ("", r.On.SCREENS)
    sections = [r.Chapter("findings", title, lambda: [_build_findings(checked)], on)]
    if log is not None:
        joints = _list_joints(log)
        sections += _list_signals(log, joints, robot)
        sections.append(r.Chapter("joints", "Joints", lambda: _build_joints(log, checked, robot), when=bool(joints)))
        sections.append(r.Chapter("clock", "Clock", lambda: _build_clock(log)))
    fine = _join_alike([f for f in checked.findings if f.severity == "ok"], checked.name)
    if fine:
        table = r.tabulate_plainly((topic, " ".join(texts)) for topic, texts in fine)
        sections.append(r.Chapter("fine", "No fault found", lambda: [table], folded=True, open=not bad))
    names = ("severity", "topic", "sentence", "remedy")
    return r.Presentation(
        "Check of a log", checked.name, f"{checked.name}: check", describe_headline(checked), r.Verdict(level, said, badge),
        "" if log is None else _summarise(log, _list_joints(log)), sections, (), None if robot is None else r.RobotPicture(robot),
        r.Provenance() if log is None else _trace_back(log, robot),
        lambda: [{n: getattr(f, n) for n in names} for f in checked.findings], checked,
    )  # fmt: skip


def _trace_back(log: Log, robot: Robot | None) -> r.Provenance:
    return r.Provenance(logs=[("log", log.name, log.sha256 or "held in memory")], robot=robot)


def _list_joints(log: Log) -> list[str]:
    return list(dict.fromkeys((*log.joints("q"), *log.joints("tau"))))


def _summarise(log: Log, joints: Sequence[str]) -> str:
    size = f"{r.format_number(log.duration, 4)} s at {r.format_number(log.rate_hz, 4)} Hz, {r.count(log.n_samples, 'sample')}"
    return f"{size}; {r.format_list(joints) or 'no joint'}."


def _build_channels(log: Log) -> r.ResultTable:
    columns = [r.Column("channel"), *r.list_numbers("least", "mean", "most", "missing")]
    rows = []
    for name, x in log.channels.items():
        there = x[np.isfinite(x)]
        spread = (there.min(), there.mean(), there.max()) if there.size else ()
        missing = str(x.size - there.size) if there.size < x.size else ""
        rows.append(r.Row([name, *([r.format_number(float(v)) for v in spread] or [""] * 3), missing]))
    return r.ResultTable(columns, rows, most=40, on=r.On.ALL)


def _select_traced(log: Log) -> list[str]:
    return ([n for n in log.channels if n.startswith(("q_", "tau_"))] or list(log.channels))[:_MAX_TRACES]


def _draw_trace(log: Log, name: str) -> r.Figure:
    t, columns = decimate_min_max(log.t, log.channels[name][:, None], 400)
    x, y = r.Axis("t [s]", (float(t[0]), float(t[-1]))), r.Axis("", r.pad_limits(columns))
    return r.Figure(x, y, (r.Line(t, columns[:, 0]),), name, r.SMALL)


def _build_findings(checked: LogCheck) -> r.ResultTable:
    """Return the findings, worst first; a terminal shows each topic without a fault once."""
    fine = Counter(f.topic for f in checked.findings if f.severity == "ok")
    columns = [r.Column(), r.Column("topic", style="quiet"), r.Column("problem"), r.Column("fix", on=r.On.DRAWN)]
    rows, seen = [], set()
    for f in order_worst_first(checked):
        badge, text = r.Verdict(_LEVELS[f.severity], "", f.severity), describe_check(f, checked.name)
        if f.severity != "ok":
            rows.append(r.Row([badge, f.topic, _capital(f, checked.name), f.remedy], on=r.On.DRAWN))
            rows.append(r.Row([badge, f.topic, text + (f"\n→ {f.remedy}" if f.remedy else ""), ""], on=r.On.TERMINAL))
            continue
        rows.append(r.Row([badge, f.topic, text, f.remedy], on=r.On.NOTEBOOK))
        if f.topic not in seen:
            more = f" ({fine[f.topic] - 1} more alike)" if fine[f.topic] > 1 else ""
            rows.append(r.Row([badge, f.topic, text + more, ""], on=r.On.TERMINAL))
        seen.add(f.topic)
    return r.ResultTable(columns, rows, style="findings", on=r.On.ALL)


def _list_signals(log: Log, joints: Sequence[str], robot: Robot | None) -> list[r.Chapter]:
    views = _list_views(log, list(joints), _list_units(list(joints), robot)) if joints else _list_other_views(log)
    if not views:
        return []
    uneven = any(view.usable is not None for view in views)
    reference = [r.Key("measured", "reference")] if any(log.has("q_ref", [j]) for j in joints) else []
    key = [
        *reference,
        r.Key("predicted", "position"),
        r.Key("residual", "force"),
        *([r.Key("masked", "no samples")] if uneven else []),
    ]
    resampled = "; uneven samples are resampled to a uniform clock" if uneven else ""

    def build() -> Iterator[r.Element]:
        yield r.TimeView("position and force over time", views, key if joints else [])
        if not joints:
            yield r.explain(f"{ZOOM}As recorded, unfiltered{resampled}.")
            return
        yield r.explain(
            f"{ZOOM}As recorded, unfiltered{resampled}. Good: motion in both directions at several speeds. The force "
            "steps by twice the friction at every reversal and is not clipped."
        )

    return [r.Chapter("signals", "Recorded signals", build)]


def _list_other_views(log: Log) -> list[r.View]:
    """Return one view for each channel of a log without joints."""
    names = list(log.channels)[:_MAX_VIEWS]
    t, channels, there = resample_evenly(log, names)
    usable = None if there.all() else there
    return [
        r.View(
            log.name, n, t, (r.build_strip(n, 230, r.Curve(n, "predicted", channels[n]), masked=True),), usable=usable
        )
        for n in names
        if np.isfinite(channels[n]).any()
    ]


def _list_units(joints: list[str], robot: Robot | None) -> dict[str, tuple[str, str]]:
    """Return the units of position and force by joint; generic ones without a robot."""
    units = [] if robot is None else zip(robot.position_units, robot.force_units, strict=True)
    known = dict(zip(() if robot is None else robot.actuated, units, strict=True))
    return {j: known.get(j, ("m or rad", "N or N m")) for j in joints}


def _list_views(log: Log, joints: list[str], units: dict[str, tuple[str, str]]) -> list[r.View]:
    wanted = [f"{s}_{j}" for j in joints for s in ("q", "q_ref", "tau") if log.has(s, [j])]
    t, channels, there = resample_evenly(log, wanted)
    views = []
    for joint in joints:
        curves = {s: channels.get(f"{s}_{joint}") for s in ("q_ref", "q", "tau")}
        motion = [("reference", "measured", curves["q_ref"]), ("position", "predicted", curves["q"])]
        drawn = [r.Curve(name, ink, x) for name, ink, x in motion if x is not None]
        strips = [r.build_strip(f"position [{units[joint][0]}]", 230, *drawn, masked=True)] if drawn else []
        if curves["tau"] is not None:
            force = r.Curve("force", "residual", curves["tau"])
            strips.append(r.build_strip(f"force [{units[joint][1]}]", 230, force, masked=True))
        views.append(r.View(log.name, joint, t, tuple(strips), usable=None if there.all() else there))
    return views


def _build_joints(log: Log, checked: LogCheck, robot: Robot | None) -> Iterator[r.Element]:
    joints = _list_joints(log)
    units = _list_units(joints, robot)
    titles = ("range", "top speed", "reversals", "forwards", "acceleration above its noise", "encoder noise", "encoder step",
              "lag", "top force", "force rms")  # fmt: skip
    columns = [r.Column("joint"), r.Column("unit", style="quiet"), *(r.Column(title, "number") for title in titles)]
    yield r.ResultTable(columns, [_build_joint(log, checked, j, ", ".join(units[j])) for j in joints], style="plainly")
    yield r.explain(
        "SI units: positions, encoder noise and step in the joint's unit, speed in that unit a second. Good: at least "
        "four reversals, motion forwards for about half the time, acceleration ten times its noise or more."
    )


def _build_joint(log: Log, checked: LogCheck, joint: str, unit: str) -> r.Row:
    f: dict[str, Any] = checked.numbers.get("joints", {}).get(joint, {})
    tau = log.channels.get(f"tau_{joint}")
    motion = ["–"] * 8
    if f:
        noise = f["acceleration_noise"]
        motion = [
            f"{r.format_fixed_digits(f['range'][0])} … {r.format_fixed_digits(f['range'][1])}",
            r.format_fixed_digits(f["speed"][1]),
            str(f["n_reversals"]),
            r.format_percent(100 * f["forward_share"]),
            f"{r.format_number(f['acceleration_rms'] / noise, 3)} ×" if noise > 0 else "no noise found",
            r.format_number(f["encoder_noise"], 2),
            r.format_number(f["quantisation"], 2) if f["quantisation"] else "none found",
            "–" if f["lag"] is None else f"{r.format_number(1000 * f['lag'], 2)} ms",
        ]
    force = ["–"] * 2
    if tau is not None:
        force = [r.format_number(x, 3) for x in (float(np.max(np.abs(tau))), float(np.sqrt(np.mean(tau**2))))]
    return r.Row([joint, unit, *motion, *force])


def _build_clock(log: Log) -> Iterator[r.Element]:
    yield r.Text(_describe_clock(log))
    clock = examine_clock(log)
    if clock.even and not clock.rounded:
        return
    yield r.Figures(_draw_steps(log, clock.dt), "charts steps")
    yield r.explain(
        "Left: histogram of the sampling steps, on a logarithmic scale. Right: the steps over time; unusual ones are "
        "all drawn, the others are thinned. Steps above five usual ones are drawn at the top."
    )


def _draw_steps(log: Log, dt: float) -> list[r.Figure]:
    """Return the histogram of the sampling steps, and the steps over time."""
    steps = 1000 * np.diff(log.t)
    shown = np.minimum(steps, 1000 * dt * MAX_STEP_RATIO)
    low, high = r.pad_limits(shown, share=0.04)
    low = max(0.0, low)
    counts, edges = np.histogram(shown, np.linspace(low, high, 61))
    decades = np.log10(1 + counts)
    y = r.Axis("log₁₀(1 + samples)", (0.0, 1.08 * float(decades.max())))
    often = r.Figure(r.Axis("step [ms]", (low, high)), y, (r.build_histogram(edges, decades),), "how often")
    worst = np.argsort(-np.abs(steps - np.median(steps)))[: STEP_DOTS // 2]
    some = np.unique(np.concatenate([worst, np.arange(0, len(steps), max(1, 2 * len(steps) // STEP_DOTS))]))
    x = r.Axis("time [s]", (float(log.t[0]), float(log.t[-1])))
    dots = r.Dots(log.t[some], shown[some], "steps")
    return [often, r.Figure(x, r.Axis("step [ms]", (low, high)), (dots,), "when", (720, 240))]


def _describe_clock(log: Log) -> str:
    clock = examine_clock(log)
    text = f"{r.format_number(1000 * clock.dt, 6)} ms from sample to sample"
    if clock.rounded:
        return f"{text}; uniform clock, rounded stamps."
    if clock.even:
        most = max(1e6 * clock.jitter * clock.dt, 0.01)
        return f"{text}, off by {r.format_number(most, 2)} µs at most; no sample is missing."
    parts = [f"steps differ by up to {r.format_percent(100 * clock.jitter)}"]
    parts += [f"{r.count(clock.n_missing, 'sample')} missing"] if clock.n_missing else []
    parts += [r.count(len(clock.gaps), "gap")] if clock.gaps else []
    return f"{text}; {r.format_list(parts)}."


def resample_evenly(log: Log, names: Sequence[str]) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Return a uniform grid (n,), channels on it with NaN in gaps, and the mask of samples (n,); a uniform log is unchanged."""
    clock = examine_clock(log)
    if clock.even:
        return log.t, {n: log.channels[n] for n in names}, np.ones(log.n_samples, bool)
    steps = int(np.clip(round(log.duration / clock.dt), 1, 4 * log.n_samples))
    grid = np.linspace(log.t[0], log.t[-1], steps + 1)
    there = np.ones(len(grid), bool)
    for i in clock.gaps:
        there &= (grid <= log.t[i]) | (grid >= log.t[i + 1])
    return grid, {n: np.where(there, np.interp(grid, log.t, log.channels[n]), np.nan) for n in names}, there


def _capital(finding: CheckFinding, name: str) -> str:
    """Return a finding's sentence with an initial capital, unless it begins with a channel's name."""
    return r.capitalise(describe_check(finding, name))


def _join_alike(findings: Sequence[CheckFinding], name: str) -> list[tuple[str, list[str]]]:
    """Return sentences by topic; channels without a fault are listed together."""
    topics: dict[str, list[str]] = {}
    for f in findings:
        topics.setdefault(f.topic, []).append(_capital(f, name))
    no_fault = ": no fault found."
    for topic, said in topics.items():
        faultless = [s.removesuffix(no_fault) for s in said if s.endswith(no_fault)]
        rest = [s for s in said if not s.endswith(no_fault)]
        joined = f"{r.format_list(faultless, 24)}{no_fault}"
        topics[topic] = ([joined] if faultless else []) + rest
    return list(topics.items())


def order_worst_first(checked: LogCheck) -> list[CheckFinding]:
    """Return all findings: faults, then warnings, then topics without a fault."""
    return sorted(checked.findings, key=lambda f: _ORDER.index(f.severity))


def describe_check(finding: CheckFinding, name: str) -> str:
    """Return a finding's sentence without the log's name."""
    return finding.sentence.removeprefix(f"{name}: ")


def describe_headline(checked: LogCheck) -> str:
    """Return a sentence about whether a log is usable."""
    faults = sum(f.severity == "fault" for f in checked.findings)
    doubts = sum(f.severity == "warning" for f in checked.findings)
    if not checked.fit_for_use:
        more = f", {r.count(doubts, 'warning')}" if doubts else ""
        return f"This log is not usable: {r.count(faults, 'fault')}{more}."
    return f"This log is usable, with {r.count(doubts, 'warning')}." if doubts else "This log is usable."
