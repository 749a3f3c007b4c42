"""Calls that said in two arguments what one result says now; each warns. The other former names are those of `render`."""

from __future__ import annotations

from typing import Any
from warnings import warn

from rich.console import Console

from tau_dyn.excitation import InformationPrediction
from tau_dyn.log import Log, LogCheck
from tau_dyn.model import Model
from tau_dyn.render import ExcitingMotion, SimulatedLog, build_page, print_result
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors, Trajectory


def check_page(log: Log, checked: LogCheck, *, robot: Robot | None = None, command_line: str = "") -> str:
    """Return the check of a log as one HTML page."""
    _warn("build_page(checked, log=log)")
    return build_page(checked, command_line=command_line, log=log, robot=robot)


def print_check(console: Console, log: Log, checked: LogCheck) -> None:
    """Print the check of a log for a person."""
    _warn("print_result(console, checked, log=log)")
    print_result(console, checked, log=log)


def build_simulation_page(
    log: Log, model: Model, *, sensors: Sensors | None = None, command_line: str = "", **made: str
) -> str:
    """Return a simulated log as one HTML page."""
    _warn("build_page(SimulatedLog(log, model, sensors))")
    return build_page(SimulatedLog(log, model, sensors, made), command_line=command_line)


def build_excitation_page(
    motion: Trajectory,
    model: Model,
    condition: float,
    *,
    prediction: InformationPrediction | None = None,
    command_line: str = "",
    **made: str,
) -> str:
    """Return an exciting motion as one HTML page."""
    _warn("build_page(ExcitingMotion(motion, model, condition))")
    return build_page(ExcitingMotion(motion, model, condition, prediction, made), command_line=command_line)


def _warn(instead: str) -> Any:
    warn(f"tau_dyn.report is deprecated; write tau_dyn.render.{instead}", DeprecationWarning, stacklevel=3)
