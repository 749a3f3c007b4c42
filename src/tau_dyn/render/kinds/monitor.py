"""A payload, and what has changed on a running robot."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn import results as r
from tau_dyn.monitor import PayloadEstimate, WatchResult
from tau_dyn.render.presentation import present_kind, warn


@present_kind.register
def present_payload(found: PayloadEstimate) -> r.Presentation:
    """Return how a payload is presented."""
    mass = r.format_with_uncertainty(float(found.mass.values[0]), float(found.mass.stderr[0]))
    headline = f"{found.link} carries {mass} kg more."
    verdict = r.Verdict(
        "care" if found.warnings else "good", "The loaded logs differ from the empty ones by a payload."
    )
    if not found.differs:
        headline = f"No payload shows: at most {found.largest_mass:.3g} kg (95 %)."
        verdict = r.Verdict("good", "Empty and loaded logs do not differ.")
    sections = [
        r.Chapter("payload", "Payload", lambda: _build_payload(found), r.On.ALL),
        *warn(found.warnings),
        r.Chapter("friction", "Friction, loaded less empty", lambda: _build_friction(found)),
    ]
    counts = " and ".join(
        r.count(len(names), f"{kind} log") for names, kind in zip(found.logs, ("empty", "loaded"), strict=True)
    )
    return r.Presentation(
        "Payload", found.robot.name, f"{found.robot.name}: payload", headline, verdict, counts, sections, found.warnings,
        r.RobotPicture(found.robot), data=lambda: _list_rows(found), result=found,
    )  # fmt: skip


def _list_rows(found: PayloadEstimate) -> list[dict]:
    """Return one row a number: its name, value, standard error, unit, and whether it is determined."""
    rows = []
    names = (("mass",), ("centre_x", "centre_y", "centre_z"), ("ixx", "ixy", "iyy", "ixz", "iyz", "izz"))
    for part, words in zip((found.mass, found.centre, found.inertia), names, strict=True):
        for word, value, error in zip(words, part.values, part.stderr, strict=True):
            told = bool(np.isfinite(error))
            rows.append({
                "name": word, "value": float(value) if told else None, "stderr": float(error) if told else None,
                "unit": part.unit, "determined": part.determined,
            })  # fmt: skip
    return rows


def _build_payload(found: PayloadEstimate) -> Iterator[r.Element]:
    rows = []
    for row in _list_rows(found):
        told = row["value"] is not None
        amount = f"{r.format_with_uncertainty(row['value'], row['stderr'])} {row['unit']}" if told else "not told"
        rows.append(r.Row([row["name"], amount, "yes" if row["determined"] else "no"]))
    yield r.ResultTable([r.Column(""), r.Column("value", "number"), r.Column("determined")], rows, on=r.On.ALL)
    yield r.Text(
        f"In the frame {found.frame}; inertia about the centre. ± is one standard error. Chance of such a difference "
        f"between equal logs: {found.p_value:.2g}.",
        "note",
    )


def _format(value: float, stderr: float | None, unit: str) -> str:
    return "not told" if stderr is None else f"{value:.3g} ± {stderr:.2g} {unit}"


def _build_friction(found: PayloadEstimate) -> Iterator[r.Element]:
    rows = [
        r.Row([
            one.joint,
            *(_format(p.value, p.stderr, p.unit) for p in (one.coulomb, one.viscous)),
            "yes" if one.differs else "no",
        ])
        for one in found.friction
    ]  # fmt: skip
    columns = [r.Column("joint"), r.Column("Coulomb", "number"), r.Column("viscous", "number"), r.Column("differs")]
    if rows:
        yield r.ResultTable(columns, rows)
    yield r.Text("Friction follows load and temperature, so each recording may have its own.", "note")


@present_kind.register
def present_watch(found: WatchResult) -> r.Presentation:
    """Return what has changed."""
    robot, n = found.model.robot, len(found.changes)
    headline = f"{r.count(n, 'change')} in {found.watched_s:.0f} s of motion." if n else (
        f"Nothing changed in {found.watched_s:.0f} s of motion."
    )  # fmt: skip
    verdict = r.Verdict(
        "poor" if n else "care" if found.warnings else "good",
        f"False alarms: one in {1 / found.rate:.0f} hours of motion, on average.",
    )
    sections = [
        r.Chapter("alarms", "What changed, and since when", lambda: _build_alarms(found), r.On.ALL),
        *warn(found.warnings),
        r.Chapter("course", "Largest statistic over its threshold", lambda: _build_course(found)),
    ]
    return r.Presentation(
        "Watch", robot.name, f"{robot.name}: what changed", headline, verdict,
        f"{r.count(len(found.logs), 'log')}, the first {found.reference_s:.0f} s of motion taken as normal",
        sections, found.warnings, r.RobotPicture(robot), data=lambda: list(found.rows()), result=found,
    )  # fmt: skip


def _build_alarms(found: WatchResult) -> Iterator[r.Element]:
    rows = []
    for row in found.rows():
        low, high = row["since_ci95"]
        percent = row["unit"] == "1"
        scale, unit = (100.0, "%") if percent else (1.0, row["unit"])
        ends = " to ".join(f"{scale * x:.3g}" for x in row["ci95"])
        others = ", ".join(" of ".join(filter(None, (o["what"], o["joint"]))) for o in row["indistinguishable_from"])
        rows.append(r.Row([
            " of ".join(filter(None, (row["what"].replace("_", " "), row["joint"]))),
            f"{scale * row['size']:.3g} {unit} ({ends})", f"{row['since_t']:.4g} s ({low:.4g} to {high:.4g}), {row['since_log']}",
            f"{row['detected_t']:.4g} s, {row['log']}", others or "-",
        ]))  # fmt: skip
    columns = [r.Column(x) for x in ("what", "by (95 %)", "since (95 %)", "detected", "may also be")]
    if rows:
        yield r.ResultTable(columns, rows, on=r.On.ALL)
    watched = ", ".join(d.words for d in found.directions)
    unfelt = f" Not felt by this robot: {', '.join(d.words for d in found.unfelt)}." if found.unfelt else ""
    yield r.Text(f"Watched: {watched}.{unfelt}", "note")


def _build_course(found: WatchResult) -> Iterator[r.Element]:
    if not found.trace:
        return
    hours = np.arange(1, len(found.trace) + 1) * found.watched_s / max(len(found.trace), 1) / 3600
    ratio = np.array([x[2] for x in found.trace])
    x, y = (
        r.Axis("motion watched [h]", (0.0, float(hours[-1]))),
        r.Axis("over the threshold", (0.0, max(1.1, float(ratio.max())))),
    )
    marks = (r.Line(np.array(x.limits), np.ones(2), "limit"), r.Line(hours, ratio))
    yield r.Figures([r.Figure(x, y, marks, "statistic", (r.WHOLE, 240))], "wide-chart")
    yield r.Text("Dashed: above it a change is called one.", "note")
