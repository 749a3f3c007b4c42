"""A geometry, the measuring device's frame and the target's place fitted to measured poses, with uncertainty and sensitivities.

A model needs at least its rank over the joints' range divided by the numbers of one pose, and one pose more. The sensitivity to
a parameter is the tool's displacement and rotation if it alone is wrong (thesis (5.8), Table 5.10).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.calibrate.fit_problem import (
    FitState,
    Problem,
    compute_actuated_positions,
    descend_in_rounds,
    reset_unidentifiable,
)
from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames, compute_mean_rotation
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import (
    PoseErrors,
    PoseSet,
    compute_pose_errors,
    measure_spread,
    measured_by_parameter,
    predict_measured,
)
from tau_dyn.calibrate.new_places import NewPlace, find_new_places
from tau_dyn.calibrate.starting_frames import estimate_campaign_frames, estimate_initial_frames
from tau_dyn.calibrate.unknowns import Identifiability, Unknowns, collect, find_identifiable
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.mechanism import Poses
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Brief

_UNKNOWN_FRAME = 1.0
"""Standard deviation [m or rad] of a frame along a direction that no pose determines: any position in a room, any orientation."""


def count_required_poses(rank: int, per_pose: int) -> int:
    """Return the smallest number of poses that leaves at least one pose's numbers for the estimate of the noise."""
    return -(-rank // per_pose) + 1


def check_count(problem: Problem, what: str) -> None:
    """Refuse fewer measurements than unknowns.

    Raises:
        InputError: Too few poses; the message gives the required number.
    """
    poses, m = problem.poses, int(np.median(problem.numbers.sum(axis=1)))
    if poses.n >= count_required_poses(int(problem.unknowns.free.sum()), m):
        return
    rank = compute_structural_rank(problem)
    needed = count_required_poses(rank, m)
    if poses.n >= needed:
        return
    have = "1 pose is" if poses.n == 1 else f"{poses.n} poses are"
    raise InputError(
        "too_little_data",
        f"{poses.source}: {have} too few for {what}, which has {rank} unknowns that poses can determine, at {m} "
        f"{'number' if m == 1 else 'numbers'} a pose; "
        f"at least {needed} are needed, {3 * needed} are sensible",
    )


def compute_structural_rank(problem: Problem) -> int:
    """Return the rank that random poses within the range of these (widened where they do not move) would give."""
    poses, geometry, unknowns, rng = problem.poses, problem.geometry, problem.unknowns, np.random.default_rng(0)
    low, high = poses.q.min(axis=0), poses.q.max(axis=0)
    width = np.maximum(high - low, 0.1)
    q = 0.5 * (low + high) + width * (rng.random((4 * int(unknowns.free.sum()), poses.na)) - 0.5)
    found = geometry.forward(geometry.parameters.values, q)
    q = q[found.ok]
    rotation = None if poses.rotation is None else np.repeat(np.eye(3)[None], len(q), axis=0)
    number, several = np.arange(len(q)), tuple(poses.targets)
    many = PoseSet(
        q,
        np.zeros((len(q), 3)),
        rotation,
        campaign=number % len(poses.campaigns),
        campaigns=poses.campaigns,
        target=number // len(poses.campaigns) % len(several),
        targets=several,
        device=number // (len(poses.campaigns) * len(several)) % len(poses.devices),
        devices=poses.devices,
        kinds=poses.kinds,
        arc_radius=poses.arc_radius,
        approach=np.sign(rng.standard_normal(q.shape)),
        speed=rng.standard_normal(q.shape),
        loads=poses.loads[number % poses.n],
    )
    wide = replace(problem, poses=many)
    n = unknowns.n_device // 6
    frames = DeviceFrames((IDENTITY,) * n, (IDENTITY,) * (unknowns.n_tool // 6), poses.frame_kinds, (0.0,) * n)
    state = wide.place(geometry.parameters.values, frames, np.zeros(poses.na + 1), None)
    seen = state.frames.measured(state.base, many.setup)
    wide = replace(
        wide, poses=replace(many, position=seen.position, rotation=None if rotation is None else seen.rotation)
    )
    columns = wide.columns(state)[:, :, unknowns.free]
    names = tuple(np.array(unknowns.names)[unknowns.free])
    flat = np.concatenate(columns)
    return find_identifiable(flat, names, unknowns.scales[unknowns.free], unknowns.priority[unknowns.free]).rank


@dataclass(frozen=True, eq=False)
class GeometryFit(Brief):
    """A geometry fitted to poses.

    Attributes:
        geometry: The fitted geometry.
        poses: The poses that it was fitted to.
        unknowns: All unknowns and which of them were free.
        state: Values of the unknowns, and predicted tool poses.
        cov: Covariance of the free unknowns (f, f) in the order of `identifiability.names`; zero where not
            identifiable.
        residuals: Residuals (N, m) of the given kind.
        kind: Kind of the residuals.
        noise: Standard deviation of each block of residuals [m, rad], at poses of the median stated standard error.
        weights: Weights of the poses (N,).
        identifiability: Identifiable unknowns.
        columns: Whitened derivatives of the kept unknowns (N, m, r), for predictions and cross-validation.
        prior_weights: Weights of the prior of the kept unknowns (r,), over their standard deviation.
        prior_pulls: Deviation of these from nominal (r,), in standard deviations.
        steps: Number of Gauss-Newton steps.
        converged: Whether the fit converged.
    """

    geometry: Geometry
    poses: PoseSet
    unknowns: Unknowns
    state: FitState
    cov: np.ndarray
    residuals: np.ndarray
    kind: str
    noise: tuple[float, ...]
    weights: np.ndarray
    identifiability: Identifiability
    columns: np.ndarray
    prior_weights: np.ndarray
    prior_pulls: np.ndarray
    steps: int
    converged: bool

    @property
    def theta(self) -> np.ndarray:
        """The geometry's parameters (p,)."""
        return self.state.theta

    @property
    def frames(self) -> DeviceFrames:
        """Device and target."""
        return self.state.frames

    @property
    def n_estimated(self) -> int:
        """Number of estimated unknowns."""
        return self.identifiability.rank

    @property
    def parameters(self) -> Parameters:
        """All unknowns with values and, where estimated, standard errors."""
        values = np.concatenate([self.theta, [p.value for p in self.frames.parameters()], self.state.slack])
        error = dict(zip(self.identifiability.names, np.sqrt(np.diag(self.cov)), strict=True))
        kept = {self.identifiability.names[k] for k in self.identifiability.kept}
        rows = []
        for p, value, free in zip(self.unknowns.rows, values, self.unknowns.free, strict=True):
            known = p.name in kept
            rows.append(
                replace(
                    p,
                    value=float(value),
                    stderr=float(error[p.name]) if known else None,
                    free=bool(free),
                    origin="calibration" if known else p.origin,
                )
            )
        return Parameters(rows)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of every residual (N, m) by the estimated noise and the poses' stated standard errors."""
        m = self.residuals.shape[1]
        relative = self.poses.relative_errors(m) if self.kind == "forward" else np.ones((self.poses.n, m))
        return relative * np.repeat(self.noise, m // len(self.noise))

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residuals, at least one."""
        return max(self.n_numbers - self.n_estimated, 1)

    @property
    def spread(self) -> float:
        """Rms distance from their middle [m] of the measured positions, or of the predicted ones if not measured."""
        if self.poses.as_poses().measures_poses:
            return self.poses.as_poses().spread
        if not self.poses.of_encoders.any():
            return measure_spread(self.state.base.position[self.state.ok])
        q = compute_actuated_positions(self.poses, self.state.slack)
        tool = self.geometry.under(self.poses.loads).forward(self.theta, q)
        return measure_spread(tool.poses.position[tool.ok])

    @property
    def numbers(self) -> np.ndarray:
        """Independent numbers of each pose's residuals (N,)."""
        n, m = self.residuals.shape
        return self.poses.count_numbers(m) if self.kind == "forward" else np.full(n, m)

    @property
    def n_numbers(self) -> int:
        """Number of independent measured coordinates."""
        return int(self.numbers.sum())

    def interval(self, parameter: Parameter, share: float = 0.95) -> tuple[float, float] | None:
        """Return a parameter's interval (Student's t), None if it was not estimated."""
        if parameter.stderr is None:
            return None
        half = float(stats.t.ppf(0.5 + share / 2, self.dof)) * parameter.stderr
        return parameter.value - half, parameter.value + half

    @property
    def prediction_cov(self) -> np.ndarray:
        """Covariance of the free unknowns (f, f) for predictions at other poses, with the undetermined directions.

        A direction that these poses do not determine is as uncertain as the robot file; there is no prior for frames.
        """
        found, free = self.identifiability, self.unknowns.free
        n_geometry, ends = self.unknowns.n_geometry, self.unknowns.n_frames
        number = np.flatnonzero(free)
        frame = (number >= n_geometry) & (number < n_geometry + ends)
        size = np.where(frame, _UNKNOWN_FRAME, self.unknowns.scales[free])[found.dropped]
        blind = np.zeros((len(number), len(found.dropped)))
        blind[found.dropped, np.arange(len(found.dropped))] = 1.0
        blind[found.kept] = -found.factors
        return self.cov + (blind * size**2) @ blind.T

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the free unknowns (f, f), zero if not estimated."""
        error = np.sqrt(np.diag(self.cov))
        safe = np.where(error > 0, error, 1.0)
        return self.cov / np.outer(safe, safe)

    def predict(self, poses: PoseSet) -> FitState:
        """Return the predicted tool poses at other poses' joint positions, in the robot's base frame."""
        q = compute_actuated_positions(poses, self.state.slack)
        found = predict_measured(self.geometry, self.theta, poses, q)
        return FitState(self.theta, self.frames, found.poses, found.ok, self.state.slack)

    def seen(self, poses: PoseSet, state: FitState | None = None) -> Poses:
        """Return the predicted measurements of other poses."""
        state = self.predict(poses) if state is None else state
        return self.frames.measured(state.base, poses.setup)

    def find_devices(self, poses: PoseSet, base: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation (N, 3, 3) and translation (N, 3) [m] of the robot's base in the frame of each pose's device."""
        turn, shift, _, _ = self.frames.of_each(poses.setup)
        for place in self._find_new_places(poses, base):
            turn[place.own], shift[place.own] = place.frames.device[0]
        return turn, shift

    def errors(self, poses: PoseSet) -> PoseErrors:
        """Return measured minus predicted at other poses; at a place without fitted poses, by the place's other rows."""
        state, known = self.predict(poses), self._is_known(poses)
        own, base = self._keep_known(poses, known), state.base.take(known)
        seen, lengths = self.seen(own, state._replace(base=base)), self.frames.lengths_of(own.setup)
        errors = compute_pose_errors(own, seen, self._target(), own=self.geometry.orients, lengths=lengths)
        if known.all():
            return errors
        position = np.zeros((poses.n, 3))
        position[known] = errors.position
        for place in self._find_new_places(poses, state.base):
            position[place.own] = place.residuals
        relative = poses.relative_errors(6, self.poses)
        of_tool = ~poses.of_encoders
        return PoseErrors(position, None, relative, poses.configuration, errors.oriented, poses.numbers, of_tool)

    def _is_known(self, poses: PoseSet) -> np.ndarray:
        """Return which poses (N,) were measured by devices of the fitted poses."""
        return poses.device < len(self.poses.devices)

    def _keep_known(self, poses: PoseSet, known: np.ndarray) -> PoseSet:
        """Return the poses of known devices alone."""
        return poses if known.all() else poses.take(known).with_devices_of(self.poses)

    def _find_new_places(self, poses: PoseSet, base: Poses) -> list[NewPlace]:
        return find_new_places(poses, base, len(self.poses.devices), self.frames, self.noise[0])

    def _target(self) -> np.ndarray | None:
        """Return the target's orientation (3, 3) on a plate that does not turn: the mean measured orientation."""
        if self.geometry.orients or self.poses.rotation is None:
            return None
        seen = self.frames.measured(self.state.base, self.poses.setup)
        ok = self.state.ok
        return compute_mean_rotation(np.swapaxes(seen.rotation[ok], 1, 2) @ self.poses.rotation[ok])

    def model_error(self, q: np.ndarray, loads: np.ndarray | None = None) -> np.ndarray:
        """Return the standard deviation (N,) [m] of the predicted position from the parameters' uncertainty alone.

        Args:
            q: Actuated positions (N, na) [m or rad].
            loads: Loads at the tool (N, 7) as in `PoseSet`; no load by default.
        """
        geometry = self.geometry if loads is None else self.geometry.under(loads)
        at, base = np.zeros((len(q), 2), int), geometry.forward(self.theta, q).poses
        twist = geometry.tool_by_parameter(self.theta, q, base)
        columns = self._compute_columns(twist, base, at)[:, :3, self.unknowns.free]
        return np.sqrt(np.maximum(np.einsum("nif,fg,nig->n", columns, self.cov, columns), 0.0))

    def compute_prediction_columns(self, poses: PoseSet, base: Poses) -> np.ndarray:
        """Return the derivative (N, 6, f) of the predicted measurement by the free unknowns, in the middle of the backlash.

        Args:
            poses: Measured poses.
            base: Predicted tool poses there (N) in the robot's base frame.
        """
        known, u = self._is_known(poses), self.unknowns
        own, at = self._keep_known(poses, known), base.take(known)
        seen = self.frames.measured(at, own.setup)
        twist = measured_by_parameter(self.geometry, self.theta, own, own.q, at)
        columns = self._compute_columns(twist, at, own.setup)
        first = u.n_geometry + u.n_device + u.n_tool
        columns[:, :, first : first + u.n_length] = self.frames.length_columns(own, seen.position)
        out = np.zeros((poses.n, 6, int(u.free.sum())))
        out[known] = own.project_columns(seen, columns[:, :, u.free])
        if not known.all():
            for place in self._find_new_places(poses, base):
                out[place.own] = self._compute_columns_at(place, base.take(place.own))
        return out

    def _compute_columns_at(self, place: NewPlace, base: Poses) -> np.ndarray:
        """Return prediction columns (n, 6, f) at a new place, with the place refitted to them."""
        setup, u = place.poses.setup, self.unknowns
        seen, twist = (
            place.frames.measured(base, setup),
            self.geometry.under(place.poses.loads).tool_by_parameter(self.theta, place.poses.q, base),
        )
        columns, tool = np.zeros((len(setup), 6, len(u.rows))), u.n_geometry + u.n_device
        columns[:, :, : u.n_geometry] = place.frames.carried(base, twist, setup)
        columns[:, :, tool : tool + u.n_tool] = place.frames.columns(base, seen, setup)[1]
        columns = place.poses.project_columns(seen, columns[:, :, u.free])
        return np.concatenate([place.remove(columns[:, :3]), np.zeros_like(columns[:, 3:])], axis=1)

    def _compute_columns(self, twist: np.ndarray, base: Poses, setup: np.ndarray) -> np.ndarray:
        """Return the derivative (N, 6, P) of the target's pose in the device's frame by all unknowns, but not by lengths.

        Args:
            twist: Twist of the tool in the base's axes per geometry parameter (N, 6, p).
            base: Tool poses (N).
            setup: Device and target of each (N, 2).
        """
        device, tool = self.frames.columns(base, self.frames.measured(base, setup), setup)
        moved = self.frames.carried(base, twist, setup)
        rest = np.zeros((len(twist), 6, self.unknowns.n_length + len(self.state.slack)))
        return np.concatenate([moved, device, tool, rest], axis=2)


def fit_geometry_to_poses(
    geometry: Geometry,
    poses: PoseSet,
    *,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    residual: str = "forward",
    robust: str = "none",
    device: bool = True,
    tool: bool = True,
    backlash: bool = False,
    noise: tuple[float, ...] | None = None,
    start: GeometryFit | FitState | None = None,
    frames: DeviceFrames | None = None,
    apart: tuple[bool, bool] = (False, False),
    prior: Sequence[float] = (),
    what: str = "this model",
) -> GeometryFit:
    """Fit a geometry's parameters, the measuring device's frame and the target's place to measured poses.

    Args:
        geometry: Mechanism with its nominal parameters; those that are not `free` are fixed.
        poses: Measured poses; without orientations only the positions are fitted.
        fix: Names or patterns of parameters that are fixed.
        free: Names or patterns of parameters that are free although they are fixed by default.
        residual: `forward`, `closure` or `inverse`.
        robust: Weights against bad poses: `none`, `huber` or `biweight`.
        device: Whether the device's frame is unknown; otherwise it is the robot's base frame (or `frames`).
        tool: Whether the target's place on the tool is unknown.
        backlash: Whether the actuated joints' backlash is unknown.
        noise: Standard deviations of each block of residuals (position [m], orientation [rad]); estimated unless given.
        start: A fit of the same geometry, or its state, to start from.
        frames: Device and target to start from; found by aligning the nominal robot unless given.
        apart: Whether every campaign has its own device frame, and its own target.
        prior: Standard deviations of the robot's lengths [m] and perhaps angles [rad]; 10 mm and 10 mrad unless given.
        what: The model's name, for messages.

    Raises:
        InputError: Poses that do not fit the robot, too few of them, or a left-handed device.
        CannotAnswer: The geometry cannot reach the poses from the current state of the fit.
    """
    turned = poses.rotation is not None and geometry.orients
    state = _starting_state(geometry, poses, start, frames, device, tool=tool and geometry.orients)
    devices = len(poses.campaigns) if apart[0] else len(state.frames.device)
    tools = len(poses.campaigns) if apart[1] else max(len(poses.targets), len(state.frames.tool))
    several = len(poses.devices) > 1
    devices = len(state.frames.device) if several else devices
    fresh = frames is None and device and poses.as_poses().measures_poses
    fresh = fresh and (devices > len(state.frames.device) or (several and start is None))
    state = state._replace(frames=state.frames.apart(devices, tools))
    if fresh:
        own_frames = estimate_campaign_frames(
            poses.as_poses(), state.base, state.ok, state.frames, turned=turned, tool=tool
        )
        state = state._replace(frames=own_frames)
    own = {"fix": fix, "free": free, "device": device, "tool": tool, "backlash": backlash, "prior": prior}
    problem = Problem(geometry, poses, collect(geometry, state.frames, turned=turned, **own), residual, turned)
    check_count(problem, what)
    return _solve(problem, robust, noise, state, what)


def _solve(problem: Problem, robust: str, noise: tuple[float, ...] | None, state: FitState, what: str) -> GeometryFit:
    """Return the fit of a problem from a state, with unidentifiable unknowns at nominal and the covariance of the others."""
    poses = problem.poses
    state, weighted, steps, converged = descend_in_rounds(problem, robust, noise, state)
    found = weighted.identify(state)
    state = reset_unidentifiable(weighted, state, found)
    if not state.ok.any():
        raise CannotAnswer(
            "no_solution",
            f"{poses.source}: {what} cannot reach the poses from the present estimate",
            "start from a robot file whose dimensions are nearer to the machine's",
        )
    weights, columns, cov = weighted.compute_covariance(state, found.kept)
    return GeometryFit(
        geometry=problem.geometry,
        poses=poses,
        unknowns=problem.unknowns,
        state=state,
        cov=cov,
        residuals=problem.residuals(state),
        kind=problem.kind,
        noise=weighted.noise,
        weights=weights,
        identifiability=found,
        columns=columns,
        prior_weights=(weighted.trust / weighted.scales)[found.kept],
        prior_pulls=weighted.compute_prior(state)[found.kept],
        steps=steps,
        converged=converged,
    )


def _starting_state(
    geometry: Geometry,
    poses: PoseSet,
    start: GeometryFit | FitState | None,
    frames: DeviceFrames | None,
    device: bool,
    *,
    tool: bool,
) -> FitState:
    if isinstance(start, GeometryFit):
        start = start.state
    if start is not None:
        base = start.base if len(start.base.position) == poses.n else None
        found = predict_measured(geometry, start.theta, poses, compute_actuated_positions(poses, start.slack), base)
        return FitState(start.theta, start.frames, found.poses, found.ok, start.slack)
    theta = geometry.parameters.values
    found = predict_measured(geometry, theta, poses, poses.q)
    if frames is None:
        n, kinds = len(poses.frame_kinds), poses.frame_kinds
        known = DeviceFrames((IDENTITY,) * n, kinds=kinds, lengths=(0.0,) * n)
        frames = estimate_initial_frames(poses, found, tool=tool) if device else known
    return FitState(theta, frames, found.poses, found.ok, np.zeros(poses.na + 1))


CHANGE = 5e-5
"""Change of each parameter in the thesis, in its own unit."""


class Sensitivity(NamedTuple):
    """Effect of a change of one parameter on the tool.

    Attributes:
        name: Name of the parameter.
        position: Accumulated tool displacement over all poses, both signs [m], `S_pos` of (5.8).
        rotation: Accumulated tool rotation [rad].
        closure: Accumulated change of the closure residuals [m], nan if the mechanism has no closure.
    """

    name: str
    position: float
    rotation: float
    closure: float


def compute_sensitivities(fitted: GeometryFit, change: float = CHANGE) -> tuple[Sensitivity, ...]:
    """Return every geometric parameter's sensitivity at the fitted poses, to first order.

    Args:
        fitted: A fit.
        change: Change of each parameter, in its unit.
    """
    state = fitted.state
    ok = state.ok
    q, base = fitted.poses.q[ok], state.base.take(ok)
    geometry = fitted.geometry.under(fitted.poses.loads[ok])
    twist = geometry.tool_by_parameter(fitted.theta, q, base)
    closure = geometry.closure(fitted.theta, q, base)
    moved = 2 * change * np.linalg.norm(twist[:, :3], axis=1).sum(axis=0)
    turned = 2 * change * np.linalg.norm(twist[:, 3:], axis=1).sum(axis=0)
    gaps = (
        np.full(len(moved), np.nan) if closure is None else 2 * change * np.abs(closure.by_parameter).sum(axis=(0, 1))
    )
    names = fitted.geometry.parameters.names
    return tuple(
        Sensitivity(n, float(a), float(b), float(c)) for n, a, b, c in zip(names, moved, turned, gaps, strict=True)
    )
