"""Robots: from a xacro file to a tree with loops, actuated joints and nominal parameters."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.robot.annotations import Spring
from tau_dyn.robot.expand import describe_robot, list_robot_names, list_robots, list_stock_robots
from tau_dyn.robot.load import load_robot, load_robot_from_urdf
from tau_dyn.robot.robot import INERTIAL, NOT_GIVEN, LinkInertia, Loop, Robot

__all__ = [
    "INERTIAL",
    "NOT_GIVEN",
    "LinkInertia",
    "Loop",
    "Robot",
    "Spring",
    "describe_robot",
    "list_robot_names",
    "list_robots",
    "list_stock_robots",
    "load_robot",
    "load_robot_from_urdf",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
