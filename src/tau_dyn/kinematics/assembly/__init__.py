"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.assembly.modes import AssemblyModes, find_assembly_modes
from tau_dyn.kinematics.assembly.of_robot import RobotModes, find_robot_assembly_modes, list_robot_modes
from tau_dyn.kinematics.assembly.regions import Reach, find_reachable_modes
from tau_dyn.kinematics.assembly.states import States, solve_configuration_states

__all__ = [
    "AssemblyModes",
    "Reach",
    "RobotModes",
    "States",
    "find_assembly_modes",
    "find_reachable_modes",
    "find_robot_assembly_modes",
    "list_robot_modes",
    "solve_configuration_states",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
