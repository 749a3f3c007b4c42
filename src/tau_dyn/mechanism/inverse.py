r"""Inverse kinematics: which actuated positions put the tool at a pose (thesis (4.2)).

Rods make the chains independent of each other, so each is solved for itself (`chain_inverse.py`). A chain of one actuator
has two solutions, named by a sign, and all chains together up to `2^k`: the *configuration*. It is not related to the
assembly mode of forward kinematics (thesis 4.2). Without a configuration home's is taken, and a pose that lies beyond a
parallel singularity from home is refused as `branch change`.

A free plate on fewer than six actuators cannot take every pose: it takes the position asked for, and the orientation as
far as it has freedoms left (`manifold_inverse.py`); `Inverse.orientation_error` says what is missing. A translating plate
keeps its orientation, whatever is asked for. A tree (`tree_pose.py`) does the same by priority.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.joint_limits import check_limits, refuse_beyond_limits
from tau_dyn.mechanism.kinematics_result import InverseResult
from tau_dyn.mechanism.poses import Poses, require_poses
from tau_dyn.mechanism.positions import require_positions
from tau_dyn.mechanism.rod_inverse import RodInverse
from tau_dyn.mechanism.rods import Rods
from tau_dyn.mechanism.solver_cache import get_cached
from tau_dyn.mechanism.solvers import get_robot, get_rods, get_solver
from tau_dyn.mechanism.tree_inverse import TreeSolutions, find_tree_solutions, solve_tree_inverse
from tau_dyn.mechanism.tree_newton import TreeNewton
from tau_dyn.mechanism.tree_pose import TreePose
from tau_dyn.robot import Robot

__all__ = [
    "InverseResult",
    "list_configurations",
    "get_home_configuration",
    "inverse_kinematics",
    "solve_all_configurations",
]


def inverse_kinematics(
    robot: Robot | Rods,
    poses: Poses,
    *,
    configuration: Sequence[int] | np.ndarray | None = None,
    start: np.ndarray | None = None,
    limits: bool = True,
) -> InverseResult:
    """Return the actuated positions that put the tool at poses.

    Args:
        robot: A robot, or its rods (perhaps with another geometry).
        poses: Of the tool (N).
        configuration: One of `list_configurations`, a sign for each chain; by default home's.
        start: Positions (N or 1, na) from which to search, where a chain has no closed form, by default home. Where actuators
            can move without the tool (a telescopic arm, a serial arm with a joint to spare), the positions nearest to it
            are taken, where the search for them comes to rest. It does not choose the configuration; `follow` does.
        limits: Whether positions outside the file's joint limits are refused.

    Raises:
        InputError: Arrays of the wrong shape, an unknown configuration, or joint limits that are the wrong way round.
    """
    rods, poses = get_rods(robot), require_poses(poses)
    owner = get_robot(robot)
    start = None if start is None else _starts(owner, start, len(poses.position))
    if limits:
        check_limits(owner)
    if rods is None:
        if configuration is not None:
            raise InputError(
                "unsupported", f"{owner.source}: has no rods, hence no named configurations; give a start instead"
            )
        return refuse_beyond_limits(owner, solve_tree_inverse(_tree(robot), poses, start, limits), limits)
    solver = _solver(rods)
    return refuse_beyond_limits(
        owner, solver.inverse(poses, solver.signs(configuration), start, configuration is None), limits
    )


def solve_all_configurations(robot: Robot | Rods, poses: Poses) -> np.ndarray:
    """Return the positions of all configurations (N, n_configurations, na), nan where complex; joint limits are not looked at.

    Rods in closed form: rows as `list_configurations`. Six turning joints in a chain: all, by elimination, nearest to home
    first. Chains of several actuators under rods and other trees: what many starts find. `find_all_solutions` says which.
    """
    return find_all_solutions(robot, poses).q


def find_all_solutions(robot: Robot | Rods, poses: Poses) -> TreeSolutions:
    """Return `solve_all_configurations` with whether the solutions of each pose are proved to be all, and why."""
    rods, poses = get_rods(robot), require_poses(poses)
    if rods is None:
        return find_tree_solutions(_tree(robot), poses)
    solver, n = _solver(rods), len(poses.position)
    closed = all(0 not in chain.signs for chain in solver.chains)
    why = "in closed form" if closed else "from many starts"
    return TreeSolutions(solver.all(poses), np.full(n, closed), [why] * n)


def list_configurations(robot: Robot | Rods) -> np.ndarray:
    """Return the configurations by name (n, chains): -1 or 1 of a chain with two solutions, 1 of a leg, 0 by Newton.

    Raises:
        InputError: The robot has no rods.
    """
    return np.array(list(product(*(chain.signs for chain in _solver(_rods(robot)).chains))))


def find_nearest_configuration(rods: Rods, poses: Poses, q: np.ndarray) -> np.ndarray:
    """Return the configuration (chains,) that has positions (na,) at or near a pose (1 sample)."""
    return np.array(_solver(rods).signs_near(require_poses(poses), q))


def get_home_configuration(robot: Robot | Rods) -> np.ndarray:
    """Return home's configuration (chains,)."""
    return np.array(_solver(_rods(robot)).signs(None))


def _solver(rods: Rods) -> RodInverse:
    return get_cached(rods, "inverse", lambda: RodInverse(rods))


def _tree(robot: Robot | Rods) -> TreeNewton:
    engine = get_solver(robot)
    assert isinstance(engine, TreePose)
    return get_cached(robot, "inverse", lambda: TreeNewton(engine))


def _rods(robot: Robot | Rods) -> Rods:
    rods = get_rods(robot)
    if rods is None:
        raise InputError("unsupported", f"{get_robot(robot).source}: has no rods, hence no named configurations")
    return rods


def _starts(robot: Robot, start: np.ndarray, n: int) -> np.ndarray:
    start = require_positions(robot, start)
    if len(start) not in (1, n):
        raise InputError("wrong_shape", f"start must hold one row of positions or {n}, one a pose, not {len(start)}")
    return np.repeat(start, n, axis=0) if len(start) != n else start
