"""Poses that do not belong to the others: repeated, flat, grossly wrong, or measured after the device or the target moved.

Gross outliers are found with robust weights. A rigid move of the device, or of the target on the tool, is fitted to the held-out
residuals (Gauss-Newton). It is tested against the covariance of the measurement noise and the fitted parameters (Wald test). Its
gain is that at poses left out of the fit, by their leverages.
References: Seber & Wild 2003, section 5.3 (Wald); Belsley, Kuh & Welsch 1980 (leverage).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.calibrate.crossvalidation import compare_paired
from tau_dyn.calibrate.frames import AXES, DeviceFrames, Frame, compute_rotation_between, is_flat
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseErrors, PoseSet
from tau_dyn.calibrate.model_family import Family, Spec
from tau_dyn.calibrate.model_selection import CandidateModel, Options, fit_geometry, fit_spec
from tau_dyn.estimate import DescentRules, LinearSystem, descend, factor_system
from tau_dyn.evidence import Gain, explain_gain
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.mechanism import Poses
from tau_dyn.message_codes import CodedWarning
from tau_dyn.parameters import Parameter

_TIMES = 6.0
"""Multiple of the distance of one good pose in a hundred; an incomplete model gives tails, but not this far."""


_MAX_DUPLICATE_DISTANCE = 1e-9  # [m] or [rad]: positions of joints that are one pose


def check_spread(family: Family, poses: PoseSet) -> None:
    """Refuse joints that do not move, and positions in a plane if the robot's tool neither turns nor is restricted to a plane.

    All other cases are decided by the rank: a tip held in a hole determines the dimensions by its orientations.

    Raises:
        CannotAnswer: No joint moves, or the positions lie in a plane that the tool should leave.
    """
    if not np.ptp(poses.configuration):
        raise CannotAnswer(
            "poor_excitation",
            f"{poses.source}: the joints have the same positions in all {poses.n} poses, so that no dimension shows",
            "measure poses all over the workspace",
        )
    geometry, poses = family.build(Spec("frames")), poses.as_poses()
    if geometry.orients or not poses.measures_poses or not is_flat(poses.position):
        return
    own = geometry.forward(geometry.parameters.values, poses.q)
    if own.ok.sum() < 3 or is_flat(own.poses.position[own.ok]):
        return
    raise CannotAnswer(
        "poor_excitation",
        f"{poses.source}: all {poses.n} positions lie in one plane, and the joints move the tool out of any plane",
        "check the columns x_tool, y_tool, z_tool; one of them does not follow the tool",
    )


def drop_duplicate_poses(poses: PoseSet) -> tuple[PoseSet, tuple[str, ...]]:
    """Return the poses without those that repeat another's joints and measurement, and a warning that names them.

    The same joints measured again with other noise are a repeated measurement and are kept.
    """
    rotation = np.zeros((poses.n, 9)) if poses.rotation is None else poses.rotation.reshape(-1, 9)
    columns = [poses.q, poses.position, rotation, poses.setup, poses.loads]
    rows = np.round(np.column_stack(columns) / _MAX_DUPLICATE_DISTANCE)
    _, first = np.unique(rows, axis=0, return_index=True)
    if len(first) == poses.n:
        return poses, ()
    left = np.setdiff1d(np.arange(poses.n), first)
    named = ", ".join(poses.names[k] for k in left[:5]) + (f" and {len(left) - 5} more" if len(left) > 5 else "")
    how = "pose repeats" if len(left) == 1 else "poses repeat"
    return poses.take(np.sort(first)), (
        f"{poses.source}: {len(left)} {how} another one exactly and count once ({named})",
    )


def find_outliers(fitted: GeometryFit) -> np.ndarray:
    """Return the indices of poses that a robustly fitted model misses by far more than all others.

    Args:
        fitted: A fit with robust weights.
    """
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(fitted.residuals / fitted.sigma, axis=1)
    return _find_far(distance, distance, fitted.numbers)


def _find_far(distance: np.ndarray, crowd: np.ndarray, m: int | np.ndarray) -> np.ndarray:
    """Return the indices of distances in `m` numbers (N,) that are far larger than those of `crowd`; nan counts as far."""
    good = np.sqrt(stats.chi2.ppf(0.99, m))
    return np.flatnonzero(~(distance < np.maximum(_TIMES * good, 5 * float(np.nanpercentile(crowd, 90)))))


def describe_outliers(poses: PoseSet, fitted: GeometryFit, index: np.ndarray) -> str:
    """Return the warning that names the poses left out."""
    named = _name_poses(poses, index, np.linalg.norm(fitted.residuals[index][:, :3], axis=1))
    what = "pose was" if len(index) == 1 else "poses were"
    kind = "gross outlier" if len(index) == 1 else "gross outliers"
    return f"{len(index)} {what} left out as {kind}: {named}; measure again"


def _name_poses(poses: PoseSet, index: np.ndarray, size: np.ndarray) -> str:
    """Return the names of poses with how far each is off [m]."""
    shown = [f"{poses.names[k]} (off by {1e3 * s:.3g} mm)" for k, s in zip(index[:5], size[:5], strict=True)]
    return ", ".join(shown) + (f" and {len(index) - 5} more" if len(index) > 5 else "")


_MAX_OUTLIER_SHARE = 0.2  # share of the poses above which they are not outliers but another situation
_LOOKS_FOR_OUTLIERS = 3  # fits, each without the outliers of the one before it


def leave_out_outliers(
    family: Family, poses: PoseSet, options: Options, model: str | None
) -> tuple[PoseSet, tuple[str, ...]]:
    """Return training poses without gross outliers, and sentences that name them."""
    said: list[str] = []
    for _ in range(_LOOKS_FOR_OUTLIERS):
        fitted = fit_robustly(family, poses, options, model)
        bad = find_outliers(fitted)
        if not len(bad):
            break
        kept = _keep_campaigns(poses, bad)
        if len(kept) < len(bad):
            said.append(_describe_many(poses, np.setdiff1d(bad, kept)))
            bad = kept
        if not len(bad):
            break
        said.append(describe_outliers(poses, fitted, bad))
        poses = poses.take(np.setdiff1d(np.arange(poses.n), bad))
    return poses, tuple(said)


def _keep_campaigns(poses: PoseSet, bad: np.ndarray) -> np.ndarray:
    """Return the outliers of campaigns in which they are few; many in one campaign are another situation."""
    total = np.bincount(poses.campaign)
    share = np.bincount(poses.campaign[bad], minlength=len(total)) / np.maximum(total, 1)
    return bad[share[poses.campaign[bad]] <= _MAX_OUTLIER_SHARE]


def _describe_many(poses: PoseSet, many: np.ndarray) -> str:
    """Return the sentence about poses far off that are too many to be outliers."""
    names = [poses.campaigns[k] for k in np.unique(poses.campaign[many])]
    where = f" of campaign {', '.join(names)}" if len(poses.campaigns) > 1 else ""
    own = int(np.isin(poses.campaign, np.unique(poses.campaign[many])).sum())
    return (
        f"{poses.source}: {len(many)} of {own} poses{where} are far from what fits the others; none of them was left out, "
        "for so many are no outliers: were frames moved in between, or is the robot another one?"
    )


def leave_out_late_outliers(chosen: CandidateModel, options: Options) -> tuple[PoseSet, tuple[str, ...]]:
    """Return the training poses without the gross outliers that only a good model identifies, and a sentence that names them."""
    first, robust = chosen.fit, replace(options, robust="biweight")
    fitted = fit_geometry(first.geometry, chosen.spec, first.poses, robust, first.state, f"the model {chosen.name}")
    bad = _keep_campaigns(first.poses, find_outliers(fitted))
    if not len(bad):
        return first.poses, ()
    kept = first.poses.take(np.setdiff1d(np.arange(first.poses.n), bad))
    return kept, (describe_outliers(first.poses, fitted, bad),)


def leave_out_held_outliers(fitted: GeometryFit, holdout: PoseSet, still: PoseSet) -> tuple[PoseSet, tuple[str, ...]]:
    """Return held-out poses without gross outliers, and sentences that name them.

    Args:
        fitted: The chosen model.
        holdout: The poses as they were measured.
        still: The poses as they would have been measured without moves of the device or the target.
    """
    errors = fitted.errors(still)
    bad = _find_held_outliers(fitted, still, errors)
    if not len(bad):
        return holdout, ()
    if len(bad) > _MAX_OUTLIER_SHARE * holdout.n:
        return holdout, (
            f"{holdout.source}: {len(bad)} of {holdout.n} held-out poses are far from the fitted model; nothing was left "
            "out, for so many are no outliers: were the device or the target moved, or is the robot another one?",
        )
    named = _name_poses(holdout, bad, errors.distance[bad])
    sentence = f"{len(bad)} of {holdout.n} held-out poses left out as gross outliers: {named}; measure again"
    return holdout.take(np.setdiff1d(np.arange(holdout.n), bad)), (sentence,)


def _find_held_outliers(fitted: GeometryFit, holdout: PoseSet, held: PoseErrors) -> np.ndarray:
    """Return the indices of poses farther off than noise and the parameters' uncertainty explain, by the training rule."""
    train, state = fitted.errors(fitted.poses), fitted.predict(holdout)
    m = 6 if held.rotation is not None and held.oriented else 3
    spare = fitted.dof / fitted.n_numbers
    noise = np.repeat(train.noise(), 3)[:m] / np.sqrt(spare)
    columns = fitted.compute_prediction_columns(holdout, state.base)[:, :m]
    model = np.einsum("nif,fg,nig->ni", columns, fitted.prediction_cov, columns)
    crowd = _measure_distances(train, fitted.poses, fitted.poses, noise**2)
    distance = _measure_distances(held, holdout, fitted.poses, noise**2, model)
    return _find_far(distance, crowd, holdout.count_numbers(m))


def _measure_distances(
    errors: PoseErrors, poses: PoseSet, over: PoseSet, variance: np.ndarray, more: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return errors (N,) in units of their standard deviation; variances (m,) hold at the median stated error of `over`."""
    m = len(variance)
    rows = errors.position if errors.rotation is None or m == 3 else np.hstack([errors.position, errors.rotation])
    return np.sqrt(np.sum(rows**2 / (variance * poses.relative_errors(m, over) ** 2 + more), axis=1))


def fit_robustly(family: Family, poses: PoseSet, options: Options, model: str | None) -> GeometryFit:
    """Return a robust fit of the largest structure that the poses support.

    Raises:
        InputError: The poses support no structure; the error is that of the smallest one, which may also be a CannotAnswer.
    """
    robust = replace(options, robust="biweight")
    specs = [family.spec(model)] if model and model != "auto" else []
    coupled = {a: own for a, own in specs[0].additions.items() if a == "coupling"} if specs else {}
    frames = {"base_frame": family.can_have("base_frame")} if _can_place_each(poses) else {}
    specs += [Spec(s) for s in reversed(family.structures) if s != "paths"]
    fault: Exception | None = None
    for spec in specs:
        try:
            return fit_spec(family, Spec(spec.structure, {**options.additions, **coupled, **frames}), poses, robust)
        except (InputError, CannotAnswer) as error:
            fault = error
    assert fault is not None
    raise fault


def _can_place_each(poses: PoseSet) -> bool:
    """Return whether there are campaigns, each with enough poses for its own device frame."""
    own = len(poses.campaigns) > 1 and len(poses.devices) == 1
    return own and np.bincount(poses.campaign, minlength=len(poses.campaigns)).min() > _MIN_POSES


_SIGNIFICANCE_LEVEL = 1e-3  # of the Wald test, for each campaign's device and target
_MIN_GAIN_PERCENT = 20.0
"""Reduction of the held-out error above which a move is reported: effects that the model lacks look like small moves."""
_MIN_POSES = 6  # poses; with fewer, the six numbers of a frame fit noise
_RULES = DescentRules(20, small_step=1e-6, small_gain=0.0)
"""A rotation by half a radian takes six steps; the last moves residuals by a millionth of the noise."""
_UNDETERMINED_RATIO = 4.0
"""Ratio of variances above which a direction counts as undetermined by the training poses:
the standard error of an axis doubles."""
_MAX_TURN_STDERR = 0.1
"""Standard error of a rotation [rad] above which a move is not linear in the frame, so that it cannot be tested."""
_WEAK_RATIO = 100.0
"""Ratio of variances above which a frame counts as weakly determined: ten standard errors of the held-out poses' own."""
_ALIKE = 10.0  # difference of twice the log-likelihoods below which device and target cannot be distinguished


class MovedFrame(NamedTuple):
    """A move of the device or of the target before the held-out poses.

    Attributes:
        owner: `device` or `target`.
        other: The other one if poses do not distinguish the two, else ''.
        where: Description of the poses.
        move: Translation [m] and rotation vector [rad] with standard errors: of the robot's base in the device's axes, or of the
            target in the tool frame.
        gain: Gain on held-out poses.
        own: Which held-out poses are affected (N,).
        before: Frame of the device or the target when the training poses were measured.
        after: Its frame when the held-out poses were measured.
    """

    owner: str
    other: str
    where: str
    move: tuple[Parameter, ...]
    gain: Gain
    own: np.ndarray
    before: Frame
    after: Frame

    def undo(self, poses: PoseSet) -> PoseSet:
        """Return held-out poses as they would have been measured without the move; a target's needs their orientation."""
        position, rotation = poses.position.copy(), None if poses.rotation is None else poses.rotation.copy()
        own, turn = self.own, self.before.rotation @ self.after.rotation.T
        if self.owner == "device":
            position[own] = self.before.translation + (position[own] - self.after.translation) @ turn.T
            if rotation is not None:
                rotation[own] = turn @ rotation[own]
        elif rotation is not None:
            back = self.after.inverse
            position[own] += rotation[own] @ (back.rotation @ self.before.translation + back.translation)
            rotation[own] = rotation[own] @ back.rotation @ self.before.rotation
        return replace(poses, position=position, rotation=rotation)

    def describe(self) -> str:
        """Return a sentence that describes the move and its remedy."""
        shift, turn = (1e3 * np.linalg.norm([p.value for p in part]) for part in (self.move[:3], self.move[3:]))
        who = f"the {self.owner}" + (f" or the {self.other}" if self.other else "")
        rms = [f"{1e3 * x:.3g} mm" for x in (self.gain.rms_after, self.gain.rms_before)]
        by = f"{shift:.3g} mm" + (f" and {turn:.3g} mrad" if self.move[3:] else "")
        return (
            f"{self.where}: {who} seems to have moved before the held-out poses, by {by}; with that move their rms error "
            f"is {rms[0]} instead of {rms[1]}; fit both files together with a column campaign"
        )


def undo_moves(moved: Sequence[MovedFrame], poses: PoseSet) -> PoseSet:
    """Return held-out poses as they would have been measured without any move."""
    for one in moved:
        poses = one.undo(poses)
    return poses


class _Fit(NamedTuple):
    frames: DeviceFrames
    columns: np.ndarray  # whitened, (N, m, p)
    residuals: np.ndarray  # whitened, (N, m)
    move: np.ndarray
    cov: np.ndarray  # includes directions that the training poses do not determine
    determined: np.ndarray  # covariance without it
    own: np.ndarray  # covariance by the noise of the held-out poses alone


def find_moved_frames(fitted: GeometryFit, holdout: PoseSet) -> tuple[list[MovedFrame], tuple[str, ...]]:
    """Return the significant move of each campaign and target of the held-out poses, and sentences.

    A sentence names the directions along which the training poses do not determine a frame, if held-out poses are off.
    """
    found, said, state = [], [], fitted.predict(holdout)
    known = holdout.device < len(fitted.poses.devices)
    for campaign, target in np.unique(holdout.setup[known], axis=0):
        own = np.all(holdout.setup == (campaign, target), axis=1) & known & state.ok
        sees_poses = fitted.poses.frame_kinds[min(campaign, len(fitted.poses.frame_kinds) - 1)] == "pose"
        if own.sum() >= _MIN_POSES and sees_poses:
            where = (
                f"{holdout.source}, campaign {holdout.campaigns[campaign % len(holdout.campaigns)]}"
                if len(holdout.campaigns) > 1
                else holdout.source
            )
            several = len(holdout.devices) > 1
            where += f", device {holdout.devices[campaign // len(holdout.campaigns)]}" if several else ""
            where += f", target {holdout.targets[target]}" if len(holdout.targets) > 1 else ""
            moved = _find_move(fitted, holdout, own, state.base.take(own), where)
            found += [moved] if isinstance(moved, MovedFrame) else []
            said += [CodedWarning("frame_undetermined", moved)] if isinstance(moved, str) else []
    return found, tuple(said)


def _find_move(
    fitted: GeometryFit, holdout: PoseSet, own: np.ndarray, base: Poses, where: str
) -> MovedFrame | str | None:
    """Return the move of the device or the target of one set-up, the likelier one; None if neither is significant.

    A sentence is returned instead if the training poses do not determine the frame well enough to compare it.
    """
    poses = holdout.take(own)
    both = zip((fitted.frames.device, fitted.frames.tool), poses.setup[0], strict=True)
    start = DeviceFrames(*((frames[min(k, len(frames) - 1)],) for frames, k in both))
    m = 6 if poses.rotation is not None and fitted.geometry.orients else 3
    sigma = poses.relative_errors(m, fitted.poses) * np.repeat(np.array(fitted.noise)[: m // 3], 3)
    before = _compute_residuals(start, poses, base, sigma)
    owners = ("device", "target") if fitted.geometry.orients else ("device",)
    fits = {owner: _fit_move(owner, start, fitted, poses, base, sigma) for owner in owners}
    sizes = {owner: float(np.sum(fit.residuals**2)) for owner, fit in fits.items()}
    owner = min(sizes, key=lambda o: sizes[o])
    fit = fits[owner]
    p_value, p_determined = (_test_move(fit.move, cov) for cov in (fit.cov, fit.determined))
    p_value = p_value if np.sqrt(fit.cov.diagonal()[3:].max(initial=0.0)) < _MAX_TURN_STDERR else 1.0
    level = _SIGNIFICANCE_LEVEL / len(owners)
    after = _leave_out_each(fit)
    gain = compare_paired(_as_errors(before * sigma, poses), _as_errors(after * sigma, poses))
    moved = not explain_gain(gain) and gain.reduction_percent > _MIN_GAIN_PERCENT and p_determined < level
    if not (moved and p_value < level):
        axes = _list_undetermined(fit)
        off = moved or (bool(axes) and stats.chi2.sf(np.sum(before**2), before.size) < level)
        return _describe_undetermined(owner, axes or AXES[: len(fit.move)], where) if off else None
    near = [o for o in owners if o != owner and before.size * np.log(sizes[o] / max(sizes[owner], 1e-300)) < _ALIKE]
    error = np.sqrt(np.maximum(np.diag(fit.cov), 0.0))
    move = tuple(
        Parameter(f"{owner}_moved.{axis}", float(x), "m" if i < 3 else "rad", stderr=float(e))
        for i, (axis, x, e) in enumerate(zip(AXES, fit.move, error, strict=False))
    )
    pair = [(f.device if owner == "device" else f.tool)[0] for f in (start, fit.frames)]
    return MovedFrame(owner, near[0] if near else "", where, move, gain, own, *pair)


def _test_move(move: np.ndarray, cov: np.ndarray) -> float:
    """Return the p-value of a move (p,) by Wald's test, in units in which its entries are equally uncertain."""
    size = np.sqrt(np.maximum(np.diag(cov), 1e-300))
    scaled = cov / np.outer(size, size)
    return float(stats.chi2.sf((move / size) @ np.linalg.pinv(scaled, hermitian=True) @ (move / size), len(move)))


def _list_undetermined(fit: _Fit) -> list[str]:
    """Return the axes along which the training poses do not determine the frame, or far worse than the held-out ones do."""
    whole, known, own = (np.diag(cov) for cov in (fit.cov, fit.determined, fit.own))
    open_ = (whole > _UNDETERMINED_RATIO * known) | (whole > _WEAK_RATIO * own)
    return [axis for axis, is_open in zip(AXES, open_, strict=False) if is_open]


def _describe_undetermined(owner: str, axes: Sequence[str], where: str) -> str:
    """Return the sentence of a frame that cannot be compared along axes."""
    return (
        f"{where}: the {owner} cannot be compared with where it was along {', '.join(axes)}: the training poses do not determine "
        "it there, so a move and wrong dimensions look the same; train on poses that turn every joint"
    )


@dataclass(frozen=True, eq=False)
class _MoveProblem:
    """The move of one frame as a least-squares problem; its states are `DeviceFrames`, its residuals whitened (N, m)."""

    owner: str
    poses: PoseSet
    base: Poses
    sigma: np.ndarray

    @property
    def free(self) -> int:
        """Components of the frame that poses can determine: a target without orientation has only its position."""
        return 6 if self.owner == "device" or self.sigma.shape[1] == 6 else 3

    def columns(self, frames: DeviceFrames) -> np.ndarray:
        """Return whitened derivatives (N, m, free)."""
        zero, m = np.zeros(len(self.base.position), int), self.sigma.shape[1]
        device, tool = frames.columns(self.base, frames.measured(self.base, zero), zero)
        return (device if self.owner == "device" else tool)[:, :m, : self.free] / self.sigma[:, :, None]

    def residuals(self, frames: DeviceFrames) -> np.ndarray:
        """Return whitened measured minus predicted."""
        return _compute_residuals(frames, self.poses, self.base, self.sigma)

    def linearise(self, state: DeviceFrames) -> LinearSystem:
        """Return the linear system about frames."""
        return factor_system(
            self.columns(state).reshape(-1, self.free), self.residuals(state).ravel(), np.ones(self.free)
        )

    def move(self, state: DeviceFrames, step: np.ndarray) -> DeviceFrames:
        """Return moved frames."""
        whole = np.concatenate([step, np.zeros(6 - self.free)])
        return state.moved(*((whole, np.zeros(6)) if self.owner == "device" else (np.zeros(6), whole)))

    def gain(self, state: DeviceFrames, trial: DeviceFrames) -> float:
        """Return the decrease of the sum of squares."""
        return float(np.sum(self.residuals(state) ** 2) - np.sum(self.residuals(trial) ** 2))


def _fit_move(
    owner: str, start: DeviceFrames, fitted: GeometryFit, poses: PoseSet, base: Poses, sigma: np.ndarray
) -> _Fit:
    """Return the least-squares move of one frame, with the covariance from noise and the fitted parameters."""
    problem = _MoveProblem(owner, poses, base, sigma)
    frames = descend(problem, start, _RULES).state
    residuals, columns, free = problem.residuals(frames), problem.columns(frames), problem.free
    (first, last) = (start.device[0], frames.device[0]) if owner == "device" else (start.tool[0], frames.tool[0])
    turn = last.rotation @ first.rotation.T if owner == "device" else first.rotation.T @ last.rotation
    move = np.concatenate(
        [last.translation - first.translation, compute_rotation_between(turn[None], np.eye(3)[None])[0]]
    )
    inverse = np.linalg.pinv(columns.reshape(-1, free))
    by_parameters = inverse @ _compute_prediction_columns(fitted, poses, base, sigma)
    scale = max(1.0, float(np.sum(residuals**2)) / max(residuals.size - free, 1))
    own = scale * inverse @ inverse.T
    determined, cov = (own + by_parameters @ known @ by_parameters.T for known in (fitted.cov, fitted.prediction_cov))
    return _Fit(frames, columns, residuals, move[:free], cov, determined, own)


def _compute_residuals(frames: DeviceFrames, poses: PoseSet, base: Poses, sigma: np.ndarray) -> np.ndarray:
    """Return whitened measured minus predicted (N, m)."""
    seen = frames.measured(base, np.zeros(len(base.position), int))
    out = [poses.position - seen.position]
    if sigma.shape[1] == 6:
        assert poses.rotation is not None
        out.append(compute_rotation_between(poses.rotation, seen.rotation))
    return np.concatenate(out, axis=1) / sigma


def _compute_prediction_columns(fitted: GeometryFit, poses: PoseSet, base: Poses, sigma: np.ndarray) -> np.ndarray:
    """Return the whitened predictions' derivative by the fit's free unknowns (N m, f)."""
    columns = fitted.compute_prediction_columns(poses, base)[:, : sigma.shape[1]]
    return (columns / sigma[:, :, None]).reshape(sigma.size, -1)


def _leave_out_each(fit: _Fit) -> np.ndarray:
    """Return each pose's residuals (N, m) of the move fitted without it: `(I - H_ii)^-1 r_i`."""
    n, m, p = fit.columns.shape
    q = np.linalg.qr(fit.columns.reshape(n * m, p))[0].reshape(n, m, p)
    return np.linalg.solve(np.eye(m) - q @ np.swapaxes(q, 1, 2), fit.residuals[:, :, None])[:, :, 0]


def _as_errors(errors: np.ndarray, poses: PoseSet) -> PoseErrors:
    rotation = errors[:, 3:] if errors.shape[1] == 6 else None
    return PoseErrors(errors[:, :3], rotation, poses.relative_errors(6), poses.configuration)
