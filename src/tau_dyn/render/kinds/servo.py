"""Identification through the closed loop: headline, error by joint, positions, parameters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn import results as r
from tau_dyn.render.presentation import BADGES, ZOOM, flatten_rows, list_logs_used, pad_used, present_kind, warn
from tau_dyn.servo import LoopIdentification, LoopParameter

GOOD_SHARE, POOR_SHARE = 0.3, 0.9
"""Ratio of held-out error to the command's own error below which a simulation is usable, and above which it is no improvement."""
_MAX_VIEWS = 60  # time intervals on a page


@present_kind.register
def present_loop_identification(found: LoopIdentification) -> r.Presentation:
    """Return the presentation of an identification in closed loop."""
    robot = found.model.robot
    sections = [
        r.Chapter("errors", "", lambda: _build_glance(found), r.On.PRINTED),
        *warn(found.warnings),
        r.Chapter("position", "Measured and simulated position", lambda: _build_positions(found)),
        r.Chapter("parameters", "Parameters", lambda: _build_parameters(found), r.On.ALL),
    ]
    facts = [("friction model", found.friction), ("seed", str(found.seed)), ("held out", found.holdout_how)]
    return r.Presentation(
        "Identified through the loop", robot.name, f"{robot.name}: identified through the loop", _describe_headline(found),
        _describe_verdict(found),
        f"{r.count(len(found.logs), 'training log')}, commands and positions.", sections, found.warnings,
        r.RobotPicture(robot), r.Provenance(facts, list_logs_used(found.model.provenance), robot),
        lambda: flatten_rows(found.rows()), found,
    )  # fmt: skip


def _describe_headline(found: LoopIdentification) -> str:
    judged, held = found.holdout or found.train, "held-out " if found.holdout else ""
    rms, command = np.linalg.norm(judged.rms_per_joint), np.linalg.norm(judged.pool(judged.command_rms))
    n = np.sqrt(len(judged.joints))
    return (
        f"The simulated loop is {1e3 * rms / n:.1f} mrad off {held}positions (rms of all joints); the command itself is "
        f"{1e3 * command / n:.1f} mrad off."
    )


def _describe_verdict(found: LoopIdentification) -> r.Verdict:
    judged = found.holdout or found.train
    share = float(np.linalg.norm(judged.rms_per_joint) / max(np.linalg.norm(judged.pool(judged.command_rms)), 1e-9))
    if share < GOOD_SHARE and found.poor_fits:
        listed = ", ".join(one.joint for one in found.poor_fits)
        return r.judge("care", f"The simulation follows the robot and lacks an effect at {listed}.", BADGES)
    if share < GOOD_SHARE:
        return r.judge("good", "The simulation follows the robot from its commands alone.", BADGES)
    if share < POOR_SHARE:
        return r.judge("care", "The simulation misses a good part of the loop's motion.", BADGES)
    return r.judge("poor", "The simulation is no better than the command itself.", BADGES)


def _build_glance(found: LoopIdentification) -> Iterator[r.Element]:
    judged, train, held = found.holdout or found.train, found.train, found.holdout is not None
    columns = [
        r.Column("joint"),
        r.Column("held out [mrad]" if held else "fit [mrad]", "number", "strong"),
        *([r.Column("training", "number", "quiet")] if held else []),
        r.Column("command itself", "number", "quiet"),
        r.Column("all samples", "number", "quiet"),
    ]
    whole = judged.all_samples or judged
    rows = []
    for k, joint in enumerate(judged.joints):
        cells = [joint, f"{1e3 * judged.rms_per_joint[k]:.1f}"]
        cells += [f"{1e3 * train.rms_per_joint[k]:.1f}"] if held else []
        cells += [f"{1e3 * judged.pool(judged.command_rms)[k]:.1f}", f"{1e3 * whole.rms_per_joint[k]:.1f}"]
        rows.append(r.Row(cells))
    yield r.ResultTable(columns, rows, on=r.On.PRINTED)
    if held and len(judged.logs) > 1:
        names = [r.Column("held-out log"), *(r.Column(f"{joint} [mrad]", "number") for joint in judged.joints)]
        lines = [
            r.Row([log, *("–" if np.isnan(x) else f"{1e3 * x:.1f}" for x in row)])
            for log, row in zip(judged.logs, judged.rms, strict=True)
        ]
        yield r.ResultTable(names, lines, on=r.On.PAGE)


def _build_positions(found: LoopIdentification) -> Iterator[r.Element]:
    key = r.build_key(measured="measured", predicted="simulated", residual="residual", masked="not used")
    yield r.TimeView("measured and simulated position over time, and the residual", list(_list_views(found)), key)
    yield r.explain(f"{ZOOM}Simulated from the commands alone. Grey: the tool rests on something, or excluded.")


def _list_views(found: LoopIdentification) -> Iterator[r.View]:
    given = 0
    for record, predicted, held in found.shown:
        for k, joint in enumerate(found.model.robot.actuated):
            if (given := given + 1) > _MAX_VIEWS:
                return
            q, p = record.measured[:, k], predicted[:, k]
            both = r.Curve("measured", "measured", q), r.Curve("simulated", "predicted", p)
            rest = (r.Curve("residual", "residual", q - p),)
            strips = (
                r.Strip("position [rad]", both, pad_used(np.concatenate([q, p])), 290),
                r.Strip("residual [rad]", rest, pad_used(np.concatenate([q - p, p - q]), 0.25), 180, masked=True),
            )
            yield r.View(record.name, joint, record.t, strips, held, (), record.used)


def _build_parameters(found: LoopIdentification) -> Iterator[r.Element]:
    columns = [
        r.Column("parameter"), r.Column("value ± standard error", "number", "strong"), r.Column("95 % interval", "number"),
        r.Column("unit", "unit"), r.Column("remark", style="remark"),
    ]  # fmt: skip
    known = [p for p in found.parameters if p.stderr is not None]
    yield r.ResultTable(columns, [_build_row(p) for p in known], on=r.On.ALL)
    rest = len(found.parameters) - len(known)
    if rest:
        yield r.explain(f"{rest} more parameters of bodies show only in combinations, which --json lists.", on=r.On.ALL)


def _build_row(p: LoopParameter) -> r.Row:
    row, wide = p.to_dict(), p.stderr or 0.0
    interval = row["ci95"]
    text = "" if interval is None else f"{r.format_number(interval[0], 3)} to {r.format_number(interval[1], 3)}"
    remark = "at its bound" if p.at_bound else "" if row["determined"] else "poorly determined"
    return r.Row([p.name, f"{r.format_number(p.value, 3)} ± {r.format_number(wide, 2)}", text, p.unit, remark])
