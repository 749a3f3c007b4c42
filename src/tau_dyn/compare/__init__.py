"""Two models, results or runs beside each other: what changed, and whether by more than their uncertainty."""

from tau_dyn.compare.circumstances import CircumstanceDifference, InputChange
from tau_dyn.compare.compare import compare
from tau_dyn.compare.read import ComparedSide, read_side
from tau_dyn.compare.result import Change, Comparison, ErrorChange, FindingChange
from tau_dyn.compare.run import RecordedRun, read_run
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "Change",
    "CircumstanceDifference",
    "ComparedSide",
    "Comparison",
    "ErrorChange",
    "FindingChange",
    "InputChange",
    "RecordedRun",
    "compare",
    "read_run",
    "read_side",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
