"""Corrected joint positions for a controller that computes with the nominal robot.

The controller commands `q`, so that the tool of the nominal robot would be at the desired pose. The calibrated robot
reaches this pose at other positions. `exact` finds them by Newton's method on the calibrated model, with its parameters
`theta` and the commanded part `X` of the pose:

    X(theta, q_c) = X(theta_0, q).

`linear` is the calibration paper's approximation, its equations (27) to (33), all derivatives at the nominal robot
(Savoure et al. 2006):

    dX = S(q) (theta - theta_0),    q_c = q - J(q)^-1 dX.

A robot with fewer than six joints commands only part of the pose: x of a parallelogram, x y z of a Delta, x y z and rz
of an H4. The errors of the other part cannot be corrected, only predicted (`remaining`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import AXES, compute_rotation_between
from tau_dyn.calibrate.geometry import Geometry, expand_constraints
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses, build_kinematics, require_positions
from tau_dyn.robot import Robot


def require_valid_axes(robot: Robot, axes: Sequence[str]) -> tuple[str, ...]:
    """Return the axes named by a user.

    Raises:
        UnknownName: An axis that does not exist.
        InputError: More axes than joints, or one of them twice.
    """
    for axis in axes:
        if axis not in AXES:
            raise UnknownName("axis", axis, AXES)
    if len(set(axes)) != len(axes) or not 0 < len(axes) <= robot.na:
        raise InputError(
            "invalid_value",
            f"{robot.source} has {robot.na} actuated joints; name as many different axes or fewer, not {list(axes)}",
        )
    return tuple(axes)


def choose_default_axes(robot: Robot) -> tuple[str, ...]:
    """Return the coordinates that the robot commands, all six if it has six joints or more.

    Raises:
        InputError: The tool's motion at home is not known.
    """
    if robot.na >= 6:  # an arm often rests at a singularity of its wrist, where only five coordinates move
        return AXES
    return build_kinematics(robot).commanded.names


METHODS = ("exact", "linear")
_MAX_ITERATIONS = 30  # of Newton's method
_DONE = 1e-11  # [m or rad] Newton's last step
_STEP = 0.3  # [m or rad] longest step at once
_TURN = 2 * np.pi
_SINGULAR = 1e-9  # ratio of singular values; rounding alone gives less than 1e-12


class Corrected(NamedTuple):
    """Corrected positions for the controller.

    Attributes:
        q: Corrected positions (N, na) [m or rad], nan where not `ok`.
        ok: Whether the pose is reached (N,).
        reason: Why the pose is not reached (N,), '' if it is.
        steps: Newton steps taken, 0 for the linear method.
    """

    q: np.ndarray
    ok: np.ndarray
    reason: np.ndarray
    steps: int


@dataclass(frozen=True, eq=False)
class Compensation:
    """Corrected inverse kinematics of one calibrated robot; build it with `build_compensation`.

    Attributes:
        robot: The robot file.
        geometry: The mechanism.
        theta: Calibrated parameters (p,).
        nominal: Parameters that the controller computes with (p,).
        axes: Commanded part of the tool's pose, names out of `x y z rx ry rz` (world axes).
        method: 'exact' or 'linear'.
        limits: Whether positions beyond the joints' limits are refused.
    """

    robot: Robot
    geometry: Geometry
    theta: np.ndarray
    nominal: np.ndarray
    axes: tuple[str, ...]
    method: str = "exact"
    limits: bool = True

    def __call__(self, wanted: np.ndarray | Poses, *, start: np.ndarray | None = None) -> Corrected:
        """Return corrected positions.

        Args:
            wanted: Positions that the controller computed with the nominal robot (N, na) [m or rad], or tool poses in the
                base frame; of poses only the commanded axes count.
            start: Starting positions of the search for poses, (na,) or (N, na); the robot's home by default.
        """
        if isinstance(wanted, Poses):
            guess = self.robot.home if start is None else np.asarray(start, float)
            guess = np.broadcast_to(guess, (wanted.n_samples, self.robot.na)).copy()
            nominal = self._newton(self.nominal, wanted, guess, np.full(wanted.n_samples, "", object))
            target = wanted
        else:
            q = require_positions(self.robot, wanted)
            found = self.geometry.forward(self.nominal, q)
            nominal, target = Corrected(q, found.ok, found.reason, 0), found.poses
        first = self._linear(nominal, target)
        if self.method == "linear":
            return self._within_limits(first)
        safe = np.where(
            np.isfinite(first.q), first.q, nominal.q
        )  # at a nominal singularity Newton starts from nominal positions
        near = None if isinstance(wanted, Poses) else target  # of poses only the commanded axes may mean anything
        return self._within_limits(self._newton(self.theta, target, safe, nominal.reason.copy(), near))

    def remaining(self, wanted: np.ndarray, corrected: np.ndarray) -> np.ndarray:
        """Return the twist (N, 6) by which the calibrated robot at `corrected` misses the nominal one at `wanted`, all axes."""
        target = self.geometry.forward(self.nominal, require_positions(self.robot, wanted)).poses
        return _missed(target, self.geometry.forward(self.theta, require_positions(self.robot, corrected)).poses)

    def with_method(self, method: str) -> Compensation:
        """Return the same compensation by the other method."""
        return replace(self, method=_known(method))

    @property
    def rows(self) -> list[int]:
        """Commanded components of a twist."""
        return [AXES.index(axis) for axis in self.axes]

    @cached_property
    def _reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds at which Newton's method has failed: half a range outside the limits, or one turn from home without any."""
        lower, upper, home = self.robot.lower, self.robot.upper, self.robot.home
        half = 0.5 * (upper - lower)
        return np.where(np.isfinite(half), lower - half, home - _TURN), np.where(
            np.isfinite(half), upper + half, home + _TURN
        )

    def _linear(self, nominal: Corrected, target: Poses) -> Corrected:
        q = np.where(np.isfinite(nominal.q), nominal.q, 0.0)
        by_parameter = self.geometry.tool_by_parameter(self.nominal, q, target)[:, self.rows]
        by_joint = self.geometry.tool_by_joint(self.nominal, q, target)[:, self.rows]
        step, sound = _solved(by_joint, by_parameter @ (self.theta - self.nominal))
        reason = np.where((nominal.reason == "") & ~sound, "singular", nominal.reason).astype(object)
        ok = nominal.ok & sound
        return Corrected(np.where(ok[:, None], q - step, np.nan), ok, reason, 0)

    def _newton(
        self, theta: np.ndarray, target: Poses, start: np.ndarray, reason: np.ndarray, near: Poses | None = None
    ) -> Corrected:
        """Return positions (N, na) where the commanded part of the pose is the target's; `near`: where the tool then is."""
        q, steps = start.copy(), 0
        left = np.flatnonzero((reason == "") & np.isfinite(q).all(axis=1))
        reason[left] = "not converged"
        for _ in range(_MAX_ITERATIONS):
            if not left.size:
                break
            steps += 1
            found = self.geometry.forward(theta, q[left], None if near is None else near.take(left))
            miss = _missed(target.take(left), found.poses)[:, self.rows]
            step, sound = _solved(self.geometry.tool_by_joint(theta, q[left], found.poses)[:, self.rows], miss)
            sound &= found.ok
            reason[left[~sound]] = np.where(found.ok, "singular", found.reason)[~sound]
            size = np.abs(step).max(axis=1)
            q[left[sound]] += (step * np.minimum(1.0, _STEP / np.maximum(size, 1e-300))[:, None])[sound]
            done = sound & (size < _DONE)
            reason[left[done]] = ""
            astray = np.any((q[left] < self._reach[0]) | (q[left] > self._reach[1]), axis=1) & ~done
            reason[left[sound & astray]] = "out of reach"
            left = left[sound & ~done & ~astray]
        ok = reason == ""
        return Corrected(np.where(ok[:, None], q, np.nan), ok, reason, steps)

    def _within_limits(self, found: Corrected) -> Corrected:
        if not self.limits:
            return found
        with np.errstate(invalid="ignore"):
            beyond = (found.q < self.robot.lower - 1e-9) | (found.q > self.robot.upper + 1e-9)
        reason = found.reason.astype(object)
        for k in np.flatnonzero(found.ok & beyond.any(axis=1)):
            reason[k] = f"{self.robot.actuated[int(np.argmax(beyond[k]))]} beyond its limit"
        ok = reason == ""
        return Corrected(np.where(ok[:, None], found.q, np.nan), ok, reason, found.steps)


def build_compensation(
    robot: Robot,
    geometry: Geometry,
    theta: np.ndarray,
    *,
    method: str = "exact",
    axes: Sequence[str] | None = None,
    nominal: np.ndarray | None = None,
    limits: bool = True,
) -> Compensation:
    """Build the corrected inverse kinematics of a calibrated robot.

    Args:
        robot: The robot file.
        geometry: Its fitted geometry.
        theta: Calibrated parameters (p,), such as `fit(...).theta`.
        method: 'exact' or 'linear'.
        axes: Commanded part of the pose, one name a joint (`x y z rx ry rz`); by default the coordinates that the
            kinematics command, or all six.
        nominal: Parameters that the controller computes with (p,); the robot file's unless given.
        limits: Whether positions beyond the joints' limits are refused.

    Raises:
        InputError: Arrays of the wrong length, or axes that the robot's joints do not move.
        UnknownName: An axis or a method that does not exist.
    """
    theta = np.asarray(theta, float)
    nominal = geometry.parameters.values if nominal is None else np.asarray(nominal, float)
    geometry, (theta, nominal) = expand_constraints(geometry, theta, nominal)
    p = len(geometry.parameters)
    if theta.shape != (p,) or nominal.shape != (p,):
        raise InputError(
            "wrong_shape", f"{robot.source}: the geometry has {p} parameters, not {theta.shape} and {nominal.shape}"
        )
    chosen = choose_default_axes(robot) if axes is None else require_valid_axes(robot, axes)
    return Compensation(robot, geometry, theta, nominal, chosen, _known(method), limits)


def _known(method: str) -> str:
    if method not in METHODS:
        raise UnknownName("compensation method", method, METHODS)
    return method


def _missed(target: Poses, at: Poses) -> np.ndarray:
    """Return the twist (N, 6) from `at` to `target`, nan where one of them is."""
    out = np.full((len(at.position), 6), np.nan)
    out[:, :3] = target.position - at.position
    ok = np.isfinite(at.rotation).all(axis=(1, 2)) & np.isfinite(target.rotation).all(axis=(1, 2))
    out[ok, 3:] = compute_rotation_between(target.rotation[ok], at.rotation[ok])
    return out


def _solved(J: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least joint motion (N, na) that makes a twist (N, r), and where `J` (N, r, na) is not singular (N,)."""
    sound = np.asarray(np.isfinite(J).all(axis=(1, 2)) & np.isfinite(twist).all(axis=1))
    safe = np.where(sound[:, None, None], J, 0.0)
    u, s, vt = np.linalg.svd(safe, full_matrices=False)
    sound &= s[:, -1] > _SINGULAR * np.maximum(s[:, 0], 1e-300)
    weight = np.divide(1.0, s, out=np.zeros_like(s), where=sound[:, None])
    along = np.einsum("nrk,nr->nk", u, np.where(sound[:, None], twist, 0.0))
    return np.einsum("nka,nk->na", vt, weight * along), sound
