"""Two models or results beside each other: what changed, and whether by more than their uncertainty."""

from tau_dyn.compare.compare import Change, Comparison, FindingChange, compare
from tau_dyn.compare.read import Side, read_side

__all__ = ["Change", "Comparison", "FindingChange", "Side", "compare", "read_side"]
