"""A payload, a fleet of units, and changes of a monitored robot."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn import results as r
from tau_dyn.monitor import Direction, Fleet, PayloadEstimate, PropertyEstimate, WatchResult
from tau_dyn.render.presentation import flatten_rows, present_kind, warn


@present_kind.register
def present_payload(found: PayloadEstimate) -> r.Presentation:
    """Return the presentation of a payload."""
    mass, limit = found.mass, r.format_number(found.largest_mass, 2)
    if found.is_lighter:
        less = r.format_number(-found.plain_mass, 3)
        headline = f"The loaded logs are lighter than the empty ones by {less} kg, so no payload is determined."
        verdict = r.Verdict("poor", "Exchange the empty and the loaded logs if they were mixed up.")
    elif found.differs:
        said = r.format_with_uncertainty(float(mass.values[0]), float(mass.stderr[0]))
        headline = f"{found.link} carries {said} kg more in the loaded logs."
        missing = [name for name, part in (("centre", found.centre), ("inertia", found.inertia)) if not part.determined]
        told = (
            f" is determined; not determined: {' and '.join(missing)}"
            if missing
            else ", centre and inertia are determined"
        )
        verdict = r.Verdict("care" if missing or found.warnings else "good", f"The mass{told}.")
    else:
        headline = f"No payload shows between empty and loaded logs; one of more than {limit} kg would."
        verdict = r.Verdict("good", f"A difference as large is chance ({r.format_p_value(found.p_value)}).")
    empty, loaded = (r.format_list(list(names), 3) for names in found.logs)
    return r.Presentation(
        "Payload", found.robot.name, f"{found.robot.name}: payload", headline, verdict,
        f"without: {empty}; with: {loaded}",
        [
            r.Chapter("payload", "Payload", lambda: _list_properties(found), r.On.ALL),
            *warn(found.warnings),
            r.Chapter("friction", "Friction, empty and loaded", lambda: _list_friction(found)),
        ],
        found.warnings, r.RobotPicture(found.robot), data=lambda: flatten_rows(_list_rows(found)), result=found,
    )  # fmt: skip


def _list_rows(found: PayloadEstimate) -> list[dict]:
    rows = []
    for names, part in _name_parts(found):
        plain = part.to_dict()
        values, errors, ends = (x if isinstance(plain["value"], list) else [x] for x in (
            plain["value"], plain["stderr"], plain["ci95"]))  # fmt: skip
        for name, value, stderr, interval in zip(names, values, errors, ends, strict=True):
            rows.append({"name": name, "value": value, "stderr": stderr, "ci95": interval, "unit": part.unit})
    return rows


def _name_parts(found: PayloadEstimate) -> list[tuple[list[str], PropertyEstimate]]:
    inertia = found.to_dict()["payload"]["inertia_components"]
    return [(["mass"], found.mass), ([f"centre {x}" for x in "xyz"], found.centre), (inertia, found.inertia)]


def _list_properties(found: PayloadEstimate) -> Iterator[r.Element]:
    rows = []
    determined = {name: part.determined for names, part in _name_parts(found) for name in names}
    for row in _list_rows(found):
        seen = row["stderr"] is not None
        value = r.format_with_uncertainty(row["value"], row["stderr"]) if seen else "not told"
        interval = r.format_interval(row["ci95"], row["stderr"]) if seen else ""
        note = "" if determined[row["name"]] else "not determined"
        rows.append(r.Row([row["name"], value, interval, r.format_unit(row["unit"]), note]))
    columns = [
        r.Column(""),
        r.Column("estimate", "number"),
        r.Column("95 % interval", "number"),
        r.Column("", "unit"),
        r.Column(),
    ]
    yield r.ResultTable(columns, rows, on=r.On.ALL)
    yield r.explain(f"In the frame of {found.frame}; inertia about the centre.", on=r.On.ALL)
    yield r.explain(
        "± is one standard error; coloured noise and friction that differs between the logs are allowed for. A drive gain "
        "that is off scales mass and inertia equally."
    )


def _list_friction(found: PayloadEstimate) -> Iterator[r.Element]:
    rows = []
    for row in found.friction:
        parts = [
            f"{r.format_with_uncertainty(p.value, p.stderr) if p.stderr is not None else 'not told'} {r.format_unit(p.unit)}"
            for p in (row.coulomb, row.viscous)
        ]
        chance = "" if row.p_value is None else r.format_p_value(row.p_value)
        rows.append(r.Row([row.joint, *parts, chance, "differs" if row.differs else ""]))
    columns = [
        r.Column("joint"),
        r.Column("Coulomb", "number"),
        r.Column("viscous", "number"),
        r.Column("p", "number"),
        r.Column(),
    ]
    yield r.ResultTable(columns, rows)
    yield r.explain("Loaded minus empty. Coulomb friction follows the load that a gear carries, and its temperature.")


@present_kind.register
def present_watch(found: WatchResult) -> r.Presentation:
    """Return the presentation of a monitored robot."""
    hours = r.format_number(1 / found.rate, 2)
    if found.changes:
        headline = f"{_describe_change(found, 0)}."
        rest = len(found.changes) - 1
        level, sentence = "care", f"{r.count(len(found.changes), 'alarm')}; at most one false one in {hours} h."
        headline = headline if not rest else f"{headline[:-1]}, and {r.count(rest, 'more change')}."
    else:
        headline = f"Nothing changed in {r.format_number(found.watched_s, 3)} s of motion."
        level, sentence = "good", f"No alarm; at most one false one is expected in {hours} h."
    return r.Presentation(
        "Watch", found.model.robot.name, f"{found.model.robot.name}: watch", headline, r.Verdict(level, sentence),
        f"{r.format_list(list(found.logs), 3)}; reference {found.reference_s:g} s, watched {found.watched_s:g} s",
        [
            r.Chapter("alarms", "What changed", lambda: _list_alarms(found), r.On.ALL),
            *warn(found.warnings),
            r.Chapter("statistic", "Largest statistic over its threshold", lambda: _draw_trace(found)),
        ],
        found.warnings, r.RobotPicture(found.model.robot), data=lambda: flatten_rows(found.rows()), result=found,
    )  # fmt: skip


def _describe_change(found: WatchResult, k: int) -> str:
    change = found.changes[k]
    return f"{r.capitalise(found.directions[change.direction].words)} changed at {change.since_t:.6g} s of {change.since_log}"


def _format_size(direction: Direction, size: float, ends: tuple[float, float]) -> str:
    factor, unit = (100.0, "%") if direction.unit == "1" else (1.0, r.format_unit(direction.unit))
    half = factor * (ends[1] - ends[0]) / 2 / r.Z95
    return f"{r.format_with_uncertainty(factor * size, half)} {unit}"


def _list_alarms(found: WatchResult) -> Iterator[r.Element]:
    rows = []
    for change in found.changes:
        d = found.directions[change.direction]
        alike = r.format_list([found.directions[k].words for k in change.twins], 3) if change.twins else ""
        since = f"{change.since_t:.6g} s ({change.since_ci95[0]:.6g} … {change.since_ci95[1]:.6g})"
        rows.append(
            r.Row([d.words, _format_size(d, change.size, change.ci95), since, f"{change.detected_t:.6g} s", alike])
        )
    columns = [
        r.Column("what"),
        r.Column("size", "number"),
        r.Column("since (95 %)", "number"),
        r.Column("detected", "number"),
        r.Column("or"),
    ]
    if rows:
        yield r.ResultTable(columns, rows, on=r.On.ALL)
    watched = r.format_list([d.words for d in found.watched_for], 20)
    yield r.Text(f"Watched: {watched}.", on=r.On.DRAWN)
    if found.unfelt:
        yield r.Text(f"This robot does not feel: {r.format_list([d.words for d in found.unfelt], 20)}.", on=r.On.DRAWN)
    yield r.explain(
        "Sizes against the reference, the first motion, in which the residual of the model counts as normal. ± is one standard "
        "error. Blocks of 2 s in which joints move count as time."
    )


def _draw_trace(found: WatchResult) -> Iterator[r.Element]:
    views = []
    for log in dict.fromkeys(name for _, name, _ in found.trace):
        rows = [(t, x) for t, name, x in found.trace if name == log]
        t, x = (np.array(column) for column in zip(*rows, strict=True))
        if len(t) > 1:
            views.append(
                r.View(log, "", t, (r.build_strip("share of threshold", 180, r.Curve("statistic", "measured", x)),))
            )
    if views:
        key = r.Key("measured", "largest statistic; 1 is an alarm")
        yield r.TimeView("largest statistic over its threshold, over time", views, [key])


@present_kind.register
def present_fleet(found: Fleet) -> r.Presentation:
    """Return the presentation of a fleet."""
    robot = found.model.robot
    shown = [p for p in found.parameters if p.spread_ci95[0] > 0]
    told = r.count(len(found.parameters), "parameter")
    headline = f"{r.count(len(found.units), 'unit')}: they differ in {len(shown)} of {told}."
    odd = [row.unit for row in found.outlying]
    verdict = (
        r.Verdict("care", f"Outlying: {r.format_list(odd)}.")
        if odd
        else r.Verdict("good", "No unit is outlying; start a new one with identify --model.")
    )
    return r.Presentation(
        "Fleet", robot.name, f"{robot.name}: fleet", headline, verdict, f"units: {r.format_list(list(found.units), 6)}",
        [r.Chapter("fleet", "Mean and spread over units", lambda: _list_spreads(found), r.On.ALL), *warn(found.warnings)],
        found.warnings, r.RobotPicture(robot), data=lambda: flatten_rows([p.to_dict() for p in found.parameters]), result=found,
    )  # fmt: skip


def _list_spreads(found: Fleet) -> Iterator[r.Element]:
    columns = [
        r.Column("parameter"),
        r.Column("combination", "text", "spare", on=r.On.PAGE),
        r.Column("mean, 95 % interval", "number"),
        r.Column("spread, 95 % interval", "number"),
        r.Column("", "unit"),
        r.Column("units", "number", on=r.On.PAGE),
    ]
    rows = []
    for p in found.parameters:
        mean, spread = (
            f"{r.format_number(x, digits)} [{r.format_number(low, digits)}, {r.format_number(high, digits)}]"
            for x, (low, high), digits in ((p.mean, p.mean_ci95, 4), (p.spread, p.spread_ci95, 2))
        )
        combination = p.expression if p.expression != p.name else ""
        rows.append(r.Row([p.name, combination, mean, spread, r.format_unit(p.unit), str(p.n_units)]))
    yield r.ResultTable(columns, rows, style="names-above", on=r.On.ALL)
    yield r.explain(
        "Spread: standard deviation over units, their own errors taken out; its interval reaches zero where units may be equal. "
        "Combinations are of parameters that the logs see only together."
    )
