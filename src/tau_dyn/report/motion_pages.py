"""The pages of `tau-dyn simulate` (the log that it made) and `tau-dyn excite` (the motion, against the robot's limits)."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.excitation import InformationPrediction
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.report.fit_quality_text import FAIR, WELL, describe_separation
from tau_dyn.report.formatting import (
    Level,
    count,
    format_fixed_digits,
    format_limit,
    format_list,
    format_number,
    format_percent,
    format_unit,
)
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.svg import THIRD, Chart, format_tag, pad_limits
from tau_dyn.report.time_view import Curve, View, strip
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors, Trajectory

FORCE_NEAR = 0.999
"""Share of a force limit at which a drive counts as saturated."""
PHASE_POINTS = 1500  # points of a phase plot at most


def build_simulation_page(
    log: Log, model: Model, *, sensors: Sensors | None = None, command_line: str = "", **made: str
) -> str:
    """Return a simulated log as one HTML page.

    Args:
        log: What `simulate` returned.
        model: The simulated robot, whose values are the truth.
        sensors: Its sensors, to be listed.
        command_line: The command that repeats it, for the provenance.
        made: What else the provenance says, such as `motion="fourier"` or `seed="0"`.
    """
    robot = model.robot
    rows = [_followed(log, robot, k) for k in range(robot.na)]
    return render_page(
        "simulation.html.j2",
        f"{log.name}: simulated",
        _simulated(log, robot, rows),
        [_log_view(log, robot, k) for k in range(robot.na)],
        robot=robot,
        provenance=dict(made),
        command_line=command_line,
        name=log.name,
        rows=rows,
        notes=log.warnings,
        changed=_true_values(model),
        equations=list(dict.fromkeys(effect.equation for effect in model.effects)),
        sensors=[] if sensors is None else _sensor_rows(sensors),
    )


def build_excitation_page(
    motion: Trajectory,
    model: Model,
    condition: float,
    *,
    prediction: InformationPrediction | None = None,
    command_line: str = "",
    **made: str,
) -> str:
    """Return an exciting motion as one HTML page.

    Args:
        motion: The motion.
        model: Robot and what shall be identified.
        condition: `compute_base_condition` of both.
        prediction: The standard errors that it will give, to be listed.
        command_line: The command that repeats it, for the provenance.
        made: What else the provenance says, such as `trials="20"` or `seed="0"`.
    """
    robot = model.robot
    level: Level = "good" if condition < WELL else "care" if condition < FAIR else "poor"
    badge = {"good": "Tells them apart", "care": "Usable", "poor": "Too poor"}[level]
    free = int(np.sum(model.parameters.free))
    opening = PageHeader(
        f"A motion of {format_number(motion.duration, 4)} s with condition number {format_number(condition, 3)}.",
        level,
        badge,
        f"{describe_separation(condition).capitalize()}.",
        f"{count(robot.na, 'joint')}: {format_list(robot.actuated)}; {count(free, 'free parameter')}; "
        f"condition numbers below {WELL:g} are good, above {FAIR:g} poor.",
    )
    return render_page(
        "excitation.html.j2",
        f"{robot.name}: exciting motion",
        opening,
        [_motion_view(motion, robot, k) for k in range(robot.na)],
        robot=robot,
        provenance=dict(made),
        command_line=command_line,
        rows=[_driven(motion, robot, k) for k in range(robot.na)],
        phases=[_phase_chart(motion, robot, k) for k in range(robot.na)],
        predicted=[] if prediction is None else _predicted(prediction),
        notes=motion.notes,
    )


def _predicted(prediction: InformationPrediction) -> list[dict[str, Any]]:
    """Return name, value, error and unit of each base parameter, and the error as a share of the value."""
    return [
        {
            "name": row["expression"],
            "value": format_number(row["value"], 4),
            "stderr": format_number(row["stderr"], 2),
            "unit": format_unit(row["unit"]),
            "share": format_percent(100 * row["stderr"] / abs(row["value"])) if row["value"] else "",
        }
        for row in prediction.rows()
    ]


def _simulated(log: Log, robot: Robot, rows: list[dict[str, Any]]) -> PageHeader:
    text = f"{format_number(log.duration, 4)} s of simulated {robot.name} at {format_number(log.rate_hz, 4)} Hz"
    saturated = [r["joint"] for r in rows if r["saturated"]]
    errors = [r["error_share"] for r in rows if r["error_share"] is not None]
    follows = (
        f"; it follows its reference to {format_percent(100 * max(errors))} of each joint's travel" if errors else ""
    )
    if saturated:
        said = f"The force of {format_list(saturated)} reached its limit; identification leaves these samples out."
        return PageHeader(f"{text}{follows}.", "care", "Saturated", said, _made_of(log, robot))
    said = f"{count(len(log.warnings), 'note')} below." if log.warnings else "No drive reached its limit of force."
    return PageHeader(f"{text}{follows}.", "care" if log.warnings else "good", "Made, with notes" if log.warnings else "Made",
                   said, _made_of(log, robot))  # fmt: skip


def _made_of(log: Log, robot: Robot) -> str:
    samples = f"{log.n_samples:,}".replace(",", " ")
    return f"{log.name}: {samples} samples of {format_list(robot.actuated)}, read through the sensors below. Not a recording."


def _log_view(log: Log, robot: Robot, k: int) -> View:
    joint, unit, force = robot.actuated[k], robot.position_units[k], robot.force_units[k]
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    motion = [("reference", "measured", reference), ("position", "predicted", q)]
    strips = [strip(f"position [{unit}]", 230, *[Curve(n, i, x) for n, i, x in motion if x is not None],
                    bounds=(robot.lower[k], robot.upper[k]))]  # fmt: skip
    if reference is not None and q is not None:
        strips.append(
            strip(f"behind [m{unit}]", 130, Curve("behind by", "predicted", 1000 * (reference - q)), symmetric=True)
        )
    if tau is not None:
        limit = robot.effort_limit[k]
        strips.append(strip(f"force [{force}]", 210, Curve("force", "residual", tau), bounds=(-limit, limit)))
    return View(log.name, joint, log.t, tuple(strips))


def _motion_view(motion: Trajectory, robot: Robot, k: int) -> View:
    unit, fastest = robot.position_units[k], robot.velocity_limit[k]
    strips = (
        strip(f"position [{unit}]", 220, Curve("position", "predicted", motion.q[:, k]),
              bounds=(robot.lower[k], robot.upper[k])),
        strip(f"speed [{unit}/s]", 180, Curve("speed", "predicted", motion.v[:, k]), bounds=(-fastest, fastest)),
        strip(f"accel. [{unit}/s²]", 180, Curve("acceleration", "residual", motion.a[:, k])),
    )  # fmt: skip
    return View(motion.name, robot.actuated[k], motion.t, strips)


def _followed(log: Log, robot: Robot, k: int) -> dict[str, Any]:
    joint, limit = robot.actuated[k], float(robot.effort_limit[k])
    q, tau, reference = (log.channels.get(f"{s}_{joint}") for s in ("q", "tau", "q_ref"))
    row: dict[str, Any] = {"joint": joint, "unit": robot.position_units[k], "force_unit": robot.force_units[k],
                           "saturated": False, "error_share": None}  # fmt: skip
    if q is not None:
        row["range"] = f"{format_fixed_digits(float(q.min()))} … {format_fixed_digits(float(q.max()))}"
    if q is not None and reference is not None:
        behind, travel = reference - q, float(np.ptp(reference))
        row["error"] = [
            format_fixed_digits(1000 * float(x)) for x in (np.sqrt(np.mean(behind**2)), np.max(np.abs(behind)))
        ]
        row["error_share"] = float(np.max(np.abs(behind))) / travel if travel > 0 else None
    if tau is not None:
        peak = float(np.max(np.abs(tau)))
        row |= {
            "force": [format_number(float(np.sqrt(np.mean(tau**2))), 3), format_number(peak, 3)],
            "limit": format_limit(limit),
        }
        row |= {"used": _share(peak, limit), "saturated": bool(peak >= FORCE_NEAR * limit)}
    return row


def _driven(motion: Trajectory, robot: Robot, k: int) -> dict[str, Any]:
    q, v, a = motion.q[:, k], motion.v[:, k], motion.a[:, k]
    low, high, fastest = float(robot.lower[k]), float(robot.upper[k]), float(robot.velocity_limit[k])
    room = np.isfinite(high - low) and high > low
    left = 100 * np.clip((np.array([q.min(), q.max()]) - low) / (high - low), 0, 1) if room else None
    return {
        "joint": robot.actuated[k],
        "unit": robot.position_units[k],
        "range": f"{format_fixed_digits(float(q.min()))} … {format_fixed_digits(float(q.max()))}",
        "limits": f"{format_limit(low)} … {format_limit(high)}" if room else "none",
        "from": None if left is None else float(left[0]),
        "width": 0.0 if left is None else float(left[1] - left[0]),
        "speed": format_fixed_digits(float(np.max(np.abs(v)))),
        "speed_limit": format_limit(fastest),
        "speed_share": _share(float(np.max(np.abs(v))), fastest),
        "acceleration": format_fixed_digits(float(np.max(np.abs(a)))),
        "reversals": str(int(np.sum(np.diff(np.sign(v[v != 0])) != 0))),
    }


def _share(value: float, limit: float) -> float | None:
    """Return how much of a limit is used [%]; None where there is none."""
    return 100 * min(value / limit, 1.0) if np.isfinite(limit) and limit > 0 else None


def _phase_chart(motion: Trajectory, robot: Robot, k: int) -> Markup:
    """Return one joint's speed over its position: what the motion visits of what it may."""
    unit, fastest = robot.position_units[k], float(robot.velocity_limit[k])
    low, high = float(robot.lower[k]), float(robot.upper[k])
    step = max(1, motion.n_samples // PHASE_POINTS)
    q, v = motion.q[::step, k], motion.v[::step, k]
    xlim = pad_limits(np.array([x for x in (low, high) if np.isfinite(x)]), q)
    ylim = pad_limits(np.array([x for x in (-fastest, fastest) if np.isfinite(x)]), v)
    chart = Chart(THIRD, 240, xlim, ylim, robot.actuated[k], f"position [{unit}]", f"speed [{unit}/s]")
    frame = Markup("")
    if np.all(np.isfinite([low, high, fastest])):
        (x0, x1), (y0, y1) = chart.x(np.array([low, high])), chart.y(np.array([fastest, -fastest]))
        frame = format_tag("path", d=f"M{x0:.1f} {y0:.1f}H{x1:.1f}V{y1:.1f}H{x0:.1f}Z", class_="limit")
    return chart.render(frame, chart.line(q, v, "phase"))


def _true_values(model: Model) -> list[tuple[str, str, str]]:
    """Return name, value and unit of every parameter of the simulated robot that is not zero."""
    return [(p.name, format_number(p.value, 5), format_unit(p.unit)) for p in model.parameters if p.value != 0.0]


def _sensor_rows(sensors: Sensors) -> list[tuple[str, str]]:
    """Return each sensor setting that is not perfect."""
    shown = [(f.name.replace("_", " "), getattr(sensors, f.name)) for f in fields(sensors) if f.name != "tool"]
    rows = [(name, format_list([format_number(float(x), 4) for x in np.atleast_1d(value)])) for name, value in shown
            if value is not None and np.size(value) and np.any(np.asarray(value) != 0)]  # fmt: skip
    return rows or [("sensors", "perfect")]
