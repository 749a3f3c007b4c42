"""Information of every candidate pose: the fit's own analytic derivatives, in units of the measuring noise.

A candidate gives `m` numbers with covariance `S_k`; their derivative by the parameters is `J_k`, columns times the parameters'
scales. The information of a set of poses is `M = sum J_k' S_k^-1 J_k`. A fit that weighs all poses equally has

    P = A^-1 B A^-1,   A = sum J_k' W J_k,   B = sum J_k' W S_k W J_k,

`W` from the mean noise of each device; `P = M^-1` where a device measures all poses equally well, or where `refine` weighs each
by its own noise: a camera measures depth ten times worse than the lateral position. Distances and touches show no frame: the
tool's accuracy is then that after the best motion of the whole robot, and touches alone leave its size open as well. Reference:
Hollerbach, Khalil & Gautier 2016, 6.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.calibrate.fit_problem import FitState, Problem, get_blind_limit
from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseSet, predict_measured
from tau_dyn.calibrate.unknowns import STRUCTURAL, Identifiability, Unknowns, collect, find_identifiable
from tau_dyn.estimate import DescentRules, LinearSystem, descend, factor_system
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses

_SEEN = 1e-3
"""Part of the largest tool shift below which a parameter that no candidate identifies is left out of the warning."""


@dataclass(frozen=True, eq=False)
class PoseDesign:
    """Candidate poses and the information of each.

    Attributes:
        geometry: The mechanism at its nominal parameters.
        frames: Device and target, as far as they are known beforehand.
        poses: Candidates (N), the device or fixture and the target of each.
        workspace: Positions where accuracy counts (M, na).
        tool: Tool poses there in the robot's base frame (N).
        unknowns: All parameters that the fit may change.
        found: Identifiability of these with all candidates together.
        slopes: Derivatives of the measured numbers by the identifiable parameters, times scale (N, m, r).
        noise: Covariance of the measured numbers (N, m, m).
        places: The target's shift [m] at the poses where accuracy counts, by the identifiable parameters, times scale (M, 3, r).
        turns: The tool's turn [rad] there (M, 3, r), empty if the tool does not turn.
        untold: Parameters that no candidate identifies although they move the tool where accuracy counts: name and
            rms shift [m] that an error of one scale leaves.
        weighted: Whether the fit will weigh every pose by its own covariance.
    """

    geometry: Geometry
    frames: DeviceFrames
    poses: PoseSet
    workspace: np.ndarray
    tool: Poses
    unknowns: Unknowns
    found: Identifiability
    slopes: np.ndarray
    noise: np.ndarray
    places: np.ndarray
    turns: np.ndarray
    untold: tuple[tuple[str, float], ...]
    weighted: bool = False

    @property
    def q(self) -> np.ndarray:
        """Actuated positions of the candidates (N, na)."""
        return self.poses.q

    @property
    def n(self) -> int:
        """Number of candidates."""
        return self.poses.n

    @property
    def numbers(self) -> np.ndarray:
        """Independent numbers that each candidate gives (N,)."""
        return self.poses.count_numbers(self.slopes.shape[1])

    @property
    def per_pose(self) -> int:
        """Numbers that one pose gives, the median of different ones."""
        return int(np.median(self.numbers))

    @property
    def variance(self) -> float:
        """Mean variance of a measurement [m^2]: of a position, or of the number along its direction."""
        return float(np.mean(np.trace(self.noise[:, :3, :3], axis1=1, axis2=2) * self.poses.numbers / 3))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the identifiable parameters (r,)."""
        return tuple(self.found.names[k] for k in self.found.kept)

    @property
    def scales(self) -> np.ndarray:
        """Their scales (r,)."""
        return self.unknowns.scales[self.unknowns.free][self.found.kept]

    @property
    def counts(self) -> np.ndarray:
        """Whether each identifiable parameter moves the tool (r,); the place of a fixture does not."""
        return np.any(self.places != 0, axis=(0, 1))

    def whitened(self) -> np.ndarray:
        """Return each candidate's derivative in units of the noise by which the fit weighs it (N, m, r)."""
        if not self.weighted:
            return self.slopes / self.sigma()[:, :, None]
        return np.linalg.solve(np.linalg.cholesky(self.noise), self.slopes)

    def sigma(self) -> np.ndarray:
        """Return the standard deviation by which a fit weighs each number (N, m): equal for all poses of a device, by block."""
        return _mean_sigma(self.noise, self.poses.device)

    def covariance(self, index: np.ndarray, prior: float = 0.0) -> np.ndarray:
        """Return the covariance (r, r), in scales, of the parameters that a fit to these candidates estimates.

        `prior` is the singular value that every parameter has before any pose; it keeps sets that lack rank comparable.
        """
        before = prior**2 * np.eye(self.slopes.shape[2])
        if self.weighted:
            own = np.linalg.solve(np.linalg.cholesky(self.noise[index]), self.slopes[index])
            return np.linalg.pinv(np.einsum("nir,nis->rs", own, own) + before, rcond=1e-14, hermitian=True)
        sigma = self.sigma()[index]
        weighed = self.slopes[index] / sigma[:, :, None]
        spread = self.noise[index] / (sigma[:, :, None] * sigma[:, None])
        blind = (
            get_blind_limit(self.poses) ** 2 * np.eye(len(before)) + before
        )  # a lack of rank is uncertain, not exact
        a = np.einsum("nir,nis->rs", weighed, weighed) + blind
        b = np.einsum("nir,nij,njs->rs", weighed, spread, weighed, optimize=True) + blind
        back = np.linalg.pinv(a, rcond=1e-14, hermitian=True)
        return back @ b @ back


def build_design(
    geometry: Geometry,
    candidates: np.ndarray | PoseSet,
    noise: tuple[float, ...] | np.ndarray,
    *,
    frames: DeviceFrames | None = None,
    workspace: np.ndarray | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    device: bool = True,
    tool: bool = True,
    weighted: bool = False,
) -> PoseDesign:
    """Return the information of candidate poses about a mechanism.

    Args:
        geometry: Mechanism at its nominal parameters.
        candidates: Actuated positions (N, na) [m or rad], or poses that state the device and the target of each as well.
        noise: Standard deviation of positions [m] and, where orientations are measured, of these [rad]; or
            covariances (N, m, m).
        frames: Device and target as far as they are known; identity otherwise.
        workspace: Positions (M, na) where accuracy counts; the candidates by default.
        fix: Names or patterns of parameters that stay.
        free: Names or patterns of parameters freed in addition.
        device: Whether the device's frame is unknown.
        tool: Whether the target's place on the tool is unknown.
        weighted: Whether the fit will weigh every pose by its own covariance (`refine`) instead of all equally (`fit`).

    Raises:
        InputError: Candidates or noise that are no numbers, or that the nominal robot cannot reach.
    """
    poses = candidates if isinstance(candidates, PoseSet) else PoseSet(candidates, np.zeros((len(candidates), 3)))
    q = _checked_q(geometry, poses.q)
    cov = _covariances(noise, len(q))
    turned = geometry.orients and cov.shape[1] == 6
    cov = cov if turned else cov[:, :3, :3]
    frames = frames if frames is not None else DeviceFrames()
    unknowns = collect(geometry, frames, fix=fix, free=free, device=device, tool=tool, turned=turned)
    if not unknowns.free.any():
        raise InputError(
            "invalid_value", "no parameter is free that poses could determine; free some, or leave `fix` out"
        )
    slopes, base, ok = _slopes(geometry, frames, unknowns, poses, turned)
    if not ok.all():
        raise InputError(
            "unreachable",
            f"the nominal robot reaches {int(ok.sum())} of {len(q)} candidate poses (the first that "
            "it does not is number "
            f"{int(np.argmin(ok)) + 1}); leave the others out",
        )
    names = tuple(name for name, may in zip(unknowns.names, unknowns.free, strict=True) if may)
    scales = unknowns.scales[unknowns.free]
    slopes = _without_rounding(slopes, scales)
    flat = (slopes / _mean_sigma(cov, poses.device)[:, :, None]).reshape(-1, slopes.shape[2])
    found = find_identifiable(flat, names, scales, unknowns.priority[unknowns.free], get_blind_limit(poses))
    if not found.rank:
        raise InputError(
            "invalid_value", "no parameter is free that poses could determine; free some, or leave `fix` out"
        )
    there = q if workspace is None else _checked_q(geometry, workspace)
    if poses.shows_frames:
        shifts, _, good = _slopes(geometry, frames, unknowns, _without_values(there), geometry.orients)
    else:
        sized = not poses.hides_size(geometry.position_units)
        shifts, good = _target_slopes(geometry, frames, unknowns, there, sized=sized)
    shifts = shifts[good] * scales
    kept = slopes[:, :, found.kept] * scales[found.kept]
    told = shifts[:, :, found.kept]
    untold = _untold(shifts, found, scales)
    return PoseDesign(
        geometry,
        frames,
        poses,
        there[good],
        base,
        unknowns,
        found,
        kept,
        cov,
        told[:, :3],
        told[:, 3:],
        untold,
        weighted,
    )


def _without_values(q: np.ndarray) -> PoseSet:
    return PoseSet(q, np.zeros((len(q), 3)))


def _slopes(
    geometry: Geometry, frames: DeviceFrames, unknowns: Unknowns, poses: PoseSet, turned: bool
) -> tuple[np.ndarray, Poses, np.ndarray]:
    """Return derivatives of the measured numbers by the free unknowns (N, m, f), tool poses, and which of them exist."""
    theta = geometry.parameters.values
    predicted = predict_measured(geometry, theta, poses, poses.q)
    seen = frames.measured(predicted.poses, poses.setup)
    if poses.shows_frames:
        expected = poses.expect(seen)
        poses = replace(poses, position=expected.position, rotation=expected.rotation if turned else None)
    state = FitState(theta, frames, predicted.poses, predicted.ok, np.zeros(poses.na + 1))
    columns = Problem(geometry, poses, unknowns, "forward", turned).columns(state)
    return columns[:, :, unknowns.free], predicted.poses, predicted.ok


def _target_slopes(
    geometry: Geometry, frames: DeviceFrames, unknowns: Unknowns, q: np.ndarray, *, sized: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives of the first target's pose in the base frame by the free unknowns (N, 6, f), and where it exists (N,).

    No measurement shows where the base is, so the motion of the whole robot that changes its positions least is taken out, and
    its size if it is not `sized`.
    """
    theta, setup = geometry.parameters.values, np.zeros(len(q), int)
    found = geometry.forward(theta, q)
    own = DeviceFrames((IDENTITY,), frames.tool[:1])
    seen = own.measured(found.poses, setup)
    moved = own.carried(found.poses, geometry.tool_by_parameter(theta, q, found.poses), setup)
    rigid, target = own.columns(found.poses, seen, setup)
    columns = np.zeros((len(q), 6, len(unknowns.rows)))
    first = unknowns.n_geometry + unknowns.n_device
    columns[:, :, : unknowns.n_geometry], columns[:, :, first : first + 6] = moved, target
    columns = columns[:, :, unknowns.free]
    if not sized:
        growth = np.concatenate([seen.position, np.zeros_like(seen.position)], axis=1)
        rigid = np.concatenate([rigid, growth[:, :, None]], axis=2)
    ok = found.ok
    step = np.linalg.lstsq(rigid[ok, :3].reshape(-1, rigid.shape[2]), columns[ok, :3].reshape(-1, columns.shape[2]))[0]
    return columns - rigid @ step, ok


def _without_rounding(slopes: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return derivatives (N, m, f) with columns that are zero but for rounding set to zero."""
    size = np.abs(slopes).max(axis=(0, 1)) * scales
    return np.where(size > STRUCTURAL * size.max(initial=0.0), slopes, 0.0)


def _untold(shifts: np.ndarray, found: Identifiability, scales: np.ndarray) -> tuple[tuple[str, float], ...]:
    """Return parameters that move the tool where accuracy counts (shifts (M, m, f) per scale) but are not identifiable."""
    if not len(found.dropped):
        return ()
    factors = found.factors * scales[found.dropped] / scales[found.kept][:, None]
    rest = shifts[:, :3, found.dropped] - shifts[:, :3, found.kept] @ factors
    size = np.sqrt(np.mean(np.sum(rest**2, axis=1), axis=0))
    largest = float(np.sqrt(np.mean(np.sum(shifts[:, :3] ** 2, axis=1), axis=0)).max())
    return tuple((found.names[k], float(s)) for k, s in zip(found.dropped, size, strict=True) if s > _SEEN * largest)


def _mean_sigma(cov: np.ndarray, device: np.ndarray) -> np.ndarray:
    """Return the root mean variance (N, m) of each device's positions and of its orientations."""
    variances, out = np.diagonal(cov, axis1=1, axis2=2), np.zeros(cov.shape[:2])
    for number in np.unique(device):
        own = device == number
        mean = variances[own].mean(axis=0)
        out[own] = np.concatenate([np.full(3, np.sqrt(mean[k : k + 3].mean())) for k in range(0, len(mean), 3)])
    return out


def _checked_q(geometry: Geometry, q: np.ndarray) -> np.ndarray:
    q = np.asarray(q, float)
    na = len(geometry.actuated)
    if q.ndim != 2 or q.shape[1] != na or not len(q):
        raise InputError(
            "wrong_shape",
            f"candidate poses must be positions (N, {na}) of {', '.join(geometry.actuated)}, not {q.shape}",
        )
    bad = np.flatnonzero(~np.isfinite(q).all(axis=1))
    if len(bad):
        raise InputError("bad_sample", f"candidate pose {bad[0] + 1} holds a number that is not finite; leave it out")
    return q


def _covariances(noise: tuple[float, ...] | np.ndarray, n: int) -> np.ndarray:
    if isinstance(noise, np.ndarray) and noise.ndim == 3:
        good = noise.shape[0] == n and noise.shape[1:] in ((3, 3), (6, 6)) and np.isfinite(noise).all()
        if not good or not (np.linalg.eigvalsh(noise) > 0).all():
            raise InputError(
                "wrong_shape",
                f"covariances of the noise must be finite, positive and ({n}, 3, 3) or ({n}, 6, 6), not {noise.shape}",
            )
        return noise
    sigma = np.atleast_1d(np.asarray(noise, float))
    if sigma.shape not in ((1,), (2,)) or not np.isfinite(sigma).all() or not (sigma > 0).all():
        raise InputError(
            "invalid_value",
            "the noise is a standard deviation of positions [m] and perhaps one of orientations "
            f"[rad], above zero, not {noise}",
        )
    return np.repeat(np.diag(np.repeat(sigma**2, 3))[None], n, axis=0)


_STEPS = 20  # Gauss-Newton steps; bounds the time
_AT_REST = 1e-6
"""Longest last step, in standard errors."""


def refine(fitted: GeometryFit, covariance: np.ndarray) -> GeometryFit:
    """Return a fit with every pose weighed by its own covariance.

    Args:
        fitted: A fit with forward residuals.
        covariance: Covariance of the measured numbers (N, m, m), as `Device.covariance` gives it; orientations are left out if
            the fit does not use them.

    Raises:
        InputError: Covariances that do not belong to these poses, or a fit with other residuals.
    """
    n, m = fitted.residuals.shape
    if fitted.kind != "forward":
        raise InputError(
            "unsupported", f"only forward residuals can be weighed by a device's covariance, not {fitted.kind} ones"
        )
    if covariance.ndim != 3 or len(covariance) != n or covariance.shape[1] < m or not np.isfinite(covariance).all():
        raise InputError("wrong_shape", f"the fit has {n} poses of {m} numbers, the covariances are {covariance.shape}")
    problem = Problem(fitted.geometry, fitted.poses, fitted.unknowns, fitted.kind, m == 6)
    kept = np.flatnonzero(fitted.unknowns.free)[fitted.identifiability.kept]
    weighed = _CovarianceProblem(problem, np.linalg.cholesky(covariance[:, :m, :m]), kept)
    rules = DescentRules(_STEPS, small_step=_AT_REST * float(np.sqrt(len(kept) / (n * m))), small_gain=0.0)
    end = descend(weighed, fitted.state, rules)
    system, (flat, r) = weighed.linearise(end.state), weighed.whiten(end.state)
    cov = np.zeros_like(fitted.cov)
    of_noise = float(r @ r) / max(len(r) - len(kept), 1)
    cov[np.ix_(fitted.identifiability.kept, fitted.identifiability.kept)] = system.covariance * of_noise
    columns = np.zeros((n, m, len(kept)))
    columns[end.state.ok] = flat.reshape(-1, m, len(kept))
    residuals = problem.residuals(end.state)
    return replace(fitted, state=end.state, cov=cov, residuals=residuals, columns=columns, converged=end.converged)


@dataclass(frozen=True, eq=False)
class _CovarianceProblem:
    """Residuals `S_k^-1/2 r_k` of a fit's kept unknowns, as a least-squares problem."""

    problem: Problem
    root: np.ndarray
    kept: np.ndarray

    def whiten(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        """Return columns (rows, r) and residuals (rows,) of the poses that are predicted."""
        ok = state.ok
        columns = np.linalg.solve(self.root[ok], self.problem.columns(state)[ok][:, :, self.kept])
        r = np.linalg.solve(self.root[ok], self.problem.residuals(state)[ok][:, :, None])
        return columns.reshape(-1, len(self.kept)), r.ravel()

    def linearise(self, state: FitState) -> LinearSystem:
        """Return the linear system about a state."""
        return factor_system(*self.whiten(state), self.problem.unknowns.scales[self.kept])

    def move(self, state: FitState, step: np.ndarray) -> FitState:
        """Return the state after a step of the kept unknowns."""
        whole = np.zeros(len(self.problem.unknowns.rows))
        whole[self.kept] = step
        return self.problem.moved(state, whole)

    def gain(self, state: FitState, trial: FitState) -> float:
        """Return the decrease of the sum; the loss of a pose does not count as a decrease."""
        if trial.ok.sum() < state.ok.sum():
            return -np.inf
        return self._cost(state) - self._cost(trial)

    def _cost(self, state: FitState) -> float:
        r = np.linalg.solve(self.root[state.ok], self.problem.residuals(state)[state.ok][:, :, None])
        return float(np.sum(r**2))
