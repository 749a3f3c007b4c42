"""The closed loops solved: actuated motion -> motion of the whole mechanism, poses of the tool, and back."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.forward import ForwardResult, forward_kinematics, solve_both_forward
from tau_dyn.kinematics.inverse import (
    InverseResult,
    get_home_configuration,
    inverse_kinematics,
    list_configurations,
    solve_all_configurations,
)
from tau_dyn.kinematics.jacobians import (
    Singularity,
    compute_acceleration_bias,
    compute_inverse_jacobian,
    jacobian,
    measure_singularity,
)
from tau_dyn.kinematics.loops import LoopSolver, TreeState
from tau_dyn.kinematics.path_following import FollowedPath, follow_path
from tau_dyn.kinematics.poses import Poses, convert_from_quaternions, convert_to_quaternions
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
    "build_rods",
    "compute_acceleration_bias",
    "compute_inverse_jacobian",
    "convert_from_quaternions",
    "convert_to_quaternions",
    "follow_path",
    "forward_kinematics",
    "get_home_configuration",
    "inverse_kinematics",
    "jacobian",
    "list_configurations",
    "measure_singularity",
    "solve_all_configurations",
    "solve_both_forward",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
