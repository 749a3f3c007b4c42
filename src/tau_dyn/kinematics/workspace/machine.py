"""What the workspace asks of a robot: inverse kinematics in home's configuration, rates, solids; and its actuators' travel."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.bodies import Body
from tau_dyn.kinematics.collisions import PlacedSolid, build_standing_solid, move_solid
from tau_dyn.kinematics.dexterity import Rates
from tau_dyn.mechanism import Frames, Poses, Rods, compute_frames
from tau_dyn.robot import Robot

_SAMPLES = 4000
"""Random positions from which a robot's reach is estimated."""


class InverseSolution(NamedTuple):
    """Inverse kinematics of N poses.

    Attributes:
        q: Positions (N, na), nan where there are none.
        ok: Where there are some (N,).
        reason: Why there are none (N,).
        poses: Of the tool as reached: turned otherwise than asked where the robot has too few freedoms to choose.
        turned: Largest angle by which it is [rad].
    """

    q: np.ndarray
    ok: np.ndarray
    reason: np.ndarray
    poses: Poses
    turned: float = 0.0


class WorkspaceModel(Protocol):
    """What the workspace asks of a robot."""

    robot: Robot
    rods: Rods | None
    home: Poses
    bodies: list[Body]
    meshes: list[str]

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions in home's configuration, whatever their limits."""
        ...

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the closure's rates."""
        ...

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        ...

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box (two corners) that holds every place of the tool."""
        ...

    def holders(self, rod: int) -> list[int]:
        """Return the joints whose links hold the joints of a rod among `bodies`."""
        ...


def get_travel(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return finite limits (na,), a whole turn for a joint that has none.

    Raises:
        InputError: A slide without limits, or limits that are inverted.
    """
    lower, upper = robot.lower.copy(), robot.upper.copy()
    for k, (name, kind) in enumerate(zip(robot.actuated, robot.joint_kinds, strict=True)):
        if not lower[k] < upper[k]:
            raise InputError(
                "robot_structure",
                f"{robot.source}: the limits of joint '{name}' are inverted or equal: {lower[k]:g} is not below {upper[k]:g}",
            )
        if not np.isfinite([lower[k], upper[k]]).all():
            if kind == "prismatic":
                raise InputError(
                    "robot_structure",
                    f"{robot.source}: slide '{name}' has no limits; a workspace needs <limit lower upper>",
                )
            lower[k], upper[k] = -np.pi, np.pi
    return lower, upper


def draw_positions(robot: Robot) -> np.ndarray:
    """Return positions (N, na) over the actuators' travel: its corners, then at random, always the same."""
    lower, upper = get_travel(robot)
    corners = np.array(np.meshgrid(*[(0.0, 1.0)] * min(robot.na, 8))).reshape(min(robot.na, 8), -1).T
    if robot.na > 8:
        corners = np.zeros((0, robot.na))
    share = np.concatenate([corners, np.random.default_rng(0).random((_SAMPLES, robot.na))])
    return lower + share * (upper - lower)


def compute_joint_frames(robot: Robot, joints: list, q: np.ndarray) -> Frames:
    """Return the frames of all joints at actuated positions `q` (N, na) of a tree without loops to close."""
    x = np.zeros((robot.model.nv, len(q)))
    x[robot.active_v] = q.T
    return compute_frames(joints, x)


def place_body(body: Body, at: Frames | None) -> PlacedSolid:
    """Return a body where its joint is, or where it stands."""
    if body.joint == 0 or at is None:
        return build_standing_solid(body.shape, body.placement)
    rotation = np.ascontiguousarray(np.moveaxis(at.rotation[body.joint], 2, 0))
    return move_solid(body, rotation, at.origin[body.joint].T)
