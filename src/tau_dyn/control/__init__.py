"""Feedforward for a controller: in Python, or written out as C or Python of its own."""

from tau_dyn.control.export_c import c_source
from tau_dyn.control.export_model import Program, build_program
from tau_dyn.control.export_python import python_source
from tau_dyn.control.feedforward import Feedforward

__all__ = ["Feedforward", "Program", "build_program", "c_source", "python_source"]
