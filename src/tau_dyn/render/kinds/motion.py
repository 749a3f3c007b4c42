"""A simulated log with its true parameters, and an exciting motion with the robot's limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.render.kinds.fit_quality import FAIR, WELL, describe_separation
from tau_dyn.render.presentation import ZOOM, present_kind, warn
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors, Trajectory

if TYPE_CHECKING:
    from tau_dyn.excitation import InformationPrediction

FORCE_NEAR = 0.999
"""Share of a force limit at which a drive counts as saturated."""
PHASE_POINTS = 1500  # points of a phase plot at most


@dataclass(frozen=True, eq=False)
class SimulatedLog(r.Shown):
    """A log of `simulate`, and the model behind it.

    Attributes:
        log: The log.
        model: The simulated robot, whose values are the truth.
        sensors: Its sensors; None for ideal ones.
        made: Other entries of its provenance, such as `motion` and `seed`.
    """

    log: Log
    model: Model
    sensors: Sensors | None = None
    made: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ExcitingMotion(r.Shown):
    """An exciting motion with its predicted accuracy.

    Attributes:
        motion: The motion.
        model: Robot and parameters to be identified.
        condition: `compute_base_condition` of both.
        prediction: The predicted standard errors, or None.
        made: Other entries of its provenance, such as `trials` and `seed`.
    """

    motion: Trajectory
    model: Model
    condition: float
    prediction: InformationPrediction | None = None
    made: Mapping[str, str] = field(default_factory=dict)


@present_kind.register
def present_simulation(found: SimulatedLog) -> r.Presentation:
    """Return the presentation of a simulated log."""
    log, robot = found.log, found.model.robot
    rows = [_follow(log, robot, k) for k in range(robot.na)]
    sections = [
        *warn(log.warnings),
        r.Chapter("signals", "Contents of the log", lambda: _build_signals(log, robot)),
        r.Chapter("joints", "Joint by joint", lambda: [_build_followed(rows)], r.On.ALL),
        r.Chapter("truth", "Simulated model", lambda: _build_truth(found)),
    ]
    text = f"{r.format_number(log.duration, 4)} s of simulated {robot.name} at {r.format_number(log.rate_hz, 4)} Hz"
    errors = [row["error_share"] for row in rows if row["error_share"] is not None]
    follows = (
        f"; it follows its reference to {r.format_percent(100 * max(errors))} of each joint's travel" if errors else ""
    )
    samples = r.format_thousands(log.n_samples)
    summary = f"{log.name}: {samples} samples of {r.format_list(robot.actuated)}, read through the sensors below. "
    summary += "Not a recording."
    return r.Presentation(
        "Simulated log", log.name, f"{log.name}: simulated", f"{text}{follows}.", _judge_simulation(log, rows), summary, sections,
        log.warnings, r.RobotPicture(robot), r.Provenance(list(found.made.items()), robot=robot), log.to_frame, found,
    )  # fmt: skip


def _judge_simulation(log: Log, rows: list[dict[str, Any]]) -> r.Verdict:
    saturated = [row["joint"] for row in rows if row["saturated"]]
    if saturated:
        said = f"The force of {r.format_list(saturated)} reached its limit; identification leaves these samples out."
        return r.Verdict("care", said, "Saturated")
    if log.warnings:
        return r.Verdict("care", f"{r.count(len(log.warnings), 'warning')} below.", "Made, with warnings")
    return r.Verdict("good", "No drive reached its limit of force.", "Made")


def _build_signals(log: Log, robot: Robot) -> Iterator[r.Element]:
    key = r.build_key(measured="reference", predicted="position", residual="force", limit="limit")
    views = [_log_view(log, robot, k) for k in range(robot.na)]
    yield r.TimeView("position, how far it is behind its reference, and force, over time", views, key)
    yield r.explain(
        f"{ZOOM}As the sensors read it. A limit is drawn where the motion comes near it. Good: the position stays on "
        "its reference, and no force is at its limit."
    )


def _build_followed(rows: list[dict[str, Any]]) -> r.ResultTable:
    columns = [r.Column("joint"), r.Column("unit", style="quiet"),
               *r.list_numbers("covers", "behind, rms", "at most", "force rms"),
               r.Column("top force", "number", "strong"), r.Column("limit", "number"),
               r.Column("share of the limit", "bar", "share")]  # fmt: skip
    return r.ResultTable(columns, [r.Row([row["joint"], row["unit"], *row["cells"]]) for row in rows], on=r.On.ALL)


def _follow(log: Log, robot: Robot, k: int) -> dict[str, Any]:
    """Return the tracking error of a joint and its force."""
    joint, limit, unit = robot.actuated[k], float(robot.effort_limit[k]), robot.position_units[k]
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    travel, behind, force, bar = "–", ["–", "–"], ["–", "–", "–"], None
    share, saturated = None, False
    if q is not None:
        travel = f"{r.format_fixed_digits(float(q.min()))} … {r.format_fixed_digits(float(q.max()))}"
    if q is not None and reference is not None:
        off, whole = np.abs(reference - q), float(np.ptp(reference))
        behind = [f"{r.format_fixed_digits(1000 * float(x))} m{unit}" for x in (np.sqrt(np.mean(off**2)), off.max())]
        share = float(off.max()) / whole if whole > 0 else None
    if tau is not None:
        peak, rms = float(np.max(np.abs(tau))), float(np.sqrt(np.mean(tau**2)))
        force, bar = [r.format_number(rms, 3), r.format_number(peak, 3), r.format_limit(limit)], _share(peak, limit)
        saturated = bool(peak >= FORCE_NEAR * limit)
    cells = [travel, *behind, *force, bar]
    about = f"{unit}, {robot.force_units[k]}"
    return {"joint": joint, "unit": about, "cells": cells, "error_share": share, "saturated": saturated}


def _build_truth(found: SimulatedLog) -> Iterator[r.Element]:
    """Yield the nonzero true values, the sensors, and the forces in addition to the rigid body."""
    model, robot = found.model, found.model.robot
    rows = [
        r.Row([p.name, r.format_number(p.value, 5), r.format_unit(p.unit)]) for p in model.parameters if p.value != 0.0
    ]
    left: list[r.Element] = [
        r.Text("True values", "heading"),
        r.ResultTable([r.Column(), r.Column(kind="number"), r.Column(kind="unit")], rows, style="plain"),
        r.explain("Parameters not listed are zero."),
    ]
    right: list[r.Element] = []
    if found.sensors is not None:
        right += [r.Text("Sensors", "heading"), r.tabulate_plainly(_list_sensors(found.sensors))]
        right += [r.explain("SI units; a noise is a standard deviation.")]
    equations = list(dict.fromkeys(effect.equation for effect in model.effects))
    right += [r.Listing(equations, "Forces beyond the rigid body", "code")] if equations else []
    right += [r.Listing(list(robot.assumed), "Assumed in the robot file")] if robot.assumed else []
    yield r.Beside(left, right)


@present_kind.register
def present_excitation(found: ExcitingMotion) -> r.Presentation:
    """Return the presentation of an exciting motion."""
    motion, model, condition = found.motion, found.model, found.condition
    robot, free = model.robot, int(np.sum(model.parameters.free))
    level: r.Level = "good" if condition < WELL else "care" if condition < FAIR else "poor"
    badge = {"good": "Tells them apart", "care": "Usable", "poor": "Too poor"}[level]
    said, known = "Predicted standard errors", found.prediction is not None
    sections = [
        r.Chapter("joints", "Joints", lambda: _build_driven(found), r.On.ALL),
        r.Chapter("predicted", said, lambda: _build_prediction(found), r.On.ALL, when=known),
        r.Chapter("motion", "The motion", lambda: _build_motion(motion, robot)),
        r.Chapter("phase", "Speed over position", lambda: _build_phases(motion, robot)),
    ]
    return r.Presentation(
        "Exciting motion", robot.name, f"{robot.name}: exciting motion",
        f"A motion of {r.format_number(motion.duration, 4)} s with condition number {r.format_number(condition, 3)}.",
        r.Verdict(level, f"{r.capitalise(describe_separation(condition))}{_describe_largest_error(found)}.", badge),
        f"{r.count(robot.na, 'joint')}: {r.format_list(robot.actuated)}; {r.count(free, 'free parameter')}; condition "
        f"numbers below {WELL:g} are good, above {FAIR:g} poor.",
        sections, motion.notes, r.RobotPicture(robot), r.Provenance(list(found.made.items()), robot=robot),
        lambda: _tabulate(motion, robot), found,
    )  # fmt: skip


def _compute_error_percent(row: Mapping[str, Any]) -> float:
    """Return a predicted standard error in percent of its value; zero for a value of zero."""
    return 100 * row["stderr"] / abs(row["value"]) if row["value"] else 0.0


def _describe_largest_error(found: ExcitingMotion) -> str:
    """Return the largest predicted error as a clause; empty without predictions of values."""
    rows = [] if found.prediction is None else found.prediction.rows()
    worst = max(rows, key=_compute_error_percent, default=None)
    if worst is None or not worst["value"]:
        return ""
    return f"; predicted standard errors reach {r.format_percent(_compute_error_percent(worst))} of the value ({worst['name']})"


def _tabulate(motion: Trajectory, robot: Robot) -> dict[str, np.ndarray]:
    """Return one row per sample: time [s], positions, velocities, accelerations."""
    joints = list(enumerate(robot.actuated))
    return {"t": motion.t} | {f"{s}_{j}": getattr(motion, s)[:, k] for s in "qva" for k, j in joints}


def _build_driven(found: ExcitingMotion) -> Iterator[r.Element]:
    motion, robot = found.motion, found.model.robot
    columns = [
        r.Column("joint"), r.Column("unit", style="quiet"), r.Column("range", "number"), r.Column("limits", "number", "quiet"),
        r.Column("share of the travel", "bar", "share"), r.Column("top speed", "number"), r.Column("limit", "number", "quiet"),
        r.Column("share of the limit", "bar", "share", on=r.On.PAGE), r.Column("top acceleration", "number"),
        r.Column("reversals", "number"),
    ]  # fmt: skip
    yield r.ResultTable(columns, [_build_joint(motion, robot, k) for k in range(robot.na)], on=r.On.ALL)
    if motion.notes:
        yield r.Listing(list(motion.notes))


def _build_joint(motion: Trajectory, robot: Robot, k: int) -> r.Row:
    q, v, a = motion.q[:, k], motion.v[:, k], motion.a[:, k]
    low, high, fastest = float(robot.lower[k]), float(robot.upper[k]), float(robot.velocity_limit[k])
    room = np.isfinite(high - low) and high > low
    start, end = np.clip((np.array([q.min(), q.max()]) - low) / (high - low), 0, 1) if room else (0.0, 0.0)
    top = float(np.max(np.abs(v)))
    return r.Row([
        robot.actuated[k], robot.position_units[k],
        f"{r.format_fixed_digits(float(q.min()))} … {r.format_fixed_digits(float(q.max()))}",
        f"{r.format_limit(low)} … {r.format_limit(high)}" if room else "none", r.Bar(float(end), float(start)) if room else None,
        r.format_fixed_digits(top), r.format_limit(fastest), _share(top, fastest),
        r.format_fixed_digits(float(np.max(np.abs(a)))),
        str(int(np.sum(np.diff(np.sign(v[v != 0])) != 0))),
    ])  # fmt: skip


def _build_prediction(found: ExcitingMotion) -> Iterator[r.Element]:
    """Yield name, value, error and unit of each base parameter, and its relative error."""
    prediction = found.prediction

    def share(row: Mapping[str, Any]) -> str:
        return r.format_percent(_compute_error_percent(row)) if row["value"] else ""

    yield r.tabulate_things(
        [] if prediction is None else prediction.rows(),
        r.Column("parameter", cell=lambda row: row["expression"]),
        r.Column("assumed", "number", cell=lambda row: r.format_number(row["value"], 4)),
        r.Column("standard error", "number", cell=lambda row: r.format_number(row["stderr"], 2)),
        r.Column("unit", "unit", "quiet", cell=lambda row: r.format_unit(row["unit"])),
        r.Column("of the value", "number", cell=share),
        style="names-above",
        on=r.On.ALL,
    )
    yield r.explain("Predicted from the assumed noise. Friction of another law and tracking errors add to them.")


def _build_motion(motion: Trajectory, robot: Robot) -> Iterator[r.Element]:
    key = r.build_key(predicted="position, speed", residual="acceleration", limit="limit")
    views = [_motion_view(motion, robot, k) for k in range(robot.na)]
    yield r.TimeView("position, speed and acceleration over time", views, key)
    yield r.explain(
        f"{ZOOM}A limit is drawn where the motion comes near it. The robot file's limits are the only limits "
        "considered; check cables, tools and people before you run it."
    )


def _build_phases(motion: Trajectory, robot: Robot) -> Iterator[r.Element]:
    yield r.Figures([_draw_phase(motion, robot, k) for k in range(robot.na)])
    yield r.explain(
        "The dashed frame is the limits. Good: the curve fills the frame, with both signs of speed at every position. "
        "Friction and gravity are identified only where the motion goes. Singularities of the loops and limits of "
        "force keep it from the corners."
    )


def _draw_phase(motion: Trajectory, robot: Robot, k: int) -> r.Figure:
    """Return one joint's speed over its position, with their limits."""
    unit, fastest = robot.position_units[k], float(robot.velocity_limit[k])
    low, high = float(robot.lower[k]), float(robot.upper[k])
    step = max(1, motion.n_samples // PHASE_POINTS)
    q, v = motion.q[::step, k], motion.v[::step, k]
    corners = np.array([[low, fastest], [high, fastest], [high, -fastest], [low, -fastest]])
    frame = [r.Ring(corners, "limit")] if np.isfinite(corners).all() else []
    xlim, ylim = (r.pad_limits(c[np.isfinite(c)], x) for c, x in zip(corners.T, (q, v), strict=True))
    x, y = r.Axis(f"position [{unit}]", xlim), r.Axis(f"speed [{unit}/s]", ylim)
    return r.Figure(x, y, (*frame, r.Line(q, v, "phase")), robot.actuated[k])


def _share(value: float, limit: float) -> r.Bar | None:
    """Return the used share of a limit, or `None` without a limit."""
    return r.Bar(min(value / limit, 1.0)) if np.isfinite(limit) and limit > 0 else None


def _log_view(log: Log, robot: Robot, k: int) -> r.View:
    joint, unit, force = robot.actuated[k], robot.position_units[k], robot.force_units[k]
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    motion = [("reference", "measured", reference), ("position", "predicted", q)]
    strips = [r.build_strip(f"position [{unit}]", 230, *[r.Curve(n, i, x) for n, i, x in motion if x is not None],
                    bounds=(robot.lower[k], robot.upper[k]))]  # fmt: skip
    if reference is not None and q is not None:
        strips.append(
            r.build_strip(
                f"behind [m{unit}]", 130, r.Curve("behind by", "predicted", 1000 * (reference - q)), symmetric=True
            )
        )
    if tau is not None:
        limit = robot.effort_limit[k]
        strips.append(r.build_strip(f"force [{force}]", 210, r.Curve("force", "residual", tau), bounds=(-limit, limit)))
    return r.View(log.name, joint, log.t, tuple(strips))


def _motion_view(motion: Trajectory, robot: Robot, k: int) -> r.View:
    unit, fastest = robot.position_units[k], robot.velocity_limit[k]
    strips = (
        r.build_strip(f"position [{unit}]", 220, r.Curve("position", "predicted", motion.q[:, k]),
              bounds=(robot.lower[k], robot.upper[k])),
        r.build_strip(f"speed [{unit}/s]", 180, r.Curve("speed", "predicted", motion.v[:, k]), bounds=(-fastest, fastest)),
        r.build_strip(f"accel. [{unit}/s²]", 180, r.Curve("acceleration", "residual", motion.a[:, k])),
    )  # fmt: skip
    return r.View(motion.name, robot.actuated[k], motion.t, strips)


def _list_sensors(sensors: Sensors) -> list[tuple[str, str]]:
    """Return each sensor setting that is not ideal."""
    shown = [(f.name.replace("_", " "), getattr(sensors, f.name)) for f in fields(sensors) if f.name != "tool"]
    rows = [(name, r.format_list([r.format_number(float(x), 4) for x in np.atleast_1d(value)])) for name, value in shown
            if value is not None and np.size(value) and np.any(np.asarray(value) != 0)]  # fmt: skip
    return rows or [("sensors", "perfect")]
