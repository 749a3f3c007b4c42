r"""What a fit makes small: how far measured poses are from predicted ones, or how far they leave the loops open.

    forward   measured minus predicted position [m] and the rotation between them [rad]: what the robot's user feels
              (thesis (5.5))
    closure   |A(q) - B(X)| - L of every rod at the measured pose [m]: always exists, but weighs poses by their
              geometry (thesis (5.1))
    inverse   actuated positions that the measured pose asks for, minus those commanded [m or rad]

A rotation residual is a rotation vector in the device's axes. Derivatives are analytic; that of the rotation residual
leaves out terms of the residual's own size (`J_l^-1(r) = I - O(r)`), which are gone at the optimum. Reference:
Everett 1989; Renaud et al. 2006.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import DeviceFrames, compute_rotation_between
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.unknowns import Unknowns
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses

KINDS = ("forward", "closure", "inverse")


class FitState(NamedTuple):
    """Where a fit stands.

    Attributes:
        theta: The geometry's parameters (p,).
        frames: Device and target.
        base: Predicted tool poses in the robot's base frame (N).
        ok: Whether they were found (N,).
        slack: Backlash of the actuated joints (na,) [m or rad].
    """

    theta: np.ndarray
    frames: DeviceFrames
    base: Poses
    ok: np.ndarray
    slack: np.ndarray


@dataclass(frozen=True, eq=False)
class Problem:
    """Residuals of one kind, and their derivatives.

    Attributes:
        geometry: The mechanism.
        poses: What was measured.
        unknowns: What may change.
        kind: `forward`, `closure` or `inverse`.
        turned: Whether measured orientations count.
    """

    geometry: Geometry
    poses: PoseSet
    unknowns: Unknowns
    kind: str
    turned: bool

    def __post_init__(self) -> None:
        """Refuse kinds that this mechanism or these poses do not have."""
        if self.kind not in KINDS:
            raise UnknownName("kind of residual", self.kind, KINDS)
        if self.kind != "forward" and self.geometry.orients and self.poses.rotation is None:
            raise InputError(
                "missing_column",
                f"{self.poses.source}: the {self.kind} residual needs measured orientations (qx_tool ..); "
                "use the forward residual",
            )

    @property
    def blocks(self) -> tuple[int, ...]:
        """Sizes of a pose's residuals of one unit each: (3, 3) for position and orientation."""
        if self.kind == "forward":
            return (3, 3) if self.turned else (3,)
        return (self._rows,)

    @cached_property
    def relative(self) -> np.ndarray:
        """Standard errors of the residuals relative to each other (N, m), as the poses' file states them."""
        m = sum(self.blocks)
        return self.poses.relative_errors(m) if self.kind == "forward" else np.ones((self.poses.n, m))

    @property
    def _rows(self) -> int:
        q, poses = self.poses.q[:1], Poses(np.zeros((1, 3)), np.eye(3)[None])
        if self.kind == "inverse":
            return q.shape[1]
        found = self.geometry.closure(self.geometry.parameters.values, q, poses)
        if found is None:
            raise InputError("unsupported", "this mechanism has no closure equations; use the forward residual")
        return found.shape[1]

    def place(self, theta: np.ndarray, frames: DeviceFrames, slack: np.ndarray, start: Poses | None) -> FitState:
        """Return the state at these values, tool poses searched from `start`."""
        found = self.geometry.forward(theta, compute_actuated_positions(self.poses, slack), start)
        return FitState(theta, frames, found.poses, found.ok, slack)

    def moved(self, state: FitState, step: np.ndarray) -> FitState:
        """Return the state after a step (P,) of all unknowns."""
        geometry, device, tool, slack = self.unknowns.split(step)
        start = state.base if state.ok.all() else None
        return self.place(state.theta + geometry, state.frames.moved(device, tool), state.slack + slack, start)

    def residuals(self, state: FitState) -> np.ndarray:
        """Return residuals (N, m), nan where a pose cannot be predicted."""
        if self.kind == "forward":
            seen = state.frames.measured(state.base, self.poses.setup)
            position = self.poses.position - seen.position
            if not self.turned:
                return position
            assert self.poses.rotation is not None
            rotation = np.full_like(position, np.nan)
            rotation[state.ok] = compute_rotation_between(self.poses.rotation[state.ok], seen.rotation[state.ok])
            return np.concatenate([position, rotation], axis=1)
        at = self._measured_in_base(state)
        gap = self._of(self.geometry.closure, state, at)
        if self.kind == "closure":
            return -gap
        return -np.linalg.solve(self._joint_slope(state, at), gap[:, :, None])[:, :, 0]

    def columns(self, state: FitState) -> np.ndarray:
        """Return minus the residuals' derivative by all unknowns (N, m, P)."""
        at = state.base if self.kind == "forward" else self._measured_in_base(state)
        seen = state.frames.measured(at, self.poses.setup)
        device, tool = state.frames.columns(at, seen, self.poses.setup)
        if self.kind == "forward":
            q = compute_actuated_positions(self.poses, state.slack)
            own = self.geometry.tool_by_parameter(state.theta, q, at)
            play = self._play(self.geometry.tool_by_joint, state, at)
            moved = state.frames.carried(at, np.concatenate([own, play], axis=2), self.poses.setup)
            split = own.shape[2]
            twist = np.concatenate([moved[:, :, :split], device, tool, moved[:, :, split:]], axis=2)
            return twist if self.turned else twist[:, :3]
        own = self._of(self.geometry.closure_by_parameter, state, at)
        by_pose = self._of(self.geometry.closure_by_pose, state, at)
        base = state.frames.brought(at, np.concatenate([device, tool], axis=2), self.poses.setup)
        play = self._play(self.geometry.closure_by_joint, state, at)
        columns = np.concatenate(
            [own, -by_pose @ base, play], axis=2
        )  # the measurement stays, so the base pose moves back
        if self.kind == "closure":
            return columns
        return np.linalg.solve(self._joint_slope(state, at), columns)

    def _play(self, function: Callable[..., np.ndarray | None], state: FitState, at: Poses) -> np.ndarray:
        """Return the derivative by backlash, half of it to each side."""
        if not self.unknowns.plays:
            rows = 6 if function == self.geometry.tool_by_joint else self._rows
            return np.zeros((self.poses.n, rows, self.poses.na))
        return self._of(function, state, at) * (-0.5 * self.poses.approach[:, None])

    def _measured_in_base(self, state: FitState) -> Poses:
        if self.geometry.orients:
            return state.frames.in_base(self.poses.poses, self.poses.setup)
        seen = state.frames.measured(state.base, self.poses.setup)
        back = state.frames.in_base(Poses(self.poses.position, seen.rotation), self.poses.setup)
        return Poses(back.position, state.base.rotation)

    def _joint_slope(self, state: FitState, at: Poses) -> np.ndarray:
        slope = self._of(self.geometry.closure_by_joint, state, at)
        if slope.shape[1] != slope.shape[2]:
            raise InputError(
                "unsupported",
                f"the inverse residual needs as many closure equations as actuated joints, not {slope.shape[1]} for "
                f"{slope.shape[2]}; use the forward or the closure residual",
            )
        return slope

    def _of(self, function: Callable[..., np.ndarray | None], state: FitState, at: Poses) -> np.ndarray:
        found = function(state.theta, compute_actuated_positions(self.poses, state.slack), at)
        if found is None:
            raise InputError("unsupported", "this mechanism has no closure equations; use the forward residual")
        return found


def compute_actuated_positions(poses: PoseSet, slack: np.ndarray) -> np.ndarray:
    """Return actuated positions (N, na) behind the backlash: a joint that came from below stands half of it too low."""
    return poses.q - 0.5 * slack * poses.approach if slack.any() else poses.q
