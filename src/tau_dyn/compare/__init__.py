"""Two models, results or runs beside each other: what changed, and whether by more than their uncertainty."""

from tau_dyn.compare.circumstances import Difference, InputChange
from tau_dyn.compare.compare import compare
from tau_dyn.compare.read import Side, read_side
from tau_dyn.compare.result import Change, Comparison, ErrorChange, FindingChange
from tau_dyn.compare.run import Run, read_run

__all__ = [
    "Change",
    "Comparison",
    "Difference",
    "ErrorChange",
    "FindingChange",
    "InputChange",
    "Run",
    "Side",
    "compare",
    "read_run",
    "read_side",
]
