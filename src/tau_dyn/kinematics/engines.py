"""Which solver suits a robot: a sliding or free plate on rods, or the tree with its loops. Solvers live as long as robots."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from tau_dyn.kinematics.free_plate import FreePlate
from tau_dyn.kinematics.rods import NotRods, Rods, build_rods
from tau_dyn.kinematics.sliding_plate import SlidingPlate
from tau_dyn.kinematics.tree_pose import TreePose
from tau_dyn.robot import Robot

Engine = SlidingPlate | FreePlate | TreePose

_OF_ROBOT: WeakKeyDictionary[Robot, Rods | TreePose] = WeakKeyDictionary()
_OF_RODS: WeakKeyDictionary[Rods, SlidingPlate | FreePlate] = WeakKeyDictionary()


def rods_of(robot: Robot | Rods) -> Rods | None:
    """Return a robot's rods, or None for a robot of another kind."""
    if isinstance(robot, Rods):
        return robot
    known = _known(robot)
    return known if isinstance(known, Rods) else None


def engine_of(robot: Robot | Rods) -> Engine:
    """Return the solver of a robot.

    Raises:
        LoopClosureError: Its loops cannot be closed at home.
    """
    known = robot if isinstance(robot, Rods) else _known(robot)
    if isinstance(known, TreePose):
        return known
    if known not in _OF_RODS:
        _OF_RODS[known] = SlidingPlate(known) if known.translates else FreePlate(known)
    return _OF_RODS[known]


def robot_of(robot: Robot | Rods) -> Robot:
    """Return the robot itself."""
    return robot.robot if isinstance(robot, Rods) else robot


def _known(robot: Robot) -> Rods | TreePose:
    if robot not in _OF_ROBOT:
        try:
            _OF_ROBOT[robot] = build_rods(robot)
        except NotRods:
            _OF_ROBOT[robot] = TreePose(robot)
    return _OF_ROBOT[robot]
