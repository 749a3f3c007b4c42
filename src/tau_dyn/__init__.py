"""Identify robot dynamics from torque logs, closed loops included, name what the model leaves out, and say how far to trust it.

robot = load_robot("gantry_tau", prototype="l1")
found = identify(robot, read_log("monday.csv"), holdout=read_log("tuesday.csv"))
why = diagnose(found, holdout=read_log("tuesday.csv"))
why.extended_model.save("extended.yaml")
tau = Feedforward.load("extended.yaml")(q, v, a)
"""

# Bound here and at once, so that `tau_dyn.identify` and `tau_dyn.diagnose` are functions and never the rooms of the same names.
from tau_dyn.control import Feedforward
from tau_dyn.diagnose import diagnose
from tau_dyn.dynamics import build_mechanism
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.identify import Choices, build_regression, identify
from tau_dyn.log import Log, check_log, read_log
from tau_dyn.model import Model
from tau_dyn.modes import find_modes
from tau_dyn.report import write_report
from tau_dyn.robot import load_robot
from tau_dyn.simulate import simulate
from tau_dyn.version import __version__

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
    "check_log",
    "diagnose",
    "find_modes",
    "identify",
    "load_robot",
    "read_log",
    "simulate",
    "write_report",
]
