"""The closed loops solved: actuated motion -> motion of the whole mechanism, poses of the tool, and back."""

from tau_dyn.kinematics.follow import Followed, follow
from tau_dyn.kinematics.forward import Forward, forward_kinematics, forward_solutions
from tau_dyn.kinematics.inverse import (
    Inverse,
    configurations,
    home_configuration,
    inverse_kinematics,
    inverse_solutions,
)
from tau_dyn.kinematics.jacobians import Singularity, acceleration_bias, inverse_jacobian, jacobian, singularity
from tau_dyn.kinematics.loops import LoopSolver, TreeState
from tau_dyn.kinematics.poses import Poses, from_quaternions, quaternions
from tau_dyn.kinematics.rods import NotRods, Rods, build_rods

__all__ = [
    "Followed",
    "Forward",
    "Inverse",
    "LoopSolver",
    "NotRods",
    "Poses",
    "Rods",
    "Singularity",
    "TreeState",
    "acceleration_bias",
    "build_rods",
    "configurations",
    "follow",
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
