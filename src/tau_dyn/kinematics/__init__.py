"""The closed loops solved: actuated motion -> motion of the whole mechanism, poses of the tool, and back."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.forward import ForwardResult, forward_kinematics, forward_solutions
from tau_dyn.kinematics.inverse import (
    InverseResult,
    configurations,
    home_configuration,
    inverse_kinematics,
    inverse_solutions,
)
from tau_dyn.kinematics.jacobians import Singularity, acceleration_bias, inverse_jacobian, jacobian, singularity
from tau_dyn.kinematics.loops import LoopSolver, TreeState
from tau_dyn.kinematics.path_following import FollowedPath, follow_path
from tau_dyn.kinematics.poses import Poses, from_quaternions, quaternions
from tau_dyn.kinematics.rods import NotRods, Rods, build_rods

__all__ = [
    "FollowedPath",
    "ForwardResult",
    "InverseResult",
    "LoopSolver",
    "NotRods",
    "Poses",
    "Rods",
    "Singularity",
    "TreeState",
    "acceleration_bias",
    "build_rods",
    "configurations",
    "follow_path",
    "forward_kinematics",
    "forward_solutions",
    "from_quaternions",
    "home_configuration",
    "inverse_jacobian",
    "inverse_kinematics",
    "inverse_solutions",
    "jacobian",
    "quaternions",
    "singularity",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
