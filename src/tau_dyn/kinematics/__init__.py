"""The closed loops solved: actuated motion -> motion of the whole mechanism."""

from tau_dyn.kinematics.loops import LoopSolver, TreeState

__all__ = ["LoopSolver", "TreeState"]
