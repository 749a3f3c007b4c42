r"""Forward kinematics: where actuated positions put the tool (thesis (4.1)).

A translating plate is found by trilateration (`sliding_plate.py`), a free one by Newton on SE(3) from home's assembly mode
(`free_plate.py`), anything else through the tree (`tree_pose.py`). Poses are in the world, arrays have samples first.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.kinematics_result import ForwardResult
from tau_dyn.mechanism.poses import Poses, require_poses
from tau_dyn.mechanism.positions import require_positions
from tau_dyn.mechanism.rods import Rods
from tau_dyn.mechanism.sliding_plate import SlidingPlate
from tau_dyn.mechanism.solvers import get_robot, get_rods, get_solver
from tau_dyn.robot import Robot

__all__ = ["ForwardResult", "forward_kinematics", "solve_both_forward"]


def forward_kinematics(robot: Robot | Rods, q: np.ndarray, *, start: Poses | None = None) -> ForwardResult:
    """Return where the tool is at actuated positions.

    Args:
        robot: A robot, or its rods (perhaps with another geometry).
        q: Actuated positions (N, na) [m or rad].
        start: Poses of the tool (N, or 1 for all) from which to search, for another assembly mode than home's; a translating
            plate takes the side of it, a tree ignores it.

    Returns:
        Poses, nan with a reason where there is none. A pose depends on its own `q` (and start) alone, not on other samples.

    Raises:
        InputError: Arrays of the wrong shape.
        LoopClosureError: The robot cannot be closed even at home.
    """
    q = require_positions(get_robot(robot), q)
    engine, rods = get_solver(robot), get_rods(robot)
    if start is not None:
        start = require_poses(start)
        if len(start.position) not in (1, len(q)):
            raise InputError(
                "wrong_shape", f"start must hold one pose or {len(q)}, one a sample, not {len(start.position)}"
            )
        start = start if rods is None else rods.plate_poses(start)
    plate, code = engine.forward(q, start)
    return ForwardResult(plate if rods is None else rods.tool_poses(plate), plate, code)


def solve_both_forward(rods: Rods, q: np.ndarray) -> np.ndarray:
    """Return both tool positions (N, 2, 3) [m] of a translating plate, home's first; nan where the spheres do not meet.

    Raises:
        InputError: The plate does not translate only; `assembly` finds the modes of a free plate.
    """
    engine = get_solver(rods)
    if not isinstance(engine, SlidingPlate):
        raise InputError("unsupported", f"{rods.robot.source}: two closed solutions are for plates that translate only")
    positions = engine.both(require_positions(rods.robot, q))
    return positions + rods.rotation @ rods.tool.translation
