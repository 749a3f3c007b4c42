"""Which machine a robot is: rods and a plate, or a tree."""

from __future__ import annotations

from tau_dyn.kinematics.workspace.rod_machine import RodMachine
from tau_dyn.kinematics.workspace.tree_machine import TreeMachine
from tau_dyn.mechanism import NotRods, build_rods
from tau_dyn.robot import Robot


def build_machine(robot: Robot) -> RodMachine | TreeMachine:
    """Return the machine of a robot."""
    try:
        return RodMachine(build_rods(robot))
    except NotRods:
        return TreeMachine(robot)
