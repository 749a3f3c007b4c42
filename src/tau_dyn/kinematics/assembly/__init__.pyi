"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from .modes import AssemblyModes as AssemblyModes, find_assembly_modes as find_assembly_modes
from .of_robot import (
    RobotModes as RobotModes,
    find_robot_assembly_modes as find_robot_assembly_modes,
    list_robot_modes as list_robot_modes,
)
from .regions import Reach as Reach, find_reachable_modes as find_reachable_modes
from .states import States as States, solve_configuration_states as solve_configuration_states
