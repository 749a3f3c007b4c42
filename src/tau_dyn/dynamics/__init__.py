"""Rigid-body dynamics in actuated coordinates: forces, regressor with named columns, mass matrix."""

from tau_dyn.dynamics.gantry_tau import GantryTauMechanism
from tau_dyn.dynamics.mechanism import SINGULAR, Mechanism
from tau_dyn.dynamics.tree import TreeMechanism
from tau_dyn.robot import Robot


def build_mechanism(robot: Robot) -> Mechanism:
    """Return the fastest exact dynamics for a robot: the closed form where its file declares one, else Pinocchio."""
    tied = all(len(link.own) == 1 for link in robot.links)
    return GantryTauMechanism(robot) if robot.arms and tied else TreeMechanism(robot)


__all__ = ["SINGULAR", "GantryTauMechanism", "Mechanism", "TreeMechanism", "build_mechanism"]
