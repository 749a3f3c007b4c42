"""Screening of model additions before any is fitted: an F test on the reduction of the residuals by their columns.

Residuals and new columns are projected off the fitted parameters (`I - Q Q'`, `Q` a basis of their columns), so a guideway's
offset is not mistaken for a wave. A cyclic error is searched for at all periods from one and a half ranges down to
`_MIN_PERIOD_M`; the p-value is corrected for their number. Reference: Draper & Smith 1998, 6; Scargle 1982.

A joint whose encoder counts all of another joint's motion (an elbow driven from the base: the encoder measures against the
ground, `x_3 = q_3 +- q_2`) causes position errors of a large part of the reach, and no fit of dimensions converges
from there. So each pair is tried with either sign at the file's dimensions, with device and targets fitted in closed form.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.calibrate.conventions import measure_misfit
from tau_dyn.calibrate.fit_problem import compute_actuated_positions, compute_size_slope, compute_slack_slopes
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseSet, measured_by_joint, measured_by_parameter
from tau_dyn.calibrate.model_family import Family, Spec

_MIN_RELATIVE_MISFIT = 0.01
"""Rms position error of the robot file, relative to the spread of the poses, above which a coupling is searched for."""
_MAX_ERROR_LEFT = 0.3
"""Rms error with the best coupling, relative to that without a coupling and to that with the next best one, below which the
best coupling is accepted."""


class UnitCoupling(NamedTuple):
    """A coupling that fits far better than no coupling and than any other.

    Attributes:
        name: Name of the coupling in a model's name, such as `j3=-j2`.
        error: Rms error of the positions with it [m].
        without: Rms error without a coupling [m].
        next_best: Rms error with the next best coupling [m].
    """

    name: str
    error: float
    without: float
    next_best: float

    def describe(self, source: str, model: str) -> str:
        """Return a message with the coupling's meaning and the remedy, for the poses' source and the requested model."""
        joint, other = re.split("=-?", self.name)
        sign = "-" if "=-" in self.name else "+"
        taken = "it is part of every model" if model == "auto" else f"add it to the model: {model}+coupling:{self.name}"
        return (
            f"{source}: {joint} seems to count the motion of {other} too ({joint} {sign} {other}): with that the robot file "
            f"misses the positions by {1e3 * self.error:.3g} mm, without by {1e3 * self.without:.3g} mm, with the next best "
            f"coupling by {1e3 * self.next_best:.3g} mm; {taken}"
        )


def find_unit_coupling(family: Family, poses: PoseSet) -> UnitCoupling | None:
    """Return the unit coupling between two joints that the poses support, or None if no coupling is clearly the best."""
    poses = poses.as_poses()
    if not poses.measures_poses:
        return None
    without = _measure_misfit(family, poses, Spec("frames"))
    if not without > _MIN_RELATIVE_MISFIT * poses.spread:
        return None
    names = [pair.replace("/", sign) for pair in family.can_have("coupling") for sign in ("=", "=-")]
    errors = np.array([_measure_misfit(family, poses, Spec("frames", {"coupling": (name,)})) for name in names])
    if len(errors) < 2:
        return None
    first, second = np.argsort(errors)[:2]
    if errors[first] < _MAX_ERROR_LEFT * min(without, errors[second]):
        return UnitCoupling(names[first], float(errors[first]), without, float(errors[second]))
    return None


def _measure_misfit(family: Family, poses: PoseSet, spec: Spec) -> float:
    """Return the trimmed rms error of the positions [m], inf if fewer than half of the poses are reached."""
    geometry = family.build(spec)
    found = geometry.forward(geometry.parameters.values, poses.q)
    return measure_misfit(poses, found.poses, found.ok, turns=geometry.orients).position


_MIN_PERIOD_M = 0.004  # [m]: finer than any rack's teeth
_MAX_RELATIVE_PERIOD = 1.5  # of the range travelled
_OVERSAMPLED = 4  # frequencies per resolution cell of the range travelled, so that no peak falls between two
SIGNIFICANCE_LEVEL = 1e-3  # per addition, before a fit and its cross-validation decide


class AdditionTest(NamedTuple):
    """Test of a model addition on the residuals of a fit.

    Attributes:
        addition: Kind of the addition.
        joints: Joints that have the addition.
        p_value: P-value of the reduction, corrected for the number of tests.
        share: Share of the residual sum of squares that the addition explains.
        period: Period of a cyclic error [m or rad], 0 otherwise.
    """

    addition: str
    joints: tuple[str, ...]
    p_value: float
    share: float
    period: float = 0.0


def screen_additions(fitted: GeometryFit, family: Family, spec: Spec) -> list[AdditionTest]:
    """Return the additions that reduce the residuals significantly, in order of increasing p-value.

    Elastic drives are also tested all together: they carry the same load, so that one alone may explain the deflection of all.
    """
    rest = _ProjectedResidual(fitted)
    hints = []
    for addition in family.screened:
        places = [joint for joint in family.can_have(addition) if joint not in _list_taken(spec, addition)]
        together = [tuple(places)] if addition == "elastic" and len(places) > 1 else []
        for joints in [*((joint,) for joint in places), *together]:
            if addition == "periodic2" and joints[0] not in spec.additions.get("periodic", ()):
                continue
            if addition.startswith("periodic"):
                hint = _periodic(rest, family, joints[0], addition)
            else:
                hint = _plain(rest, family, spec, addition, joints)
                if hint is not None and addition == "coupling":
                    hint = hint._replace(p_value=min(1.0, hint.p_value * len(family.can_have(addition))))
            if hint is not None and hint.p_value < SIGNIFICANCE_LEVEL:
                hints.append(hint)
    return sorted(hints, key=lambda h: (h.p_value, -h.share))


_ALIKE = 10.0  # difference of twice the log-likelihoods below which two explanations cannot be distinguished
_MIN_TRAVEL = {"rad": 0.1, "m": 0.01}
"""Range of positions below which a joint counts as not moved: a turn about its axis may be a deflection of its support."""


def find_rivals(
    fitted: GeometryFit, family: Family, spec: Spec, addition: str, places: tuple[str, ...]
) -> tuple[tuple[str, str], ...]:
    """Return the other effects that explain the residuals as well as an addition, as addition and place.

    The dimensions that the model does not free are one of them, as `structure` and the name of the largest structure. An elastic
    base under the robot's weight is another one, as `gravity` of `base`; it is the only one if the addition's joints hardly move.

    Args:
        fitted: The fit without the addition.
        family: The robot's models.
        spec: The model without the addition.
        addition: Kind of the addition.
        places: One or several places of the addition; `JOINT/OTHER` for a coupling.
    """
    travel = np.ptp(fitted.poses.q, axis=0)
    units = dict(zip(fitted.geometry.actuated, zip(travel, fitted.geometry.position_units, strict=True), strict=True))
    sizes = [[units[joint] for joint in place.split("/") if joint in units] for place in places]
    if all(any(size < _MIN_TRAVEL[unit] for size, unit in own) for own in sizes):
        return (("gravity", "base"),)
    rest = _ProjectedResidual(fitted)
    found = [h for h in screen_additions(fitted, family, spec) if len(h.joints) == 1]
    hints = {(h.addition, h.joints[0]): h for h in found if h.addition != addition or h.joints[0] not in places}
    hint = next((h for h in found if (h.addition, h.joints) == (addition, places)), None)
    if hint is None and addition.startswith("periodic"):
        return ()
    own = _build_columns(rest, family, spec, hint or AdditionTest(addition, places, 1.0, 0.0))
    q = compute_actuated_positions(fitted.poses, fitted.state.slack)
    others = {place: _build_columns(rest, family, spec, hint) for place, hint in hints.items()}
    base = rest.twists(family.move_with_base(q, fitted.state.base))
    others |= {("gravity", "base"): base} if base.shape[1] else {}
    widest = [name for name in family.structures if name != "paths"][-1]
    if widest != spec.structure:
        others[("structure", widest)] = _build_new_columns(rest, family, Spec(widest, spec.additions))
    return tuple(place for place, columns in others.items() if rest.compare_nested(columns, own) < _ALIKE)


def _build_columns(rest: _ProjectedResidual, family: Family, spec: Spec, hint: AdditionTest) -> np.ndarray:
    """Return the whitened columns (rows, k) of an addition; those of a wave at its period."""
    if not hint.period:
        return _build_plain_columns(rest, family, spec, hint.addition, hint.joints)
    poses, a = rest.fitted.poses, family.joints.index(hint.joints[0])
    phase = 2 * np.pi * poses.q[:, [a]] / hint.period
    q = compute_actuated_positions(poses, rest.fitted.state.slack)
    slope = _by_joint(rest.fitted, q, a)
    return rest.twists(slope * np.hstack([np.sin(phase), np.cos(phase)])[:, None])


def _by_joint(fitted: GeometryFit, q: np.ndarray, a: int) -> np.ndarray:
    """Return the derivative of the measured quantities by one actuated joint (N, 6, 1)."""
    return measured_by_joint(fitted.geometry, fitted.theta, fitted.poses, q, fitted.state.base)[:, :, a : a + 1]


def _list_taken(spec: Spec, addition: str) -> tuple[str, ...]:
    """Return the places at which a model has an addition; `JOINT/OTHER` for couplings."""
    return tuple(joint.replace("=-", "/").replace("=", "/") for joint in spec.additions.get(addition, ()))


class _ProjectedResidual:
    """Whitened residual of a fit, and the projection of columns off the fitted parameters.

    The prior's rows follow those of the poses. Without them an effect would count as explained by dimensions that are further
    from the robot file than the prior permits: a Delta's dimensions must be 10 mm off to act like its elastic drives.
    """

    def __init__(self, fitted: GeometryFit) -> None:
        self.fitted = fitted
        self.sigma = fitted.sigma
        self.q = np.linalg.qr(np.vstack([np.concatenate(fitted.columns), np.diag(fitted.prior_weights)]))[0]
        flat = np.where(fitted.state.ok[:, None], fitted.residuals / self.sigma, 0.0).ravel()
        self.r = self.free(np.concatenate([flat, -fitted.prior_pulls]))
        self.total = float(self.r @ self.r)
        self.left = fitted.n_numbers - fitted.n_estimated

    def free(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (rows, ...) without their part in the fitted parameters' span."""
        return columns - self.q @ (self.q.T @ columns)

    def twists(self, base: np.ndarray) -> np.ndarray:
        """Return whitened rows (rows, k) of tool twists (N, 6, k) in the robot's base frame."""
        state, poses = self.fitted.state, self.fitted.poses
        moved = self.fitted.frames.carried(state.base, base, poses.setup)
        if self.fitted.kind == "forward":
            moved = poses.project_columns(self.fitted.frames.measured(state.base, poses.setup), moved)
        return self.whiten(moved)

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Return whitened rows (rows, k) of derivatives (N, 3 or 6, k); a new effect has no part in the prior's rows."""
        own = columns[:, : self.sigma.shape[1]] / self.sigma[:, :, None]
        return np.vstack([own.reshape(self.sigma.size, -1), np.zeros((len(self.fitted.prior_pulls), columns.shape[2]))])

    def span(self, columns: np.ndarray) -> np.ndarray:
        """Return a basis (rows, r) of the part of columns (rows, k) that is orthogonal to the fitted parameters."""
        norm = np.linalg.norm(columns, axis=0)
        basis, s, _ = np.linalg.svd(self.free(columns / np.where(norm > 0, norm, 1.0)), full_matrices=False)
        return basis[:, s > 1e-6]

    def compare_nested(self, columns: np.ndarray, more: np.ndarray) -> float:
        """Return the increase of twice the log-likelihood by `more` columns in addition to `columns` (rows, k)."""
        left = [
            self.total - float(np.sum((self.span(c).T @ self.r) ** 2)) for c in (columns, np.hstack([columns, more]))
        ]
        return self.left * float(np.log(max(left[0], 1e-300) / max(left[1], 1e-300)))

    def judged(self, gain: float, k: int, tries: int = 1) -> tuple[float, float]:
        """Return the p-value and the share of a reduction by `k` columns; 1 and 0 if the residual is zero."""
        if self.total <= 0:
            return 1.0, 0.0
        share = gain / self.total
        left = max(self.left - k, 1)
        f = (share / k) / max((1 - share) / left, 1e-300)
        p = float(stats.f.sf(f, k, left))
        return min(1.0, p * tries), share


def _plain(
    rest: _ProjectedResidual, family: Family, spec: Spec, addition: str, joints: tuple[str, ...]
) -> AdditionTest | None:
    basis = rest.span(_build_plain_columns(rest, family, spec, addition, joints))
    if not basis.shape[1] or rest.left <= basis.shape[1]:
        return None
    p, share = rest.judged(float(np.sum((basis.T @ rest.r) ** 2)), basis.shape[1])
    return AdditionTest(addition, joints, p, share)


def _build_plain_columns(
    rest: _ProjectedResidual, family: Family, spec: Spec, addition: str, joints: tuple[str, ...]
) -> np.ndarray:
    """Return the whitened columns (rows, k) of an addition without a period."""
    fitted = rest.fitted
    q = compute_actuated_positions(fitted.poses, fitted.state.slack)
    if addition == "backlash":
        a = family.joints.index(joints[0])
        slope = _by_joint(fitted, q, a)
        return rest.twists(slope * (-0.5 * fitted.poses.approach[:, None, a : a + 1]))
    if addition == "delay":
        by_joint = measured_by_joint(fitted.geometry, fitted.theta, fitted.poses, q, fitted.state.base)
        return rest.twists(by_joint @ compute_slack_slopes(fitted.poses, fitted.state.slack)[:, :, -1:])
    return _build_new_columns(rest, family, spec.plus(addition, joints))


def _build_new_columns(rest: _ProjectedResidual, family: Family, spec: Spec) -> np.ndarray:
    """Return the whitened columns (rows, k) of the parameters of a larger model that a fit does not have."""
    fitted = rest.fitted
    q = compute_actuated_positions(fitted.poses, fitted.state.slack)
    larger = family.build(spec)
    old = dict(zip(fitted.geometry.parameters.names, fitted.theta.tolist(), strict=True))
    names = larger.parameters.names
    theta = np.array([old.get(p.name, p.value) for p in larger.parameters])
    new = [k for k, name in enumerate(names) if name not in old]
    columns = rest.twists(measured_by_parameter(larger, theta, fitted.poses, q, fitted.state.base)[:, :, new])
    touches = np.repeat(fitted.poses.touches, fitted.sigma.shape[1])
    if touches.any():
        whitened = np.where(fitted.state.ok[:, None], fitted.residuals / fitted.sigma, 0.0).ravel()
        columns[: len(touches)] += np.outer(touches * whitened, compute_size_slope(larger, q)[new])
    return columns


def _periodic(rest: _ProjectedResidual, family: Family, joint: str, addition: str = "periodic") -> AdditionTest | None:
    fitted = rest.fitted
    a = family.joints.index(joint)
    x = fitted.poses.q[:, a]
    span = float(np.ptp(x))
    if span <= 0 or rest.left <= 4:
        return None
    q = compute_actuated_positions(fitted.poses, fitted.state.slack)
    slope = _by_joint(fitted, q, a)
    frequencies = np.arange(1 / (_MAX_RELATIVE_PERIOD * span), 1 / _MIN_PERIOD_M, 1 / (_OVERSAMPLED * span))
    gains = np.concatenate(
        [_reductions(rest, slope, x, part) for part in np.array_split(frequencies, len(frequencies) // 300 + 1)]
    )
    best = int(np.argmax(gains))
    p, share = rest.judged(float(gains[best]), 2, len(frequencies))
    return AdditionTest(addition, (joint,), p, share, float(1 / frequencies[best]))


def _reductions(rest: _ProjectedResidual, slope: np.ndarray, x: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """Return the reduction of the residual sum of squares by a wave of each frequency."""
    phase = 2 * np.pi * x[:, None] * frequencies
    s, c = (rest.free(rest.twists(slope * wave[:, None])) for wave in (np.sin(phase), np.cos(phase)))
    ss, cc, sc = np.sum(s * s, axis=0), np.sum(c * c, axis=0), np.sum(s * c, axis=0)
    rs, rc = rest.r @ s, rest.r @ c
    det = ss * cc - sc**2
    good = det > 1e-6 * ss * cc
    return np.where(good, (cc * rs**2 - 2 * sc * rs * rc + ss * rc**2) / np.where(good, det, 1.0), 0.0)


def find_strongest_periods(fitted: GeometryFit, family: Family, joints: tuple[str, ...]) -> dict[str, float]:
    """Return the period [m] at each joint that reduces the residuals of a fit most."""
    rest = _ProjectedResidual(fitted)
    found = {joint: _periodic(rest, family, joint) for joint in joints}
    return {joint: hint.period for joint, hint in found.items() if hint is not None}


_STEP_PLACES = 60  # places in the file tried first for a move; every pose about the best one follows
_MIN_STEP_POSES = 6  # poses on either side; with fewer, the six numbers of a frame fit noise
_MIN_STEP_GAIN_PERCENT = 20.0
"""Reduction of the rms residual above which a move is reported: effects that the model lacks look like small moves."""


class MoveWithin(NamedTuple):
    """A move of the device or of the target while the poses were measured.

    Attributes:
        owner: `device` or `target`.
        where: The first pose after the move.
        shift: Distance [m].
        percent: Reduction of the weighted rms residual [%].
    """

    owner: str
    where: str
    shift: float
    percent: float

    def describe(self) -> str:
        """Return a sentence that describes the move and its remedy."""
        return (
            f"from {self.where} on, the {self.owner} seems to sit elsewhere, by {1e3 * self.shift:.2g} mm; with that "
            f"the rms residual falls by {self.percent:.0f} %, more than with any other effect, and while it is not fitted none "
            "is confirmed; mark the poses before and after by a column campaign"
        )


def _try_step(
    rest: _ProjectedResidual, owner: str, columns: np.ndarray, place: int
) -> tuple[float, float, MoveWithin, int]:
    """Return the p-value, minus the share, the move and the place of a step from a pose on; columns (N, m, p) of its frame."""
    poses = rest.fitted.poses
    freed = rest.free(rest.whiten(np.where(np.arange(poses.n)[:, None, None] >= place, columns, 0.0)))
    move = np.linalg.lstsq(freed, rest.r, rcond=1e-6)[0]
    gain = rest.total - float(np.sum((rest.r - freed @ move) ** 2))
    p, share = rest.judged(gain, len(move), 2 * (poses.n - 2 * _MIN_STEP_POSES + 1))
    percent = 100 * (1 - np.sqrt(max(1 - share, 0.0)))
    return p, -share, MoveWithin(owner, poses.names[place], float(np.linalg.norm(move[:3])), percent), place


def find_move_within(fitted: GeometryFit, family: Family, spec: Spec) -> MoveWithin | None:
    """Return the move during the measurement, if it explains the residuals of poses in order better than any addition."""
    poses, m = fitted.poses, fitted.sigma.shape[1]
    if not poses.as_poses().measures_poses or len(np.unique(poses.setup, axis=0)) > 1 or poses.n <= 2 * _MIN_STEP_POSES:
        return None
    rest = _ProjectedResidual(fitted)
    seen = fitted.frames.measured(fitted.state.base, poses.setup)
    device, tool = (
        poses.project_columns(seen, columns) for columns in fitted.frames.columns(fitted.state.base, seen, poses.setup)
    )
    both = {"device": device[:, :m], "target": tool[:, :m, : 3 if m == 3 else 6]}
    first, last = _MIN_STEP_POSES, poses.n - _MIN_STEP_POSES
    places = np.unique(np.linspace(first, last, _STEP_PLACES).astype(int)).tolist()
    found = [_try_step(rest, owner, columns, place) for owner, columns in both.items() for place in places]
    best, gap = min(found, key=lambda one: one[:2])[2:], -(-(last - first) // _STEP_PLACES)
    near = range(max(first, best[1] - gap), min(last, best[1] + gap) + 1)
    found += [_try_step(rest, best[0].owner, both[best[0].owner], place) for place in near]
    p, share, step, _ = min(found, key=lambda one: one[:2])
    if not p < SIGNIFICANCE_LEVEL or step.percent < _MIN_STEP_GAIN_PERCENT:
        return None
    others = screen_additions(fitted, family, spec)
    return step if not others or (p, share) < (others[0].p_value, -others[0].share) else None
