"""A log as a motion to play: measured, and beside it what was simulated or commanded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import Robot

FRAMES_HZ = 30.0  # Hz, as screens and films
_TRAIL = 2000
"""Most points of the tool's path."""


@dataclass(frozen=True, eq=False)
class Playback:
    """A motion thinned to what an eye sees.

    Attributes:
        t: Time (n,) [s] from zero.
        q: Measured actuated positions (n, na).
        ghost: Others at the same times (n, na), or None.
        ghost_is: What they are: `simulated` or `commanded`.
    """

    t: np.ndarray
    q: np.ndarray
    ghost: np.ndarray | None
    ghost_is: str = "commanded"

    def at(self, t: float) -> int:
        """Return the number of the picture at a time [s]."""
        return min(int(np.searchsorted(self.t, t - 1e-9)), len(self.t) - 1)

    def apart(self) -> np.ndarray | None:
        """Return the largest distance of the ghost from what was measured, by joint (na,)."""
        return None if self.ghost is None else np.nanmax(np.abs(self.ghost - self.q), axis=0)


def build_playback(log: Log, robot: Robot, simulated: Log | None = None) -> Playback:
    """Return a log as a playback of this robot.

    Args:
        log: With the position of every actuated joint.
        robot: The robot.
        simulated: A log of the same motion from the same start, whose positions are the ghost; without it the references are.

    Raises:
        InputError: A log lacks a joint's position, or the logs share no time.
    """
    q = log.joint("q", robot.actuated)
    keep = slice(None, None, max(1, round(log.rate_hz / FRAMES_HZ)))
    t = (log.t - log.t[0])[keep]
    if simulated is not None:
        return Playback(t, q[keep], _resampled(simulated, robot, t), "simulated")
    ghost = log.joint("q_ref", robot.actuated)[keep] if log.has("q_ref", robot.actuated) else None
    return Playback(t, q[keep], ghost)


def _resampled(log: Log, robot: Robot, t: np.ndarray) -> np.ndarray:
    """Return a log's positions at other times (n, na), nan after its end."""
    own, q = log.t - log.t[0], log.joint("q", robot.actuated)
    if own[-1] <= 0:
        raise InputError("too_little_data", "the simulated log has no duration; simulate the motion that was measured")
    return np.column_stack([np.interp(t, own, column, right=np.nan) for column in q.T])


def compute_trail(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the tool's path (m, 3) [m] along positions (n, na); empty without a tool or where it leaves its reach."""
    if robot.tool_frame is None or not len(q):
        return np.zeros((0, 3))
    thin = q[:: max(1, len(q) // _TRAIL)]
    found = forward_kinematics(robot, thin)
    return found.poses.position[found.ok]
