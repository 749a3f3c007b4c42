"""A simulated log with the truth behind it, and an exciting motion against the robot's limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tau_dyn.excitation import InformationPrediction
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.render.kinds.fit_quality import FAIR, WELL, describe_separation
from tau_dyn.render.presentation import ZOOM, present_kind, warn
from tau_dyn.results import (
    Axis,
    Bar,
    Beside,
    Chapter,
    Column,
    Curve,
    Element,
    Figure,
    Figures,
    Key,
    Level,
    Line,
    Listing,
    On,
    Presentation,
    Provenance,
    ResultTable,
    Ring,
    RobotPicture,
    Row,
    Shown,
    Text,
    TimeView,
    Verdict,
    View,
    build_strip,
    capitalise,
    count,
    format_fixed_digits,
    format_limit,
    format_list,
    format_number,
    format_percent,
    format_unit,
    pad_limits,
)
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors, Trajectory

FORCE_NEAR = 0.999
"""Share of a force limit at which a drive counts as saturated."""
PHASE_POINTS = 1500  # points of a phase plot at most


@dataclass(frozen=True, eq=False)
class SimulatedLog(Shown):
    """A log that `simulate` made, and what it was made of.

    Attributes:
        log: The log.
        model: The simulated robot, whose values are the truth.
        sensors: Its sensors; None for perfect ones.
        made: What else its provenance says, such as `motion` and `seed`.
    """

    log: Log
    model: Model
    sensors: Sensors | None = None
    made: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ExcitingMotion(Shown):
    """A motion that informs, and how well.

    Attributes:
        motion: The motion.
        model: Robot and what shall be identified.
        condition: `compute_base_condition` of both.
        prediction: The standard errors that it will give; None for none.
        made: What else its provenance says, such as `trials` and `seed`.
    """

    motion: Trajectory
    model: Model
    condition: float
    prediction: InformationPrediction | None = None
    made: Mapping[str, str] = field(default_factory=dict)


@present_kind.register
def present_simulation(found: SimulatedLog) -> Presentation:
    """Return how a simulated log is presented."""
    log, robot = found.log, found.model.robot
    rows = [_follow(log, robot, k) for k in range(robot.na)]
    sections = [
        *warn(log.warnings),
        Chapter("signals", "What the log shows", lambda: _build_signals(log, robot)),
        Chapter("joints", "Joint by joint", lambda: [_build_followed(rows)], On.ALL),
        Chapter("truth", "What was simulated", lambda: _build_truth(found)),
    ]
    text = f"{format_number(log.duration, 4)} s of simulated {robot.name} at {format_number(log.rate_hz, 4)} Hz"
    errors = [r["error_share"] for r in rows if r["error_share"] is not None]
    follows = (
        f"; it follows its reference to {format_percent(100 * max(errors))} of each joint's travel" if errors else ""
    )
    samples = f"{log.n_samples:,}".replace(",", " ")
    summary = f"{log.name}: {samples} samples of {format_list(robot.actuated)}, read through the sensors below. Not a recording."
    return Presentation(
        "Simulated log", log.name, f"{log.name}: simulated", f"{text}{follows}.", _judge_simulation(log, rows), summary, sections,
        log.warnings, RobotPicture(robot), Provenance(list(found.made.items()), robot=robot), log.to_frame, found,
    )  # fmt: skip


def _judge_simulation(log: Log, rows: list[dict[str, Any]]) -> Verdict:
    saturated = [r["joint"] for r in rows if r["saturated"]]
    if saturated:
        said = f"The force of {format_list(saturated)} reached its limit; identification leaves these samples out."
        return Verdict("care", said, "Saturated")
    if log.warnings:
        return Verdict("care", f"{count(len(log.warnings), 'warning')} below.", "Made, with warnings")
    return Verdict("good", "No drive reached its limit of force.", "Made")


def _build_signals(log: Log, robot: Robot) -> Iterator[Element]:
    key = [Key("measured", "reference"), Key("predicted", "position"), Key("residual", "force"), Key("limit", "limit")]
    views = [_log_view(log, robot, k) for k in range(robot.na)]
    yield TimeView("position, how far it is behind its reference, and force, over time", views, key)
    yield Text(
        f"{ZOOM}As the sensors read it. A limit is drawn where the motion comes near it. Good: the position stays "
        "on its reference, "
        "and no force sits at its limit.",
        "note",
    )


def _build_followed(rows: list[dict[str, Any]]) -> ResultTable:
    titles = ("covers", "behind, rms", "at most", "force rms")
    columns = [Column("joint"), Column("unit", style="quiet"), *(Column(title, "number") for title in titles),
               Column("top force", "number", "strong"), Column("limit", "number"),
               Column("share of the limit", "bar", "share")]  # fmt: skip
    return ResultTable(columns, [Row([r["joint"], r["unit"], *r["cells"]]) for r in rows], on=On.ALL)


def _follow(log: Log, robot: Robot, k: int) -> dict[str, Any]:
    """Return how a joint follows its reference and what force it takes."""
    joint, limit, unit = robot.actuated[k], float(robot.effort_limit[k]), robot.position_units[k]
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    travel, behind, force, bar = "–", ["–", "–"], ["–", "–", "–"], None
    share, saturated = None, False
    if q is not None:
        travel = f"{format_fixed_digits(float(q.min()))} … {format_fixed_digits(float(q.max()))}"
    if q is not None and reference is not None:
        off, whole = np.abs(reference - q), float(np.ptp(reference))
        behind = [f"{format_fixed_digits(1000 * float(x))} m{unit}" for x in (np.sqrt(np.mean(off**2)), off.max())]
        share = float(off.max()) / whole if whole > 0 else None
    if tau is not None:
        peak, rms = float(np.max(np.abs(tau))), float(np.sqrt(np.mean(tau**2)))
        force, bar = [format_number(rms, 3), format_number(peak, 3), format_limit(limit)], _share(peak, limit)
        saturated = bool(peak >= FORCE_NEAR * limit)
    cells = [travel, *behind, *force, bar]
    about = f"{unit}, {robot.force_units[k]}"
    return {"joint": joint, "unit": about, "cells": cells, "error_share": share, "saturated": saturated}


def _build_truth(found: SimulatedLog) -> Iterator[Element]:
    """Give the true values that are not zero, the sensors, and the forces beyond the rigid body."""
    model, robot = found.model, found.model.robot
    rows = [Row([p.name, format_number(p.value, 5), format_unit(p.unit)]) for p in model.parameters if p.value != 0.0]
    left: list[Element] = [
        Text("True values", "heading"),
        ResultTable([Column(), Column(kind="number"), Column(kind="unit")], rows, style="plain"),
        Text("Parameters not listed are zero.", "note"),
    ]
    right: list[Element] = []
    if found.sensors is not None:
        sensors = [Row(row) for row in _list_sensors(found.sensors)]
        right += [Text("Sensors", "heading"), ResultTable([Column(), Column()], sensors, style="plain"),
                  Text("SI units; a noise is a standard deviation.", "note")]  # fmt: skip
    equations = list(dict.fromkeys(effect.equation for effect in model.effects))
    right += [Listing(equations, "Forces beyond the rigid body", "code")] if equations else []
    right += [Listing(list(robot.assumed), "Assumed in the robot file")] if robot.assumed else []
    yield Beside(left, right)


@present_kind.register
def present_excitation(found: ExcitingMotion) -> Presentation:
    """Return how an exciting motion is presented."""
    motion, model, condition = found.motion, found.model, found.condition
    robot, free = model.robot, int(np.sum(model.parameters.free))
    level: Level = "good" if condition < WELL else "care" if condition < FAIR else "poor"
    badge = {"good": "Tells them apart", "care": "Usable", "poor": "Too poor"}[level]
    predicted = Chapter("predicted", "Predicted standard errors", lambda: _build_prediction(found), On.ALL)
    sections = [
        Chapter("joints", "Joints", lambda: _build_driven(found), On.ALL),
        *([predicted] if found.prediction is not None else []),
        Chapter("motion", "The motion", lambda: _build_motion(motion, robot)),
        Chapter("phase", "Speed over position", lambda: _build_phases(motion, robot)),
    ]
    return Presentation(
        "Exciting motion", robot.name, f"{robot.name}: exciting motion",
        f"A motion of {format_number(motion.duration, 4)} s with condition number {format_number(condition, 3)}.",
        Verdict(level, f"{capitalise(describe_separation(condition))}.", badge),
        f"{count(robot.na, 'joint')}: {format_list(robot.actuated)}; {count(free, 'free parameter')}; "
        f"condition numbers below {WELL:g} are good, above {FAIR:g} poor.",
        sections, motion.notes, RobotPicture(robot), Provenance(list(found.made.items()), robot=robot),
        lambda: {"t": motion.t} | {f"{s}_{j}": getattr(motion, s)[:, k] for s in "qva" for k,
        j in enumerate(robot.actuated)}, found,
    )  # fmt: skip


def _build_driven(found: ExcitingMotion) -> Iterator[Element]:
    motion, robot = found.motion, found.model.robot
    columns = [
        Column("joint"), Column("unit", style="quiet"), Column("range", "number"), Column("of", "number", "quiet"),
        Column("its travel", "bar", "share"), Column("top speed", "number"), Column("limit", "number", "quiet"),
        Column("share of the limit", "bar", "share", on=On.PAGE), Column("top acceleration", "number"),
        Column("reversals", "number"),
    ]  # fmt: skip
    yield ResultTable(columns, [_build_joint(motion, robot, k) for k in range(robot.na)], on=On.ALL)
    if motion.notes:
        yield Listing(list(motion.notes))


def _build_joint(motion: Trajectory, robot: Robot, k: int) -> Row:
    q, v, a = motion.q[:, k], motion.v[:, k], motion.a[:, k]
    low, high, fastest = float(robot.lower[k]), float(robot.upper[k]), float(robot.velocity_limit[k])
    room = np.isfinite(high - low) and high > low
    start, end = np.clip((np.array([q.min(), q.max()]) - low) / (high - low), 0, 1) if room else (0.0, 0.0)
    top = float(np.max(np.abs(v)))
    return Row([
        robot.actuated[k], robot.position_units[k],
        f"{format_fixed_digits(float(q.min()))} … {format_fixed_digits(float(q.max()))}",
        f"{format_limit(low)} … {format_limit(high)}" if room else "none", Bar(float(end), float(start)) if room else None,
        format_fixed_digits(top), format_limit(fastest), _share(top, fastest), format_fixed_digits(float(np.max(np.abs(a)))),
        str(int(np.sum(np.diff(np.sign(v[v != 0])) != 0))),
    ])  # fmt: skip


def _build_prediction(found: ExcitingMotion) -> Iterator[Element]:
    """Give name, value, error and unit of each base parameter, and the error as a share of the value."""
    prediction = found.prediction
    rows = [] if prediction is None else [
        Row([r["expression"], format_number(r["value"], 4), format_number(r["stderr"], 2), format_unit(r["unit"]),
             format_percent(100 * r["stderr"] / abs(r["value"])) if r["value"] else ""])
        for r in prediction.rows()
    ]  # fmt: skip
    columns = [Column("parameter"), Column("assumed", "number"), Column("standard error", "number"),
    Column("unit", "unit", "quiet"),
               Column("of the value", "number")]  # fmt: skip
    yield ResultTable(columns, rows, on=On.ALL)
    yield Text("Predicted from the assumed noise. Friction of another law and tracking errors add to them.", "note")


def _build_motion(motion: Trajectory, robot: Robot) -> Iterator[Element]:
    key = [Key("predicted", "position, speed"), Key("residual", "acceleration"), Key("limit", "limit")]
    views = [_motion_view(motion, robot, k) for k in range(robot.na)]
    yield TimeView("position, speed and acceleration over time", views, key)
    yield Text(
        f"{ZOOM}A limit is drawn where the motion comes near it. The robot file's limits are the only limits considered; check "
        "cables, tools and people before you run it.",
        "note",
    )


def _build_phases(motion: Trajectory, robot: Robot) -> Iterator[Element]:
    yield Figures([_draw_phase(motion, robot, k) for k in range(robot.na)])
    yield Text(
        "The dashed frame is the limits. Good: the curve fills the frame, with both signs of speed at every "
        "position. Friction and "
        "gravity are identified only where the motion goes. Singularities of the loops and limits of force keep "
        "it from the corners.",
        "note",
    )


def _draw_phase(motion: Trajectory, robot: Robot, k: int) -> Figure:
    """Return one joint's speed over its position: what the motion visits of what it may."""
    unit, fastest = robot.position_units[k], float(robot.velocity_limit[k])
    low, high = float(robot.lower[k]), float(robot.upper[k])
    step = max(1, motion.n_samples // PHASE_POINTS)
    q, v = motion.q[::step, k], motion.v[::step, k]
    corners = np.array([[low, fastest], [high, fastest], [high, -fastest], [low, -fastest]])
    frame = [Ring(corners, "limit")] if np.isfinite(corners).all() else []
    xlim, ylim = (pad_limits(c[np.isfinite(c)], x) for c, x in zip(corners.T, (q, v), strict=True))
    x, y = Axis(f"position [{unit}]", xlim), Axis(f"speed [{unit}/s]", ylim)
    return Figure(x, y, (*frame, Line(q, v, "phase")), robot.actuated[k])


def _share(value: float, limit: float) -> Bar | None:
    """Return how much of a limit is used; None where there is none."""
    return Bar(min(value / limit, 1.0)) if np.isfinite(limit) and limit > 0 else None


def _log_view(log: Log, robot: Robot, k: int) -> View:
    joint, unit, force = robot.actuated[k], robot.position_units[k], robot.force_units[k]
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    motion = [("reference", "measured", reference), ("position", "predicted", q)]
    strips = [build_strip(f"position [{unit}]", 230, *[Curve(n, i, x) for n, i, x in motion if x is not None],
                    bounds=(robot.lower[k], robot.upper[k]))]  # fmt: skip
    if reference is not None and q is not None:
        strips.append(
            build_strip(
                f"behind [m{unit}]", 130, Curve("behind by", "predicted", 1000 * (reference - q)), symmetric=True
            )
        )
    if tau is not None:
        limit = robot.effort_limit[k]
        strips.append(build_strip(f"force [{force}]", 210, Curve("force", "residual", tau), bounds=(-limit, limit)))
    return View(log.name, joint, log.t, tuple(strips))


def _motion_view(motion: Trajectory, robot: Robot, k: int) -> View:
    unit, fastest = robot.position_units[k], robot.velocity_limit[k]
    strips = (
        build_strip(f"position [{unit}]", 220, Curve("position", "predicted", motion.q[:, k]),
              bounds=(robot.lower[k], robot.upper[k])),
        build_strip(f"speed [{unit}/s]", 180, Curve("speed", "predicted", motion.v[:, k]), bounds=(-fastest, fastest)),
        build_strip(f"accel. [{unit}/s²]", 180, Curve("acceleration", "residual", motion.a[:, k])),
    )  # fmt: skip
    return View(motion.name, robot.actuated[k], motion.t, strips)


def _list_sensors(sensors: Sensors) -> list[tuple[str, str]]:
    """Return each sensor setting that is not perfect."""
    shown = [(f.name.replace("_", " "), getattr(sensors, f.name)) for f in fields(sensors) if f.name != "tool"]
    rows = [(name, format_list([format_number(float(x), 4) for x in np.atleast_1d(value)])) for name, value in shown
            if value is not None and np.size(value) and np.any(np.asarray(value) != 0)]  # fmt: skip
    return rows or [("sensors", "perfect")]
