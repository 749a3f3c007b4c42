"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from .modes import AssemblyModes as AssemblyModes, find_assembly_modes as find_assembly_modes
from .motion import (
    Reach as Reach,
    States as States,
    find_reachable_modes as find_reachable_modes,
    solve_configuration_states as solve_configuration_states,
)
from .robot_modes import (
    RobotModes as RobotModes,
    find_robot_assembly_modes as find_robot_assembly_modes,
    list_robot_modes as list_robot_modes,
)
