"""Random states around home that a robot can reach: where traced code is compared with Python."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Rods, forward_kinematics, get_robot
from tau_dyn.model import Model
from tau_dyn.robot import Robot


def draw_random_states(model: Model, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random states (n, na) around home that the robot can reach, slow and fast ones."""
    robot, found = model.robot, []
    for _ in range(50 * n):
        q = robot.home + rng.uniform(-1, 1, robot.na) * _room(robot, 0.8, 1.0)
        if len(found) < n and model.mechanism.reachable(q):
            found.append(q)
    q = _some(robot, np.array(found))
    v = rng.choice([-1, 1], q.shape) * 10 ** rng.uniform(-3, 0.3, q.shape)
    return q, v, 3 * rng.standard_normal(q.shape)


def draw_reachable_positions(robot: Robot | Rods, n: int, rng: np.random.Generator, share: float = 0.4) -> np.ndarray:
    """Return random positions (n, na) around home that have a tool pose; `share` of the way to the limits, or of 1 rad or m."""
    owner = get_robot(robot)
    q = owner.home + rng.uniform(-1, 1, (4 * n, owner.na)) * _room(owner, share, min(1.0, 1.25 * share))
    return _some(owner, q[forward_kinematics(robot, q).ok][:n])


def _room(robot: Robot, share: float, most: float) -> np.ndarray:
    """Return how far from home to look (na,) [m or rad]."""
    room = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    return np.where(np.isfinite(room), share * room, most)


def _some(robot: Robot, q: np.ndarray) -> np.ndarray:
    if not len(q):
        raise InputError(
            "unreachable", f"{robot.source}: no position around home can be reached, so nothing can be exported"
        )
    return q
