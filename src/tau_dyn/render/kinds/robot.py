"""A robot, a model, and parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.render.presentation import list_assumptions, present_kind, warn
from tau_dyn.robot import Robot


@present_kind.register
def present_robot(robot: Robot) -> r.Presentation:
    """Return the presentation of a robot."""
    loops = f", {r.count(len(robot.loops), 'closed loop')}" if robot.loops else ""
    sections = [
        *warn(robot.warnings),
        r.Chapter(
            "joints",
            "Actuated joints",
            lambda: [_build_joints(robot), r.Figures([r.RobotPicture(robot)], on=r.On.NOTEBOOK)],
            r.On.ALL,
        ),
        r.Chapter("masses", "", lambda: [_build_masses(robot)], r.On.TERMINAL),
        r.Chapter("parameters", "Nominal parameters", lambda: [_build_table(robot.parameters, r.On.PAGE)]),
        *list_assumptions(robot.assumed),
    ]
    return r.Presentation(
        "Robot", robot.name, f"{robot.name}: robot", f"{robot.name}: {r.count(robot.na, 'actuated joint')}{loops}.", None,
        f"{'file' if robot.sha256 else 'robot'} {robot.source}", sections, robot.warnings, r.RobotPicture(robot),
        r.Provenance(robot=robot),
        lambda: _tabulate_joints(robot), robot,
    )  # fmt: skip


def _tabulate_joints(robot: Robot) -> list[dict[str, Any]]:
    """Return one row per actuated joint, with its limits."""
    names = ("joint", "kind", "position_unit", "lower", "upper", "velocity_limit", "effort_limit", "force_unit")
    rows = zip(
        robot.actuated, robot.joint_kinds, robot.position_units, robot.lower, robot.upper, robot.velocity_limit,
        robot.effort_limit, robot.force_units, strict=True,
    )  # fmt: skip
    return [dict(zip(names, row, strict=True)) for row in rows]


def _build_joints(robot: Robot) -> r.ResultTable:
    return r.tabulate_things(
        _tabulate_joints(robot),
        r.Column("actuated joint", cell=lambda row: row["joint"]),
        r.Column(cell=lambda row: row["kind"]),
        r.Column("travel", cell=lambda row: f"{_limit(row['lower'])} … {_limit(row['upper'])} {row['position_unit']}"),
        r.Column("speed limit", cell=lambda row: _format_bound(row["velocity_limit"], f"{row['position_unit']}/s")),
        r.Column("force limit", cell=lambda row: _format_bound(row["effort_limit"], row["force_unit"])),
        on=r.On.ALL,
    )


def _build_masses(robot: Robot) -> r.ResultTable:
    """Return the nominal mass of each body that moves."""
    rows = [
        r.Row([p.name.removesuffix(".mass"), f"{r.format_number(p.value)} {p.unit}"])
        for p in robot.parameters
        if p.name.endswith(".mass")
    ]
    return r.ResultTable([r.Column("body"), r.Column("mass", "number")], rows, on=r.On.TERMINAL)


def _limit(x: float) -> str:
    return r.format_number(x, 3) if np.isfinite(x) else "no limit"


def _format_bound(x: float, unit: str) -> str:
    return f"{r.format_number(x, 3)} {unit}" if np.isfinite(x) else ""


@present_kind.register
def present_model(model: Model) -> r.Presentation:
    """Return the presentation of a model: its parameters, and the forces in addition to the rigid body."""
    robot, equations = model.robot, list(dict.fromkeys(f"{e.name}: {e.equation}" for e in model.effects))
    beyond = r.Chapter("effects", "Forces beyond the rigid body", lambda: [r.Listing(equations, style="code")])
    sections = [
        r.Chapter("parameters", "Parameters", lambda: [_build_table(model.parameters, r.On.ALL)], r.On.ALL),
        *([beyond] if equations else []),
    ]
    effects = (
        f"beyond the rigid body: {r.format_list(dict.fromkeys(e.name for e in model.effects))}" if equations else ""
    )
    facts = [(str(key), str(value)) for key, value in model.provenance.items() if not isinstance(value, list | Mapping)]
    return r.Presentation(
        "Model", f"{robot.name}, {_count(model.parameters)}", f"{robot.name}: model", "", None, effects, sections, (),
        r.RobotPicture(robot),
        r.Provenance(facts, robot=robot), lambda: _tabulate(model.parameters), model, equations,
    )  # fmt: skip


@present_kind.register
def present_parameters(parameters: Parameters) -> r.Presentation:
    """Return the presentation of parameters."""
    sections = [r.Chapter("parameters", "Parameters", lambda: [_build_table(parameters, r.On.ALL)], r.On.ALL)]
    return r.Presentation(
        "Parameters",
        _count(parameters),
        "parameters",
        sections=sections,
        data=lambda: _tabulate(parameters),
        result=parameters,
    )


def _count(parameters: Parameters) -> str:
    return f"{r.count(len(parameters), 'parameter')}, {sum(p.free for p in parameters)} of them free"


def _tabulate(parameters: Parameters) -> Any:
    """Return one row per parameter."""
    import pandas as pd

    keys = ("name", "value", "unit", "stderr", "lower", "upper", "free", "origin")
    rows = [{k: getattr(p, k) for k in keys} for p in parameters]
    return pd.DataFrame(rows, columns=list(keys)).astype({"stderr": float})


def _build_table(parameters: Parameters, on: r.On) -> r.ResultTable:
    """Return one row per parameter, with intervals only if there are any."""
    estimated = any(p.stderr for p in parameters)
    between = r.Column("95 % interval", "number", spare=True, cell=r.format_estimate_interval)
    return r.tabulate_things(
        parameters,
        r.Column("parameter", cell=lambda p: p.name),
        r.Column("value", "number", "strong", cell=r.format_estimate),
        *([between] if estimated else []),
        r.Column("from", cell=lambda p: p.origin),
        state=lambda p: "" if p.free else "quiet",
        on=on,
    )
