"""Positions of actuated joints from those of other joints of the same loops.

A loop ties its joints together, so that a robot with `na` freedoms is placed by any `na` joints whose motions are independent.
With `v_tree = G v_a` the chosen rows of `G` have full rank. They are chosen at home by QR with column pivoting of `G'`, which
takes the joints that tell most. The loops are then closed with these joints in the place of the actuated ones, from the same
configuration at home, so that the assembly mode is the same. Reference: Khalil & Dombre 2002, ch. 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from scipy import linalg

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.mechanism.frames import list_joints
from tau_dyn.mechanism.loop_arrays import LoopArrays
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.robot import Robot

_MIN_RELATIVE_DIAGONAL = 1e-3
"""Independent part of a chosen joint's motion, relative to the largest of any, below which it does not place the robot."""


def list_loop_joints(robot: Robot) -> tuple[str, ...]:
    """Return the passive joints of one freedom, each of which loops tie to the actuated ones."""
    if not robot.loops:
        return ()
    model, followers = robot.model, set(robot.mimics)
    free = (name for name in model.names if model.existJointName(name) and name not in robot.actuated)
    return tuple(n for n in free if n not in followers and model.joints[model.getJointId(n)].nv == 1)


def compute_actuated_positions_from(robot: Robot, joints: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return the actuated positions (N, na) [m or rad] at positions of other joints.

    Args:
        robot: A robot with loops.
        joints: Measured joints, actuated or of its loops; at least as many as it has freedoms.
        q: Their positions (N, k) [m or rad].

    Raises:
        CannotAnswer: The joints do not place the robot.
        LoopClosureError: The loops do not close at a position.
    """
    solver = LoopSolver(robot)
    at_home = solver.state(robot.home, np.zeros(robot.na), np.zeros(robot.na))
    rows = [robot.model.joints[robot.model.getJointId(name)].idx_v for name in joints]
    R, order = cast("tuple[np.ndarray, np.ndarray]", linalg.qr(at_home.G[rows].T, mode="r", pivoting=True))
    diagonal = np.abs(np.diag(R))
    if len(diagonal) < robot.na or diagonal[robot.na - 1] < _MIN_RELATIVE_DIAGONAL * np.abs(at_home.G).max():
        raise CannotAnswer(
            "poor_excitation",
            f"{', '.join(joints)} do not place {', '.join(robot.actuated)}",
            "log the positions of the actuated joints",
        )
    chosen = [joints[k] for k in sorted(order[: robot.na])]
    arrays = LoopArrays(solver, _get_joints(robot))
    home = dict(zip(robot.model.names[1:], arrays.positions(at_home.q), strict=True))
    measured = replace(
        robot,
        actuated=tuple(chosen),
        home=np.array([home[name] for name in chosen]),
        passive_home={name: value for name, value in home.items() if name not in chosen},
        drive_scales={},
    )
    closed = LoopArrays(LoopSolver(measured), _get_joints(measured)).close(
        q[:, [joints.index(name) for name in chosen]]
    )
    return closed.x[robot.active_v].T / robot.drive_scale


def _get_joints(robot: Robot) -> list:
    """Return the tree's joints; a robot with loops has joints of one freedom only."""
    joints = list_joints(robot.model)
    assert joints is not None
    return joints
