r"""Objective of a fit to poses, its derivatives by all unknowns, and the descent in iterations that estimate noise and weights.

    forward   measured minus predicted position [m] and the rotation between them [rad] (thesis (5.5))
    closure   |A(q) - B(X)| - L of every rod at the measured pose [m]: always exists, but weighs poses by their
              geometry (thesis (5.1))
    inverse   actuated positions computed from the measured pose, minus those commanded [m or rad]

The forward residual of a touch is divided by the robot's size relative to the nominal size.

A rotation residual is a rotation vector in the device's axes; its derivative leaves out terms of the residual's own size
(`J_l^-1(r) = I - O(r)`), which are negligible at the optimum. The objective is

    sum_k w_k |r_k / (e_k sigma)|^2 + sum_i ((theta_i - nominal_i) / scale_i)^2,

with `e_k` the stated standard errors over their median. The second sum is the prior that a robot is built to its drawing within
`scale` (10 mm, 10 mrad): it does not affect combinations that the poses determine, and bounds those that they hardly determine.
The variance `sigma^2` of each block (position, orientation) is its sum of squares over its degrees of freedom,
`n_b - trace(H_b)`, with `H` the hat matrix. Reference: Khalil & Dombre 2002, 11.5; Everett 1989; Renaud et al. 2006.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import DeviceFrames, compute_rotation_between
from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, Closure, Geometry
from tau_dyn.calibrate.measured import PoseSet, measured_by_joint, measured_by_parameter, predict_measured
from tau_dyn.calibrate.unknowns import Identifiability, Unknowns, find_identifiable
from tau_dyn.estimate import (
    DescentRules,
    LinearSystem,
    compute_robust_weights,
    descend,
    estimate_distance_scale,
    factor_system,
)
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses

KINDS = ("forward", "closure", "inverse")


class FitState(NamedTuple):
    """State of a fit.

    Attributes:
        theta: The geometry's parameters (p,).
        frames: Frames of device and target.
        base: Predicted tool poses in the robot's base frame (N); for an encoder its arc or travel along x.
        ok: Whether a pose was found (N,).
        slack: Backlash of the actuated joints [m or rad], and last how long all joints were read too early [s] (na + 1,).
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
        poses: The measurements.
        unknowns: The unknowns of the fit.
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
        if self.kind != "forward" and not self.poses.measures_poses:
            raise InputError(
                "unsupported", f"{self.poses.source}: distances, touches and encoders need the forward residual"
            )
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
    def numbers(self) -> np.ndarray:
        """Independent numbers of each pose in each block (N, blocks)."""
        numbers = np.tile(self.blocks, (self.poses.n, 1))
        if self.kind == "forward":
            numbers[:, 0] = self.poses.numbers
            numbers[self.poses.of_encoders, 1:] = 0
        return numbers

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
        return self._require(self.geometry.closure(self.geometry.parameters.values, q, poses)).gap.shape[1]

    def place(self, theta: np.ndarray, frames: DeviceFrames, slack: np.ndarray, start: Poses | None) -> FitState:
        """Return the state at these values, tool poses searched from `start`."""
        q = compute_actuated_positions(self.poses, slack)
        found = predict_measured(self.geometry, theta, self.poses, q, start)
        return FitState(theta, frames, found.poses, found.ok, slack)

    def moved(self, state: FitState, step: np.ndarray) -> FitState:
        """Return the state after a step (P,) of all unknowns."""
        geometry, frames, slack = self.unknowns.split(step)
        start = state.base if state.ok.all() else None
        return self.place(state.theta + geometry, state.frames.moved(*frames), state.slack + slack, start)

    def residuals(self, state: FitState) -> np.ndarray:
        """Return residuals (N, m), nan where a pose cannot be predicted."""
        if self.kind == "forward":
            seen = state.frames.measured(state.base, self.poses.setup)
            lengths = state.frames.lengths_of(self.poses.setup)
            position = self.poses.compute_position_residuals(seen, lengths)
            if self._touches.any():
                position = np.where(self._touches[:, None], position / self._compute_size(state), position)
            if not self.turned:
                return position
            assert self.poses.rotation is not None
            rotation = np.full_like(position, np.nan)
            turn = self.poses.expect(seen).rotation
            rotation[state.ok] = compute_rotation_between(self.poses.rotation[state.ok], turn[state.ok])
            return np.concatenate([position, rotation], axis=1)
        at = self._measured_in_base(state)
        found = self._closure(state, at)
        if self.kind == "closure":
            return -found.gap
        return -np.linalg.solve(_require_square(found.by_joint), found.gap[:, :, None])[:, :, 0]

    def columns(self, state: FitState) -> np.ndarray:
        """Return minus the residuals' derivative by all unknowns (N, m, P)."""
        at = state.base if self.kind == "forward" else self._measured_in_base(state)
        seen = state.frames.measured(at, self.poses.setup)
        device, tool = state.frames.columns(at, seen, self.poses.setup)
        if self.kind == "forward":
            q = compute_actuated_positions(self.poses, state.slack)
            own = measured_by_parameter(self.geometry, state.theta, self.poses, q, at)
            play = np.zeros((len(q), 6, q.shape[1] + 1))
            if self.unknowns.plays:
                by_joint = measured_by_joint(self.geometry, state.theta, self.poses, q, at)
                play = by_joint @ compute_slack_slopes(self.poses, state.slack)
            moved, split = state.frames.carried(at, np.concatenate([own, play], axis=2), self.poses.setup), own.shape[2]
            length = state.frames.length_columns(self.poses, seen.position)
            twist = np.concatenate([moved[:, :, :split], device, tool, length, moved[:, :, split:]], axis=2)
            columns = self.poses.project_columns(seen, twist)[:, : 6 if self.turned else 3]
            return self._rescale(state, columns) if self._touches.any() else columns
        found = self._closure(state, at)
        base = state.frames.brought(at, np.concatenate([device, tool], axis=2), self.poses.setup)
        # the measurement stays, so the base pose moves back
        play = found.by_joint @ compute_slack_slopes(self.poses, state.slack)
        columns = np.concatenate([found.by_parameter, -found.by_pose @ base, play], axis=2)
        return columns if self.kind == "closure" else np.linalg.solve(_require_square(found.by_joint), columns)

    @cached_property
    def _touches(self) -> np.ndarray:
        return self.poses.touches

    @cached_property
    def _size_slope(self) -> np.ndarray:
        return compute_size_slope(self.geometry, self.poses.q)

    def _compute_size(self, state: FitState) -> float:
        """Return the robot's size over the nominal one."""
        return 1.0 + float(self._size_slope @ (state.theta - self.geometry.parameters.values))

    def _rescale(self, state: FitState, columns: np.ndarray) -> np.ndarray:
        """Return derivatives (N, m, P) with touches relative to the robot's size."""
        size, slope = self._compute_size(state), self._size_slope
        relative = columns / size
        relative[:, :3, : len(slope)] += self.residuals(state)[:, :3, None] * slope / size
        return np.where(self._touches[:, None, None], relative, columns)

    def _measured_in_base(self, state: FitState) -> Poses:
        if self.geometry.orients:
            return state.frames.in_base(self.poses.poses, self.poses.setup)
        seen = state.frames.measured(state.base, self.poses.setup)
        back = state.frames.in_base(Poses(self.poses.position, seen.rotation), self.poses.setup)
        return Poses(back.position, state.base.rotation)

    def _closure(self, state: FitState, at: Poses) -> Closure:
        return self._require(
            self.geometry.under(self.poses.loads).closure(
                state.theta, compute_actuated_positions(self.poses, state.slack), at
            )
        )

    def _require(self, found: Closure | None) -> Closure:
        if found is None:
            raise InputError("unsupported", "this mechanism has no closure equations; use the forward residual")
        return found


def compute_size_slope(geometry: Geometry, q: np.ndarray) -> np.ndarray:
    """Return the derivative (p,) of a robot's size, over the nominal one, by its parameters.

    Touches alone do not determine an absolute length, and a smaller robot has smaller residuals: those of touches are relative
    to the size. The size is the component along the nominal lengths; changes that frames compensate do not affect it.

    Args:
        geometry: The mechanism.
        q: Actuated positions (N, na).
    """
    nominal = geometry.parameters.values * np.array([p.unit == "m" and p.free for p in geometry.parameters], float)
    at = geometry.forward(geometry.parameters.values, q)
    if not nominal.any() or not at.ok.any():
        return np.zeros(len(nominal))
    base = at.poses.take(at.ok)
    frames, setup = DeviceFrames(), np.zeros(len(base.position), int)
    twist = geometry.tool_by_parameter(geometry.parameters.values, q[at.ok], base)
    rows = np.concatenate([twist, *frames.columns(base, base, setup)], axis=2).reshape(6 * len(setup), -1)
    rows = rows * np.concatenate([np.array(geometry.parameters.free, float), np.ones(12)])
    rows = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows
    _, s, vt = np.linalg.svd(rows)
    blind = vt[np.sum(s > _BLIND * s[0]) :, : len(nominal)]
    slope = nominal - np.linalg.pinv(blind, rcond=1e-6) @ (blind @ nominal)
    along = float(slope @ nominal)
    return slope / along if along > _BLIND * float(nominal @ nominal) else np.zeros(len(nominal))


def get_blind_limit(poses: PoseSet) -> float:
    """Return the singular value of scaled, whitened columns below which a combination is unidentifiable; 0: rounding alone."""
    return 0.0 if poses.shows_frames else _BARELY


def _require_square(slope: np.ndarray) -> np.ndarray:
    if slope.shape[1] != slope.shape[2]:
        raise InputError(
            "unsupported",
            f"the inverse residual needs as many closure equations as actuated joints, not {slope.shape[1]} for "
            f"{slope.shape[2]}; use the forward or the closure residual",
        )
    return slope


def compute_actuated_positions(poses: PoseSet, slack: np.ndarray) -> np.ndarray:
    """Return actuated positions (N, na) behind the backlash when the tool was measured.

    A joint that approached from below is too low by half of the backlash; one that was read too early has moved further.
    """
    if not slack.any():
        return poses.q
    delay = slack[-1]
    moved = delay * (poses.speed + delay / 2 * (poses.acceleration + delay / 3 * poses.jerk))
    return poses.q - 0.5 * slack[:-1] * poses.approach + moved


def compute_slack_slopes(poses: PoseSet, slack: np.ndarray) -> np.ndarray:
    """Return the derivative of the actuated positions by each joint's backlash and the delay (N, na, na + 1)."""
    sides = -0.5 * poses.approach[:, :, None] * np.eye(poses.na)
    speed = poses.speed + slack[-1] * (poses.acceleration + slack[-1] / 2 * poses.jerk)
    return np.concatenate([sides, speed[:, :, None]], axis=2)


_MAX_ROUNDS = 15  # bounds the time of a fit that does not converge
_MAX_STEPS = 15  # of Gauss-Newton in one round
_RELATIVE_CHANGE_TOL = 1e-2  # of the noise: largest change in the last iteration
_SETTLED_NOISE_CHANGE = 0.2  # relative change of the noise below which an iteration runs to convergence
_SLOW_GAIN = 0.02
"""Gain of the last iteration, for each unknown, below which the fit counts as converged. The sum at the truth is above the
minimum by about one for each unknown, so that predictions still move by a seventh of their standard errors: a curved valley
that poses hardly determine, such as the target's place on a plate that does not turn."""
_FREE_FRAMES = 1e3  # ratio of the prior standard deviations of frames and dimensions
_UNIDENTIFIABLE_PRIOR_WEIGHT = 1e5  # prior of parameters that poses do not identify, in units of 1 / scale
_FULL_STEPS = 4  # undamped Gauss-Newton steps along a curved valley
_MIN_NOISE = 1e-9  # [m or rad], of poses without noise
_BARELY = 1e-2
"""Singular value below which a combination of distances, touches or several devices counts as unidentifiable: the prior has
1e4 times its information. Otherwise the noise of fitted axes, parallel in the file, would
decide which parameters are estimated."""
_BLIND = 1e-9  # of the largest singular value: rounding
_RANK_TOLERANCE = 1e-14  # rounding: the prior has information on every unknown
_RULES = DescentRules(_MAX_STEPS, small_step=1e-3, small_gain=1e-3, first_damping=0.1, growth=5.0, max_trials=10)
"""A step is the last that moves predictions by a thousandth of the noise (rms) or gains a thirtieth of a standard error."""


@dataclass(frozen=True, eq=False)
class WeightedProblem:
    """A `Problem` for `descend`: residuals over their noise, robust weights of the poses, the prior.

    Attributes:
        problem: Residuals and their derivatives.
        robust: Kind of weights.
        noise: Standard deviation of each block of residuals.
        trust: Weight of the prior of each free unknown (f,), in units of 1 / scale.
        homeless: Which free unknowns have no nominal value, or no relevant one (f,).
        weights: Fixed weights of the poses (N,); by default from the residuals of each state.
    """

    problem: Problem
    robust: str
    noise: tuple[float, ...]
    trust: np.ndarray
    homeless: np.ndarray
    weights: np.ndarray | None = None

    @classmethod
    def of(cls, problem: Problem, robust: str, noise: tuple[float, ...]) -> WeightedProblem:
        """Return the problem with the usual prior: dimensions within their scales, frames anywhere."""
        u, free = problem.unknowns, np.flatnonzero(problem.unknowns.free)
        frame = (free >= u.n_geometry) & (free < u.n_geometry + u.n_frames)
        return cls(problem, robust, noise, np.where(frame, 1 / _FREE_FRAMES, 1.0), frame)

    @cached_property
    def free(self) -> np.ndarray:
        """Indices of the free unknowns (f,)."""
        return np.flatnonzero(self.problem.unknowns.free)

    @cached_property
    def scales(self) -> np.ndarray:
        """Their scales (f,)."""
        return self.problem.unknowns.scales[self.free]

    @cached_property
    def nominal(self) -> np.ndarray:
        """Nominal values of all unknowns (P,); identity for the frames, as the target is nominally at the file's tool."""
        u = self.problem.unknowns
        values = np.array([p.value for p in u.rows])
        values[u.n_geometry : u.n_geometry + u.n_frames] = 0.0
        return values

    @property
    def cuts(self) -> list[slice]:
        """The blocks of residuals."""
        ends = np.cumsum((0, *self.problem.blocks))
        return [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]

    @property
    def sigma(self) -> np.ndarray:
        """Noise of every residual (N, m), as stated standard errors weigh the poses."""
        return self.problem.relative * np.repeat(self.noise, self.problem.blocks)

    def whiten(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, m) in units of the noise and weights (N,); poses without a prediction have zero weight."""
        r = np.where(state.ok[:, None], self.problem.residuals(state) / self.sigma, 0.0)
        w = self.weights
        w = compute_robust_weights(self.robust, np.linalg.norm(r, axis=1), r.shape[1]) if w is None else w
        return r, np.where(state.ok, w, 0.0)

    def columns(self, state: FitState, w: np.ndarray) -> np.ndarray:
        """Return whitened derivatives by the free unknowns (N, m, f) at weights (N,)."""
        columns = self.problem.columns(state)[:, :, self.free] / self.sigma[:, :, None] * np.sqrt(w)[:, None, None]
        return np.where(state.ok[:, None, None], columns, 0.0)

    def linearise(self, state: FitState) -> LinearSystem:
        """Return the linear system about a state: the poses' rows, then the prior's."""
        r, w = self.whiten(state)
        columns = self.columns(state, w).reshape(r.size, len(self.free))
        rows = np.vstack([columns, np.diag(self.trust / self.scales)])
        target = np.concatenate([(r * np.sqrt(w)[:, None]).ravel(), -self.compute_prior(state)])
        return factor_system(rows, target, self.scales, _RANK_TOLERANCE)

    def move(self, state: FitState, step: np.ndarray) -> FitState:
        """Return the state after a step (f,)."""
        whole = np.zeros(len(self.problem.unknowns.rows))
        whole[self.free] = step
        return self.problem.moved(state, whole)

    def gain(self, state: FitState, trial: FitState) -> float:
        """Return the decrease of the sum at the state's weights; minus infinity if a pose is lost."""
        if trial.ok.sum() < state.ok.sum():
            return -np.inf
        (before, w), (after, _) = self.whiten(state), self.whiten(trial)
        prior = np.sum(self.compute_prior(state) ** 2) - np.sum(self.compute_prior(trial) ** 2)
        return float(np.sum(w[:, None] * (before**2 - after**2)) + prior)

    def deviation(self, state: FitState) -> np.ndarray:
        """Return how far free unknowns are from nominal (f,); zero for those without a nominal value."""
        frames = [p.value for p in state.frames.parameters()]
        values = np.concatenate([state.theta, frames, state.slack])
        return np.where(self.homeless, 0.0, (values - self.nominal)[self.free])

    def compute_prior(self, state: FitState) -> np.ndarray:
        """Return how far free unknowns are from nominal (f,), in standard deviations of the prior."""
        return self.deviation(state) / self.scales * self.trust

    def estimate_noise(self, state: FitState) -> tuple[float, ...]:
        """Return each block's noise from its residuals and their degrees of freedom."""
        r, w = self.whiten(state)
        hat = self.linearise(state).leverage[: r.size].reshape(r.shape)
        out, used = [], w > 0
        for cut, numbers, s in zip(self.cuts, self.problem.numbers.T, self.noise, strict=True):
            n = float(numbers[used].sum())
            left = max(n - float(hat[used][:, cut].sum()), 1.0)
            if self.robust == "none":
                ratio = np.sqrt(float(np.sum(r[used][:, cut] ** 2)) / left)
            else:
                told = used & (numbers > 0)
                distance = np.linalg.norm(r[told][:, cut], axis=1)
                ratio = estimate_distance_scale(distance, numbers[told]) * np.sqrt(n / left)
            out.append(max(float(s * ratio), _MIN_NOISE))
        return tuple(out)

    def identify(self, state: FitState) -> Identifiability:
        """Return the unknowns that the poses, or prior knowledge of those known beforehand, identify at a state."""
        u = self.problem.unknowns
        columns = self.columns(state, self.whiten(state)[1]).reshape(self.sigma.size, len(self.free))
        priority = u.priority[self.free]
        known = np.diag(1 / self.scales)[priority == KNOWN_BEFOREHAND]
        names, rows = tuple(u.names[k] for k in self.free), np.vstack([columns, known])
        return find_identifiable(rows, names, self.scales, priority, get_blind_limit(self.problem.poses))

    def compute_covariance(self, state: FitState, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return weights (N,), whitened columns of the kept unknowns (N, m, r) and the covariance of the free ones (f, f)."""
        _, w = self.whiten(state)
        columns, cov = self.columns(state, w)[:, :, kept], np.zeros((len(self.free),) * 2)
        if len(kept):
            rows = np.vstack([columns.reshape(-1, len(kept)), np.diag(self.trust[kept] / self.scales[kept])])
            system = factor_system(rows, np.zeros(len(rows)), self.scales[kept], _RANK_TOLERANCE)
            cov[np.ix_(kept, kept)] = system.covariance
        return w, columns, cov


class Rounds(NamedTuple):
    """End of an iterated descent: the state, the problem at the converged noise, number of steps, whether it converged."""

    state: FitState
    weighted: WeightedProblem
    steps: int
    converged: bool


def descend_in_rounds(problem: Problem, robust: str, noise: tuple[float, ...] | None, state: FitState) -> Rounds:
    """Minimise from a state in iterations that estimate noise and weights; a given noise stays fixed.

    The noise of all blocks falls in proportion, by the block that falls least, until that block settles. A block at its own
    noise from the start holds the parameters in a narrow curved valley, along which the other block needs hundreds of steps.
    """
    weighted = WeightedProblem.of(problem, robust, noise or (1.0,) * len(problem.blocks))
    if noise is None:
        r = (problem.residuals(state) / problem.relative)[state.ok]
        first = tuple(max(float(np.sqrt(np.mean(r[:, cut] ** 2))), _MIN_NOISE) for cut in weighted.cuts)
        weighted = replace(weighted, noise=first)
    steps, near, together, gain = 0, False, True, np.inf
    for _ in range(_MAX_ROUNDS):
        end = descend(weighted, state, replace(_RULES, max_steps=_MAX_STEPS if near else 3))
        gain = weighted.gain(state, end.state)
        state, steps = end.state, steps + end.trials
        new = weighted.estimate_noise(state) if noise is None else noise
        change = max(abs(a / b - 1) for a, b in zip(new, weighted.noise, strict=True))
        ratio = max(a / b for a, b in zip(new, weighted.noise, strict=True))
        together = together and abs(ratio - 1) >= _SETTLED_NOISE_CHANGE
        new = tuple(ratio * size for size in weighted.noise) if together else new
        weighted, near = replace(weighted, noise=new), change < _SETTLED_NOISE_CHANGE
        if end.converged and change < _RELATIVE_CHANGE_TOL:
            return Rounds(state, weighted, steps, True)
    return Rounds(state, weighted, steps, near and gain < _SLOW_GAIN * len(weighted.free))


def descend_near(weighted: WeightedProblem, state: FitState, max_steps: int) -> FitState:
    """Return the state after a few steps at a known noise."""
    return descend(weighted, state, replace(_RULES, max_steps=max_steps)).state


def reset_unidentifiable(weighted: WeightedProblem, state: FitState, found: Identifiability) -> FitState:
    """Return the state with unidentifiable parameters at their nominal values; the others are refitted.

    The target's place is included: if it drifted along an unobservable direction, dimensions would drift with it. The weights of
    the poses are fixed: their residuals may grow temporarily, and robust weights would reject all of them.
    """
    u = weighted.problem.unknowns
    tool = u.n_geometry + u.n_device
    of_tool = (weighted.free >= tool) & (weighted.free < tool + u.n_tool)
    place = of_tool & ((weighted.free - tool) % 6 < 3)
    own = found.dropped[(~weighted.homeless | place)[found.dropped]]
    trust, homeless = weighted.trust.copy(), weighted.homeless.copy()
    homeless[own], trust[own] = False, _UNIDENTIFIABLE_PRIOR_WEIGHT
    held = replace(weighted, trust=trust, homeless=homeless, weights=weighted.whiten(state)[1])
    if not np.any(held.deviation(state)[own]):
        return state
    for _ in range(_FULL_STEPS):  # full steps follow a curved valley where steps with a decreasing sum would not
        trial = held.move(state, held.linearise(state).step(0.0)[0])
        if trial.ok.sum() < state.ok.sum():
            break
        state = trial
    state = descend_near(held, state, 2 * _MAX_STEPS)
    step = np.zeros(len(u.rows))
    step[held.free[own]] = -held.deviation(state)[own]
    frames = state.frames.moved(*u.split(step)[1])
    theta, exact = state.theta.copy(), held.free[own]
    exact = exact[exact < u.n_geometry]
    theta[exact] = held.nominal[exact]  # to the last bit, not by a step
    start = state.base if state.ok.all() else None
    return held.problem.place(theta, frames, state.slack, start)
