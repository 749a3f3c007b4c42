"""The kinematics of a robot, a plate on legs or a tree, and the face's functions, each of which asks them.

A robot stands for its kinematics at its file's dimensions; kinematics themselves, perhaps at other dimensions, are taken as
they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.cache import get_cached
from tau_dyn.mechanism.kinematics import Kinematics, Singularity
from tau_dyn.mechanism.kinematics_result import ForwardResult, InverseResult, InverseSolutions
from tau_dyn.mechanism.plate_on_legs import PlateOnLegs, build_rods
from tau_dyn.mechanism.poses import Poses
from tau_dyn.mechanism.recognise import NotRods
from tau_dyn.mechanism.tree_kinematics import TreeKinematics
from tau_dyn.robot import Robot


def build_kinematics(robot: Robot | Kinematics) -> Kinematics:
    """Return a robot's kinematics: a plate on legs where it has one, else its tree. They are kept beside the robot.

    Raises:
        InputError: A tree without a tool frame, or with a joint of several freedoms.
        LoopClosureError: The loops cannot be closed at home.
    """
    return get_cached(robot, "kinematics", lambda: _build(robot)) if isinstance(robot, Robot) else robot


def _build(robot: Robot) -> Kinematics:
    try:
        return build_rods(robot)
    except NotRods:
        return TreeKinematics(robot)


def get_robot(robot: Robot | Kinematics) -> Robot:
    """Return the robot itself."""
    return robot if isinstance(robot, Robot) else robot.robot


def get_rods(robot: Robot | Kinematics) -> PlateOnLegs | None:
    """Return a robot's plate on legs, or None for a robot of another kind."""
    return build_kinematics(robot).legs  # type: ignore[return-value]


def get_solver(robot: Robot | Kinematics) -> object:
    """Return what solves a robot's forward kinematics.

    Raises:
        LoopClosureError: Its loops cannot be closed at home.
    """
    return build_kinematics(robot).engine  # type: ignore[attr-defined]


def forward_kinematics(robot: Robot | Kinematics, q: np.ndarray, *, start: Poses | None = None) -> ForwardResult:
    """Return where the tool is at actuated positions; see `Kinematics.forward`."""
    return build_kinematics(robot).forward(q, start=start)


def solve_both_forward(robot: Robot | Kinematics, q: np.ndarray) -> np.ndarray:
    """Return both tool positions (N, 2, 3) [m] of a translating plate; see `Kinematics.both_forward`."""
    return build_kinematics(robot).both_forward(q)


def inverse_kinematics(
    robot: Robot | Kinematics,
    poses: Poses,
    *,
    configuration: Sequence[int] | np.ndarray | None = None,
    start: np.ndarray | None = None,
    limits: bool = True,
) -> InverseResult:
    """Return the actuated positions that put the tool at poses; see `Kinematics.inverse`."""
    return build_kinematics(robot).inverse(poses, configuration=configuration, start=start, limits=limits)


def find_all_solutions(robot: Robot | Kinematics, poses: Poses) -> InverseSolutions:
    """Return all positions that put the tool at poses, and whether they are proved to be all; see `Kinematics.solutions`."""
    return build_kinematics(robot).solutions(poses)


def solve_all_configurations(robot: Robot | Kinematics, poses: Poses) -> np.ndarray:
    """Return the positions of all configurations (N, n_configurations, na); see `Kinematics.solutions`."""
    return build_kinematics(robot).solutions(poses).q


def list_configurations(robot: Robot | Kinematics) -> np.ndarray:
    """Return the configurations by name (n, chains); see `Kinematics.configurations`."""
    return build_kinematics(robot).configurations


def get_home_configuration(robot: Robot | Kinematics) -> np.ndarray:
    """Return home's configuration (chains,)."""
    return build_kinematics(robot).home_configuration


def find_nearest_configuration(robot: Robot | Kinematics, poses: Poses, q: np.ndarray) -> np.ndarray:
    """Return the configuration (chains,) that has positions (na,) at or near a pose (1 sample)."""
    return build_kinematics(robot).nearest_configuration(poses, q)


def jacobian(robot: Robot | Kinematics, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
    """Return the tool's twist per actuated velocity (N, 6 or 3, na); see `Kinematics.jacobian`."""
    return build_kinematics(robot).jacobian(q, poses)


def compute_inverse_jacobian(robot: Robot | Kinematics, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
    """Return `G_x`: how fast each gap opens per tool twist, (N, n rods, 6), or (N, n rods, 3) for a translating plate.

    For the legs of a Stewart platform this is the inverse Jacobian but for the sign; rods on carts need `closure_by_q` too:
    `G_q v = -G_x V`.

    Raises:
        InputError: The robot has no rods.
    """
    kinematics = build_kinematics(robot)
    if kinematics.legs is None:
        raise InputError("unsupported", f"{kinematics.robot.source}: has no rods; invert its Jacobian instead")
    return kinematics.closure_by_pose(q, poses)


def compute_acceleration_bias(
    robot: Robot | Kinematics, q: np.ndarray, v: np.ndarray, poses: Poses | None = None
) -> np.ndarray:
    """Return the tool's acceleration (N, 6 or 3) at rest of the actuators, `dJ/dt v`; see `Kinematics.acceleration_bias`."""
    return build_kinematics(robot).acceleration_bias(q, v, poses)


def measure_singularity(robot: Robot | Kinematics, q: np.ndarray, poses: Poses | None = None) -> Singularity:
    """Return how near the robot is to singularities of both kinds; of a tree, by its loops and by its tool's Jacobian."""
    return build_kinematics(robot).singularity(q, poses)
