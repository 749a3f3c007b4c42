"""Which implementation of `Mechanism` suits a robot: the closed form where it holds, else the tree."""

import numpy as np

from tau_dyn.mechanism.gantry_tau import GantryTauMechanism
from tau_dyn.mechanism.mechanism import Mechanism
from tau_dyn.mechanism.tree import TreeMechanism
from tau_dyn.robot import Robot


def build_mechanism(robot: Robot) -> Mechanism:
    """Return the fastest exact dynamics for a robot: the closed form where its file declares one that holds, else Pinocchio.

    It holds where rods are slender, sit on the carts' origins and follow their masses; one sample near home shows it. Dynamics
    remember the last closure, so every call makes its own; its kinematics are kept beside the robot (`build_kinematics`).
    """
    mechanism: Mechanism = TreeMechanism(robot)
    if GantryTauMechanism.describes(robot):
        closed = GantryTauMechanism(robot)
        sample = robot.home[None] + 0.01, np.array([[0.3, -0.2, 0.1]]), np.array([[1.0, -1.0, 0.5]])
        Y = mechanism.regressor(*sample)
        same_forces = np.abs(closed.regressor(*sample) - Y).max() < 1e-7 * np.abs(Y).max()
        same_tool = np.abs(closed.tool_position(sample[0]) - mechanism.tool_position(sample[0])).max() < 1e-9
        mechanism = closed if same_forces and same_tool else mechanism
    return mechanism
