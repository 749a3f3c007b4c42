"""Identify robot dynamics from torque logs, kinematic loops included; find unmodelled effects and state the uncertainty.

robot = load_robot("gantry_tau", prototype="l1")
found = identify(robot, read_log("monday.csv"), holdout=read_log("tuesday.csv"))
why = diagnose(found, holdout=read_log("tuesday.csv"))
why.extended_model.save("extended.yaml")
tau = Feedforward.load("extended.yaml")(q, v, a)
"""

from importlib import import_module

import_module("tau_dyn.early_interrupt")  # first: Ctrl-C while the command loads

from lazy_loader import attach_stub  # noqa: E402

from tau_dyn.version import __version__ as __version__  # noqa: E402

# Loading a package binds its name here, once. Deleted, the name is that of the function, which the stub gives on first use.
for _package in ("calibrate", "diagnose", "identify", "simulate"):
    import_module(f"tau_dyn.{_package}")
    del globals()[_package]

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
