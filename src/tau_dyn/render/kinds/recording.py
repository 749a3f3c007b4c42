"""A log, and the check of one: whether it is usable, its problems and their fixes, and the log itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tau_dyn.log import CheckFinding, Log, LogCheck, examine_clock
from tau_dyn.render.presentation import ZOOM, present_kind, warn
from tau_dyn.render.time_view import decimate_min_max
from tau_dyn.results import (
    SMALL,
    Axis,
    Chapter,
    Column,
    Curve,
    Dots,
    Element,
    Figure,
    Figures,
    Key,
    Level,
    Line,
    On,
    Presentation,
    Provenance,
    ResultTable,
    RobotPicture,
    Row,
    Text,
    TimeView,
    Verdict,
    View,
    build_histogram,
    build_strip,
    count,
    format_fixed_digits,
    format_list,
    format_number,
    format_percent,
    pad_limits,
)
from tau_dyn.robot import Robot

MAX_STEP_RATIO = 5.0
"""Steps longer than so many usual ones stand in the histogram's last bar."""
STEP_DOTS = 1500  # time steps drawn at most, half of them the worst
_MAX_TRACES = 4  # channels that a notebook draws
_MAX_VIEWS = 12  # channels of a log without joints that a page draws
_LEVELS: dict[str, Level] = {"fault": "poor", "warning": "care", "ok": "good"}
_ORDER = ("fault", "warning", "ok")


@present_kind.register
def present_log(log: Log, *, robot: Robot | None = None) -> Presentation:
    """Return how a log is presented, without a judgement of it.

    Args:
        log: The log.
        robot: Gives units and the picture.
    """
    joints = _list_joints(log)
    sections = [
        *warn(log.warnings),
        *_list_signals(log, joints, robot),
        Chapter("channels", "Channels", lambda: [_build_channels(log)], On.ALL),
        Chapter(
            "traces",
            "",
            lambda: [Figures([_draw_trace(log, n) for n in _select_traced(log)], on=On.NOTEBOOK)],
            On.NOTEBOOK,
        ),
        Chapter("clock", "Clock", lambda: _build_clock(log)),
    ]
    return Presentation(
        "Log", log.name, f"{log.name}: log", "", None, _summarise(log, joints), sections, log.warnings,
        None if robot is None else RobotPicture(robot), _trace_back(log, robot), log.to_frame, log,
    )  # fmt: skip


@present_kind.register
def present_check(checked: LogCheck, *, log: Log | None = None, robot: Robot | None = None) -> Presentation:
    """Return how the check of a log is presented.

    Args:
        checked: What `check_log` says of it.
        log: The log as read; without it only the findings are shown.
        robot: The robot it was checked against; gives units and the picture.
    """
    bad = [f for f in order_worst_first(checked) if f.severity != "ok"]
    level = _LEVELS[bad[0].severity] if bad else "good"
    badge = {"good": "Usable", "care": "Usable with warnings", "poor": "Not usable"}[level]
    topics = format_list(dict.fromkeys(f.topic for f in bad))
    said = f"Problems: {topics}." if topics else "Clock, channels, units and motion meet the needs of identification."
    sections = [Chapter("findings", "Problems and fixes", lambda: [_build_findings(checked)], On.ALL)] if bad else []
    if not bad:
        sections.append(Chapter("findings", "", lambda: [_build_findings(checked)], On.SCREENS))
    if log is not None:
        joints = _list_joints(log)
        sections += _list_signals(log, joints, robot)
        sections += [Chapter("joints", "Joints", lambda: _build_joints(log, checked, robot))] if joints else []
        sections.append(Chapter("clock", "Clock", lambda: _build_clock(log)))
    fine = _join_alike([f for f in checked.findings if f.severity == "ok"], checked.name)
    if fine:
        table = ResultTable(
            [Column(), Column()], [Row([topic, " ".join(texts)]) for topic, texts in fine], style="plain"
        )
        sections.append(Chapter("fine", "No fault found", lambda: [table], folded=True, open=not bad))
    names = ("severity", "topic", "sentence", "remedy")
    return Presentation(
        "Check of a log", checked.name, f"{checked.name}: check", describe_headline(checked), Verdict(level, said, badge),
        "" if log is None else _summarise(log, _list_joints(log)), sections, (), None if robot is None else RobotPicture(robot),
        Provenance() if log is None else _trace_back(log, robot),
        lambda: [{n: getattr(f, n) for n in names} for f in checked.findings], checked,
    )  # fmt: skip


def _trace_back(log: Log, robot: Robot | None) -> Provenance:
    return Provenance(logs=[("log", log.name, log.sha256 or "held in memory")], robot=robot)


def _list_joints(log: Log) -> list[str]:
    return list(dict.fromkeys((*log.joints("q"), *log.joints("tau"))))


def _summarise(log: Log, joints: Sequence[str]) -> str:
    size = f"{format_number(log.duration, 4)} s at {format_number(log.rate_hz, 4)} Hz, {count(log.n_samples, 'sample')}"
    return f"{size}; {format_list(joints) or 'no joint'}."


def _build_channels(log: Log) -> ResultTable:
    columns = [Column("channel"), *(Column(title, "number") for title in ("least", "mean", "most", "missing"))]
    rows = []
    for name, x in log.channels.items():
        there = x[np.isfinite(x)]
        spread = (there.min(), there.mean(), there.max()) if there.size else ()
        missing = str(x.size - there.size) if there.size < x.size else ""
        rows.append(Row([name, *([format_number(float(v)) for v in spread] or [""] * 3), missing]))
    return ResultTable(columns, rows, most=40, on=On.ALL)


def _select_traced(log: Log) -> list[str]:
    return ([n for n in log.channels if n.startswith(("q_", "tau_"))] or list(log.channels))[:_MAX_TRACES]


def _draw_trace(log: Log, name: str) -> Figure:
    t, columns = decimate_min_max(log.t, log.channels[name][:, None], 400)
    x, y = Axis("t [s]", (float(t[0]), float(t[-1]))), Axis("", pad_limits(columns))
    return Figure(x, y, (Line(t, columns[:, 0]),), name, SMALL)


def _build_findings(checked: LogCheck) -> ResultTable:
    """Return what was found, worst first; of what is fine, a terminal shows each topic once."""
    fine = Counter(f.topic for f in checked.findings if f.severity == "ok")
    columns = [Column(), Column("topic", style="quiet"), Column("problem"), Column("fix", on=On.PAGE | On.NOTEBOOK)]
    rows, seen = [], set()
    for f in order_worst_first(checked):
        badge, text = Verdict(_LEVELS[f.severity], "", f.severity), describe_check(f, checked.name)
        if f.severity != "ok":
            rows.append(Row([badge, f.topic, _capital(f, checked.name), f.remedy], on=On.PAGE | On.NOTEBOOK))
            rows.append(Row([badge, f.topic, text + (f"\n→ {f.remedy}" if f.remedy else ""), ""], on=On.TERMINAL))
            continue
        rows.append(Row([badge, f.topic, text, f.remedy], on=On.NOTEBOOK))
        if f.topic not in seen:
            more = f" ({fine[f.topic] - 1} more alike)" if fine[f.topic] > 1 else ""
            rows.append(Row([badge, f.topic, text + more, ""], on=On.TERMINAL))
        seen.add(f.topic)
    return ResultTable(columns, rows, style="findings", on=On.ALL)


def _list_signals(log: Log, joints: Sequence[str], robot: Robot | None) -> list[Chapter]:
    views = _list_views(log, list(joints), _list_units(list(joints), robot)) if joints else _list_other_views(log)
    if not views:
        return []
    uneven = any(view.usable is not None for view in views)
    reference = [Key("measured", "reference")] if any(log.has("q_ref", [j]) for j in joints) else []
    key = [
        *reference,
        Key("predicted", "position"),
        Key("residual", "force"),
        *([Key("masked", "no samples")] if uneven else []),
    ]
    resampled = "; uneven samples are resampled to a uniform clock" if uneven else ""

    def build() -> Iterator[Element]:
        yield TimeView("position and force over time", views, key if joints else [])
        if not joints:
            yield Text(f"{ZOOM}As recorded, unfiltered{resampled}.", "note")
            return
        yield Text(
            f"{ZOOM}As recorded, unfiltered{resampled}. Good: motion in both directions at several speeds. The "
            "force steps by twice "
            "the friction at every reversal and is not clipped.",
            "note",
        )

    return [Chapter("signals", "Recorded signals", build)]


def _list_other_views(log: Log) -> list[View]:
    """Return the channels of a log without joints, one view each."""
    names = list(log.channels)[:_MAX_VIEWS]
    t, channels, there = resample_evenly(log, names)
    usable = None if there.all() else there
    return [
        View(log.name, n, t, (build_strip(n, 230, Curve(n, "predicted", channels[n]), masked=True),), usable=usable)
        for n in names
        if np.isfinite(channels[n]).any()
    ]


def _list_units(joints: list[str], robot: Robot | None) -> dict[str, tuple[str, str]]:
    """Return the units of position and force by joint; open ones where no robot tells them."""
    units = [] if robot is None else zip(robot.position_units, robot.force_units, strict=True)
    known = dict(zip(() if robot is None else robot.actuated, units, strict=True))
    return {j: known.get(j, ("m or rad", "N or N m")) for j in joints}


def _list_views(log: Log, joints: list[str], units: dict[str, tuple[str, str]]) -> list[View]:
    wanted = [f"{s}_{j}" for j in joints for s in ("q", "q_ref", "tau") if log.has(s, [j])]
    t, channels, there = resample_evenly(log, wanted)
    views = []
    for joint in joints:
        curves = {s: channels.get(f"{s}_{joint}") for s in ("q_ref", "q", "tau")}
        motion = [("reference", "measured", curves["q_ref"]), ("position", "predicted", curves["q"])]
        drawn = [Curve(name, ink, x) for name, ink, x in motion if x is not None]
        strips = [build_strip(f"position [{units[joint][0]}]", 230, *drawn, masked=True)] if drawn else []
        if curves["tau"] is not None:
            force = Curve("force", "residual", curves["tau"])
            strips.append(build_strip(f"force [{units[joint][1]}]", 230, force, masked=True))
        views.append(View(log.name, joint, t, tuple(strips), usable=None if there.all() else there))
    return views


def _build_joints(log: Log, checked: LogCheck, robot: Robot | None) -> Iterator[Element]:
    joints = _list_joints(log)
    units = _list_units(joints, robot)
    titles = ("range", "top speed", "reversals", "forwards", "acceleration above its noise", "encoder noise", "encoder step",
              "lag", "top force", "force rms")  # fmt: skip
    columns = [Column("joint"), Column("unit", style="quiet"), *(Column(title, "number") for title in titles)]
    yield ResultTable(columns, [_build_joint(log, checked, j, ", ".join(units[j])) for j in joints], style="plainly")
    yield Text(
        "SI units: positions, encoder noise and step in the joint's unit, speed in that unit a second. Good: at "
        "least four reversals, "
        "motion forwards for about half the time, acceleration ten times its noise or more.",
        "note",
    )


def _build_joint(log: Log, checked: LogCheck, joint: str, unit: str) -> Row:
    f: dict[str, Any] = checked.numbers.get("joints", {}).get(joint, {})
    tau = log.channels.get(f"tau_{joint}")
    motion = ["–"] * 8
    if f:
        noise = f["acceleration_noise"]
        motion = [
            f"{format_fixed_digits(f['range'][0])} … {format_fixed_digits(f['range'][1])}",
            format_fixed_digits(f["speed"][1]),
            str(f["n_reversals"]),
            format_percent(100 * f["forward_share"]),
            f"{format_number(f['acceleration_rms'] / noise, 3)} ×" if noise > 0 else "no noise found",
            format_number(f["encoder_noise"], 2),
            format_number(f["quantisation"], 2) if f["quantisation"] else "none found",
            "–" if f["lag"] is None else f"{format_number(1000 * f['lag'], 2)} ms",
        ]
    force = ["–"] * 2
    if tau is not None:
        force = [format_number(x, 3) for x in (float(np.max(np.abs(tau))), float(np.sqrt(np.mean(tau**2))))]
    return Row([joint, unit, *motion, *force])


def _build_clock(log: Log) -> Iterator[Element]:
    yield Text(_describe_clock(log))
    clock = examine_clock(log)
    if clock.even and not clock.rounded:
        return
    yield Figures(_draw_steps(log, clock.dt), "charts steps")
    yield Text(
        "Left: histogram of the sampling steps, on a logarithmic scale. Right: the steps over time; unusual ones "
        "are all drawn, the "
        "others are thinned. Steps above five usual ones are drawn at the top.",
        "note",
    )


def _draw_steps(log: Log, dt: float) -> list[Figure]:
    """Return the histogram of the sampling steps, and the steps over time."""
    steps = 1000 * np.diff(log.t)
    shown = np.minimum(steps, 1000 * dt * MAX_STEP_RATIO)
    low, high = pad_limits(shown, share=0.04)
    low = max(0.0, low)
    counts, edges = np.histogram(shown, np.linspace(low, high, 61))
    decades = np.log10(1 + counts)
    y = Axis("log₁₀(1 + samples)", (0.0, 1.08 * float(decades.max())))
    often = Figure(Axis("step [ms]", (low, high)), y, (build_histogram(edges, decades),), "how often")
    worst = np.argsort(-np.abs(steps - np.median(steps)))[: STEP_DOTS // 2]
    some = np.unique(np.concatenate([worst, np.arange(0, len(steps), max(1, 2 * len(steps) // STEP_DOTS))]))
    x = Axis("time [s]", (float(log.t[0]), float(log.t[-1])))
    dots = Dots(log.t[some], shown[some], "steps")
    return [often, Figure(x, Axis("step [ms]", (low, high)), (dots,), "when", (720, 240))]


def _describe_clock(log: Log) -> str:
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


def resample_evenly(log: Log, names: Sequence[str]) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Return an even grid (n,), channels on it, NaN in gaps, and where there are samples (n,); an even log as it is."""
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
    """Return a finding's sentence with a capital in front, where it begins with a word and not a channel's name."""
    text = describe_check(finding, name)
    first = text.split(" ", 1)[0]
    return text[:1].upper() + text[1:] if first.isalpha() else text


def _join_alike(findings: Sequence[CheckFinding], name: str) -> list[tuple[str, list[str]]]:
    """Return sentences by topic, channels without a fault named together."""
    topics: dict[str, list[str]] = {}
    for f in findings:
        topics.setdefault(f.topic, []).append(_capital(f, name))
    no_fault = ": no fault found."
    for topic, said in topics.items():
        faultless = [s.removesuffix(no_fault) for s in said if s.endswith(no_fault)]
        rest = [s for s in said if not s.endswith(no_fault)]
        joined = f"{format_list(faultless, 24)}{no_fault}"
        topics[topic] = ([joined] if faultless else []) + rest
    return list(topics.items())


def order_worst_first(checked: LogCheck) -> list[CheckFinding]:
    """Return all findings, faults before warnings before what is fine."""
    return sorted(checked.findings, key=lambda f: _ORDER.index(f.severity))


def describe_check(finding: CheckFinding, name: str) -> str:
    """Return a finding's sentence without the log's name in front."""
    return finding.sentence.removeprefix(f"{name}: ")


def describe_headline(checked: LogCheck) -> str:
    """Return whether a log may be used, in a sentence."""
    faults = sum(f.severity == "fault" for f in checked.findings)
    doubts = sum(f.severity == "warning" for f in checked.findings)
    if not checked.fit_for_use:
        more = f", {count(doubts, 'warning')}" if doubts else ""
        return f"This log is not usable: {count(faults, 'fault')}{more}."
    return f"This log is usable, with {count(doubts, 'warning')}." if doubts else "This log is usable."
