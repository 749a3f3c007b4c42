"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from tau_dyn.kinematics.assembly.modes import AssemblyModes, assembly_modes
from tau_dyn.kinematics.assembly.of_robot import assembly_modes_of
from tau_dyn.kinematics.assembly.regions import Reach, reachable_modes
from tau_dyn.kinematics.assembly.states import States, configuration_states

__all__ = [
    "AssemblyModes",
    "Reach",
    "States",
    "assembly_modes",
    "assembly_modes_of",
    "configuration_states",
    "reachable_modes",
]
