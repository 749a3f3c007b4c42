"""A robot, a model, and parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.render.presentation import list_assumptions, present_kind, warn
from tau_dyn.results import (
    Chapter,
    Column,
    Figures,
    Listing,
    On,
    Presentation,
    Provenance,
    ResultTable,
    RobotPicture,
    Row,
    count,
    format_estimate,
    format_estimate_interval,
    format_number,
)
from tau_dyn.robot import Robot


@present_kind.register
def present_robot(robot: Robot) -> Presentation:
    """Return how a robot is presented."""
    loops = f", {count(len(robot.loops), 'closed loop')}" if robot.loops else ""
    sections = [
        *warn(robot.warnings),
        Chapter(
            "joints",
            "Actuated joints",
            lambda: [_build_joints(robot), Figures([RobotPicture(robot)], on=On.NOTEBOOK)],
            On.ALL,
        ),
        Chapter("parameters", "Nominal parameters", lambda: [_build_table(robot.parameters, On.PAGE)]),
        *list_assumptions(robot.assumed),
    ]
    return Presentation(
        "Robot", robot.name, f"{robot.name}: robot", f"{robot.name}: {count(robot.na, 'actuated joint')}{loops}.", None,
        f"{'file' if robot.sha256 else 'robot'} {robot.source}", sections, robot.warnings, RobotPicture(robot),
        Provenance(robot=robot),
        lambda: _tabulate_joints(robot), robot,
    )  # fmt: skip


def _tabulate_joints(robot: Robot) -> list[dict[str, Any]]:
    """Return one row an actuated joint, with its limits."""
    names = ("joint", "kind", "position_unit", "lower", "upper", "velocity_limit", "effort_limit", "force_unit")
    rows = zip(
        robot.actuated, robot.joint_kinds, robot.position_units, robot.lower, robot.upper, robot.velocity_limit,
        robot.effort_limit, robot.force_units, strict=True,
    )  # fmt: skip
    return [dict(zip(names, row, strict=True)) for row in rows]


def _build_joints(robot: Robot) -> ResultTable:
    columns = [Column("actuated joint"), Column(), Column("travel"), Column("speed"), Column("force")]
    rows = [
        Row([r["joint"], r["kind"], f"{_limit(r['lower'])} … {_limit(r['upper'])} {r['position_unit']}",
             _up_to(r["velocity_limit"], f"{r['position_unit']}/s"), _up_to(r["effort_limit"], r["force_unit"])])
        for r in _tabulate_joints(robot)
    ]  # fmt: skip
    return ResultTable(columns, rows, on=On.ALL)


def _limit(x: float) -> str:
    return format_number(x, 3) if np.isfinite(x) else "no limit"


def _up_to(x: float, unit: str) -> str:
    return f"up to {format_number(x, 3)} {unit}" if np.isfinite(x) else ""


@present_kind.register
def present_model(model: Model) -> Presentation:
    """Return how a model is presented: its parameters, and the forces beyond the rigid body."""
    robot, equations = model.robot, list(dict.fromkeys(f"{e.name}: {e.equation}" for e in model.effects))
    beyond = Chapter("effects", "Forces beyond the rigid body", lambda: [Listing(equations, style="code")])
    sections = [
        Chapter("parameters", "Parameters", lambda: [_build_table(model.parameters, On.ALL)], On.ALL),
        *([beyond] if equations else []),
    ]
    facts = [(str(key), str(value)) for key, value in model.provenance.items() if not isinstance(value, list | Mapping)]
    return Presentation(
        "Model", f"{robot.name}, {_count(model.parameters)}", f"{robot.name}: model", "", None, "", sections, (),
        RobotPicture(robot),
        Provenance(facts, robot=robot), lambda: _tabulate(model.parameters), model, equations,
    )  # fmt: skip


@present_kind.register
def present_parameters(parameters: Parameters) -> Presentation:
    """Return how parameters are presented."""
    sections = [Chapter("parameters", "Parameters", lambda: [_build_table(parameters, On.ALL)], On.ALL)]
    return Presentation(
        "Parameters",
        _count(parameters),
        "parameters",
        sections=sections,
        data=lambda: _tabulate(parameters),
        result=parameters,
    )


def _count(parameters: Parameters) -> str:
    return f"{count(len(parameters), 'parameter')}, {sum(p.free for p in parameters)} of them free"


def _tabulate(parameters: Parameters) -> Any:
    """Return one row a parameter."""
    import pandas as pd

    keys = ("name", "value", "unit", "stderr", "lower", "upper", "free", "origin")
    rows = [{k: getattr(p, k) for k in keys} for p in parameters]
    return pd.DataFrame(rows, columns=list(keys)).astype({"stderr": float})


def _build_table(parameters: Parameters, on: On) -> ResultTable:
    """Return one row a parameter; intervals only where there are some."""
    estimated = any(p.stderr for p in parameters)
    between = [Column("95 % interval", "number", spare=True)] if estimated else []
    rows = [
        Row(
            [p.name, format_estimate(p), *([format_estimate_interval(p)] if estimated else []), p.origin],
            "" if p.free else "quiet",
        )
        for p in parameters
    ]
    return ResultTable(
        [Column("parameter"), Column("value", "number", "strong"), *between, Column("from")], rows, on=on
    )
