"""Gauss-Newton with Levenberg's damping on the manifold of all unknowns, in rounds that settle noise and weights.

    minimise  sum_k w_k |r_k / (e_k sigma)|^2 + sum_i ((theta_i - nominal_i) / scale_i)^2

`e_k` are stated standard errors over their median, one where none are stated. The second sum says that a robot is built to its
drawing within `scale` (10 mm, 10 mrad): it decides nothing that
poses can tell, and keeps combinations that they hardly see from running away; a 3-DOF Gantry-Tau sees a rod shifted
parallel to itself only through the plate's tiny rotations. The noise `sigma` of each block (position, orientation) is
the block's sum of squares by what the parameters leave of it, `n_b - trace(H_b)`, `H` the hat matrix. Reference:
Khalil & Dombre 2002, 11.5; Nocedal & Wright 2006, 10.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import linalg

from tau_dyn.calibrate.frames import DeviceFrames, compute_rotation_between
from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, Geometry
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.unknowns import Identifiability, Unknowns, find_identifiable
from tau_dyn.estimate import compute_robust_weights, estimate_distance_scale
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


_MAX_ITERATIONS = 15  # bounds the time of a fit that does not converge
_STEPS = 15  # of Gauss-Newton in one round
_RELATIVE_CHANGE_TOL = 1e-2  # of the noise: what a round may still change
_SMALL = 1e-3  # a step whose predictions move by less than this share of the noise (rms) is the last,
_GAIN = 0.02  # and so is one that lowers the sum by less: a seventh of a standard error at most
_FREE_FRAMES = 1e3  # how much less than dimensions frames are known beforehand
_UNIDENTIFIABLE_PRIOR_WEIGHT = 1e5  # prior of parameters that poses cannot tell, in units of 1 / scale
_FULL_STEPS = 4  # undamped Gauss-Newton steps along a curved valley


class LevenbergMarquardt:
    """One fit."""

    def __init__(self, problem: Problem, robust: str, noise: tuple[float, ...] | None) -> None:
        """Prepare scales and the prior.

        Args:
            problem: Residuals and their derivatives.
            robust: Kind of weights.
            noise: Of each block, None to estimate it.
        """
        self.problem, self.robust, self.given = problem, robust, noise
        self.unknowns = problem.unknowns
        self.m = sum(problem.blocks)
        self.free = np.flatnonzero(self.unknowns.free)
        self.scales = self.unknowns.scales[self.free]
        n = self.unknowns.n_geometry
        tool = n + self.unknowns.n_device
        frame = (self.free >= n) & (self.free < tool + self.unknowns.n_tool)
        self.trust = np.where(frame, 1 / _FREE_FRAMES, 1.0)  # of the prior, in units of 1 / scale
        self.homeless = frame  # what has no nominal value, or none that counts
        self._housed = ~frame | (self.free >= tool) & (
            (self.free - tool) % 6 < 3
        )  # the target sits where the file's tool is
        self.nominal = np.array([p.value for p in self.unknowns.rows])
        self.nominal[n : tool + self.unknowns.n_tool] = 0.0
        self.steps = 0

    def minimise(self, state: FitState) -> tuple[FitState, tuple[float, ...], bool]:
        """Return the state at the minimum, the noise, and whether both came to rest."""
        noise = self._first_noise(state)
        everything, near = np.arange(len(self.free)), False
        for _ in range(_MAX_ITERATIONS):
            state, rested = self.descend(state, noise, everything, _STEPS if near else 3)
            new = self._noise(state, noise)
            change = max(abs(a / b - 1) for a, b in zip(new, noise, strict=True))
            noise, near = new, change < 0.2
            if rested and change < _RELATIVE_CHANGE_TOL:
                return state, noise, True
        return state, noise, False

    def identifiable(self, state: FitState, noise: tuple[float, ...]) -> Identifiability:
        """Return what the poses can tell at a state, or prior knowledge of what is known beforehand."""
        _, w = self._whitened(state, noise)
        columns = self._columns(state, noise, w)
        names = tuple(self.unknowns.names[k] for k in self.free)
        priority = self.unknowns.priority[self.free]
        known = np.diag(1 / self.scales)[priority == KNOWN_BEFOREHAND]
        flat = np.vstack([columns.reshape(-1, len(self.free)), known])
        return find_identifiable(flat, names, self.scales, priority)

    def reset_unidentifiable(self, state: FitState, noise: tuple[float, ...], found: Identifiability) -> FitState:
        """Return the state with parameters that cannot be told at their nominal values, the others making up for it.

        The target's place among them: left adrift along what nobody sees, it would take dimensions with it.
        """
        if not len(found.dropped):
            return state
        own = found.dropped[self._housed[found.dropped]]
        trust, homeless = self.trust.copy(), self.homeless.copy()
        self.homeless[own] = False
        if not np.any(self._deviation(state)[own]):
            self.homeless = homeless
            return state
        self.trust[own] = _UNIDENTIFIABLE_PRIOR_WEIGHT
        everything = np.arange(len(self.free))
        state = self._full_steps(state, noise)
        state, _ = self.descend(state, noise, everything, 2 * _STEPS)
        state = self._exactly_nominal(state, own)
        self.trust, self.homeless = trust, homeless
        return state

    def _full_steps(self, state: FitState, noise: tuple[float, ...]) -> FitState:
        """Return the state after whole Gauss-Newton steps, which get along a curved valley where a falling sum would not."""
        for _ in range(_FULL_STEPS):
            r, w = self._whitened(state, noise)
            a = self._columns(state, noise, w).reshape(-1, len(self.free)) * self.scales
            a = np.vstack([a, np.diag(self.trust)])
            b = np.concatenate([(r * np.sqrt(w)[:, None]).ravel(), -self._prior(state)])
            q, triangle = np.linalg.qr(a)
            trial = self._moved(state, _damped(triangle, q.T @ b, 0.0) * self.scales)
            if trial.ok.sum() < state.ok.sum():
                return state
            state = trial
            self.steps += 1
        return state

    def uncertainty(
        self, state: FitState, noise: tuple[float, ...], kept: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return weights (N,), whitened columns of the kept unknowns (N, m, r) and the covariance of the free ones (f, f)."""
        _, w = self._whitened(state, noise)
        columns = self._columns(state, noise, w)[:, :, kept]
        f, scales = len(self.free), self.scales[kept]
        cov = np.zeros((f, f))
        if len(kept):
            a = np.vstack([columns.reshape(-1, len(kept)) * scales, np.diag(self.trust[kept])])
            inverse = linalg.solve_triangular(np.linalg.qr(a, mode="r"), np.eye(len(kept)))
            cov[np.ix_(kept, kept)] = (inverse @ inverse.T) * np.outer(scales, scales)
        return w, columns, cov

    def descend(
        self, state: FitState, noise: tuple[float, ...], kept: np.ndarray, most: int = _STEPS
    ) -> tuple[FitState, bool]:
        """Return the state where the sum is smallest, and whether the last step was small."""
        if not len(kept):
            return state, True
        damping = 0.0
        r, w = self._whitened(state, noise)
        for _ in range(most):
            a = self._columns(state, noise, w)[:, :, kept].reshape(-1, len(kept)) * self.scales[kept]
            a = np.vstack([a, np.diag(self.trust[kept])])
            b = np.concatenate([(r * np.sqrt(w)[:, None]).ravel(), -self._prior(state)[kept]])
            state, r, damping, rested = self._step(state, noise, (a, b, w), kept, damping)
            if rested:
                return state, True
            w = self._weights(r, state.ok)
        return state, False

    def _step(
        self,
        state: FitState,
        noise: tuple[float, ...],
        system: tuple[np.ndarray, np.ndarray, np.ndarray],
        kept: np.ndarray,
        damping: float,
    ) -> tuple[FitState, np.ndarray, float, bool]:
        a, b, w = system
        q, triangle = np.linalg.qr(a)
        target, cost = q.T @ b, float(b @ b)
        enough = _SMALL * np.sqrt(len(b))
        for _ in range(10):
            y = _damped(triangle, target, damping)
            small = float(np.linalg.norm(triangle @ y)) < enough
            step = np.zeros(len(self.free))
            step[kept] = y * self.scales[kept]
            trial = self._moved(state, step)
            self.steps += 1
            if trial.ok.sum() >= state.ok.sum():
                r, _ = self._whitened(trial, noise)
                gone = float(np.sum(w[:, None] * r**2) + np.sum(self._prior(trial)[kept] ** 2))
                if gone <= cost or (small and gone <= cost * (1 + 1e-6)):
                    return trial, r, (damping / 10 if damping > 0.02 else 0.0), small or cost - gone < _GAIN
            if small:
                break
            damping = max(5 * damping, 0.1)
        return state, self._whitened(state, noise)[0], damping, True

    def _moved(self, state: FitState, step: np.ndarray) -> FitState:
        whole = np.zeros(len(self.unknowns.rows))
        whole[self.free] = step
        return self.problem.moved(state, whole)

    def _deviation(self, state: FitState) -> np.ndarray:
        """Return how far free unknowns are from nominal (f,); frames count as at home, wherever they are."""
        frames = [p.value for p in state.frames.parameters()]
        values = np.concatenate([state.theta, frames, state.slack])
        return np.where(self.homeless, 0.0, (values - self.nominal)[self.free])

    def _prior(self, state: FitState) -> np.ndarray:
        return self._deviation(state) / self.scales * self.trust

    def _exactly_nominal(self, state: FitState, own: np.ndarray) -> FitState:
        """Return the state with these free unknowns at their nominal values, to the last bit or to rounding (the target)."""
        step = np.zeros(len(self.unknowns.rows))
        step[self.free[own]] = -self._deviation(state)[own]
        _, device, tool, _ = self.unknowns.split(step)
        theta, own = state.theta.copy(), self.free[own]
        own = own[own < self.unknowns.n_geometry]
        theta[own] = self.nominal[own]
        return self.problem.place(
            theta, state.frames.moved(device, tool), state.slack, state.base if state.ok.all() else None
        )

    def _first_noise(self, state: FitState) -> tuple[float, ...]:
        if self.given is not None:
            return self.given
        r = (self.problem.residuals(state) / self.problem.relative)[state.ok]
        return tuple(max(float(np.sqrt(np.mean(r[:, cut] ** 2))), 1e-9) for cut in self._cuts())

    def _noise(self, state: FitState, noise: tuple[float, ...]) -> tuple[float, ...]:
        if self.given is not None:
            return self.given
        r, w = self._whitened(state, noise)
        a = self._columns(state, noise, w).reshape(-1, len(self.free)) * self.scales
        hat = _leverage(np.vstack([a, np.diag(self.trust)]))[: len(a)].reshape(r.shape)
        out = []
        for cut, size, s in zip(self._cuts(), self.problem.blocks, noise, strict=True):
            used = w > 0
            left = max(float(used.sum()) * size - float(hat[used][:, cut].sum()), 1.0)
            if self.robust == "none":
                ratio = np.sqrt(float(np.sum(r[used][:, cut] ** 2)) / left)
            else:
                ratio = estimate_distance_scale(np.linalg.norm(r[used][:, cut], axis=1), size) * np.sqrt(
                    used.sum() * size / left
                )
            out.append(max(float(s * ratio), 1e-9))
        return tuple(out)

    def _cuts(self) -> list[slice]:
        ends = np.cumsum((0, *self.problem.blocks))
        return [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def _sigma(self, noise: tuple[float, ...]) -> np.ndarray:
        """Return the noise of every residual (N, m), as stated standard errors weigh the poses."""
        return self.problem.relative * np.repeat(noise, self.problem.blocks)

    def _whitened(self, state: FitState, noise: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, m) in units of the noise and weights (N,); poses without prediction weigh nothing."""
        r = self.problem.residuals(state) / self._sigma(noise)
        r = np.where(state.ok[:, None], r, 0.0)
        return r, self._weights(r, state.ok)

    def _weights(self, r: np.ndarray, ok: np.ndarray) -> np.ndarray:
        return np.where(ok, compute_robust_weights(self.robust, np.linalg.norm(r, axis=1), self.m), 0.0)

    def _columns(self, state: FitState, noise: tuple[float, ...], w: np.ndarray) -> np.ndarray:
        columns = self.problem.columns(state)[:, :, self.free]
        columns = columns / self._sigma(noise)[:, :, None] * np.sqrt(w)[:, None, None]
        return np.where(state.ok[:, None, None], columns, 0.0)


def _damped(triangle: np.ndarray, target: np.ndarray, damping: float) -> np.ndarray:
    if not damping:
        return linalg.solve_triangular(triangle, target)
    stacked = np.vstack([triangle, np.sqrt(damping) * np.eye(len(triangle))])
    return np.linalg.lstsq(stacked, np.concatenate([target, np.zeros(len(triangle))]), rcond=None)[0]


def _leverage(a: np.ndarray) -> np.ndarray:
    """Return the hat matrix' diagonal (rows,)."""
    return np.sum(np.linalg.qr(a)[0] ** 2, axis=1) if a.shape[1] else np.zeros(len(a))
