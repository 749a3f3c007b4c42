"""Identify robot dynamics from torque logs, closed loops included, name what the model leaves out, and say how far to trust it.

robot = load_robot("gantry_tau", prototype="l1")
found = identify(robot, read_log("monday.csv"), holdout=read_log("tuesday.csv"))
why = diagnose(found, holdout=read_log("tuesday.csv"))
why.extended_model.save("extended.yaml")
tau = Feedforward.load("extended.yaml")(q, v, a)
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from tau_dyn.version import __version__

if TYPE_CHECKING:
    from tau_dyn.calibrate import calibrate
    from tau_dyn.control import Feedforward
    from tau_dyn.diagnose import diagnose
    from tau_dyn.dynamics import build_mechanism
    from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
    from tau_dyn.identify import Choices, build_regression, identify
    from tau_dyn.kinematics import forward_kinematics, inverse_kinematics
    from tau_dyn.log import Log, check_log, read_log
    from tau_dyn.model import Model
    from tau_dyn.modes import find_modes
    from tau_dyn.report import write_report
    from tau_dyn.robot import load_robot
    from tau_dyn.simulate import simulate

_ROOMS = {
    "CannotAnswer": "tau_dyn.exceptions",
    "Choices": "tau_dyn.identify",
    "Feedforward": "tau_dyn.control",
    "InputError": "tau_dyn.exceptions",
    "Log": "tau_dyn.log",
    "Model": "tau_dyn.model",
    "TauDynError": "tau_dyn.exceptions",
    "build_mechanism": "tau_dyn.dynamics",
    "build_regression": "tau_dyn.identify",
    "calibrate": "tau_dyn.calibrate",
    "check_log": "tau_dyn.log",
    "diagnose": "tau_dyn.diagnose",
    "find_modes": "tau_dyn.modes",
    "forward_kinematics": "tau_dyn.kinematics",
    "identify": "tau_dyn.identify",
    "inverse_kinematics": "tau_dyn.kinematics",
    "load_robot": "tau_dyn.robot",
    "read_log": "tau_dyn.log",
    "simulate": "tau_dyn.simulate",
    "write_report": "tau_dyn.report",
}
"""Where each public name lives; a room is loaded when its name is first used, so that importing takes no time."""

__all__ = [
    "CannotAnswer",
    "Choices",
    "Feedforward",
    "InputError",
    "Log",
    "Model",
    "TauDynError",
    "__version__",
    "build_mechanism",
    "build_regression",
    "calibrate",
    "check_log",
    "diagnose",
    "find_modes",
    "forward_kinematics",
    "identify",
    "inverse_kinematics",
    "load_robot",
    "read_log",
    "simulate",
    "write_report",
]


class _Face(ModuleType):
    """This module, whose functions keep their names where a room is called the same."""

    def __setattr__(self, name: str, value: object) -> None:
        """Bind a name, unless it is a room that would hide the function `tau_dyn.identify`, `tau_dyn.diagnose`, ..."""
        if not (name in _ROOMS and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'tau_dyn' has no attribute '{name}'")
    found = getattr(import_module(_ROOMS[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)


sys.modules[__name__].__class__ = _Face
