"""Which solver suits a robot: a sliding or free plate on rods, or the tree with its loops. Solvers live as long as robots."""

from __future__ import annotations

from tau_dyn.mechanism.free_plate import FreePlate
from tau_dyn.mechanism.rods import NotRods, Rods, build_rods
from tau_dyn.mechanism.sliding_plate import SlidingPlate
from tau_dyn.mechanism.solver_cache import get_cached
from tau_dyn.mechanism.tree_pose import TreePose
from tau_dyn.robot import Robot

Engine = SlidingPlate | FreePlate | TreePose


def get_rods(robot: Robot | Rods) -> Rods | None:
    """Return a robot's rods, or None for a robot of another kind."""
    if isinstance(robot, Rods):
        return robot
    known = _known(robot)
    return known if isinstance(known, Rods) else None


def get_solver(robot: Robot | Rods) -> Engine:
    """Return the solver of a robot.

    Raises:
        LoopClosureError: Its loops cannot be closed at home.
    """
    known = robot if isinstance(robot, Rods) else _known(robot)
    if isinstance(known, TreePose):
        return known
    return get_cached(known, "engine", lambda: SlidingPlate(known) if known.translates else FreePlate(known))


def get_robot(robot: Robot | Rods) -> Robot:
    """Return the robot itself."""
    return robot.robot if isinstance(robot, Rods) else robot


def _known(robot: Robot) -> Rods | TreePose:
    return get_cached(robot, "rods or tree", lambda: _built(robot))


def _built(robot: Robot) -> Rods | TreePose:
    try:
        return build_rods(robot)
    except NotRods:
        return TreePose(robot)
