"""How well a model predicts poses that it has not seen, by folds of the training poses, and whether a larger one does better."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.calibrate.fit_problem import FitState, Problem, WeightedProblem, descend_near
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.pose_errors import PoseErrors
from tau_dyn.calibrate.pose_set import PoseSet

FOLDS = 5  # a common choice between bias and variance (Hastie et al. 2009, section 7.10)
_REFIT_STEPS = 6  # from the whole fit's optimum, which is near
_DRAWS = 1000  # bootstrap draws of an interval; its ends vary by a few per cent of its width
_SIGNIFICANCE_LEVEL = 0.01  # of the paired comparison by which a larger model is chosen
_MIN_RELATIVE_GAIN = 0.02  # share of the weighted rms error that a larger model must take away


class CrossValidationGain(NamedTuple):
    """What one model gains over another on poses that neither has seen.

    Attributes:
        before: Rms position error of the smaller model [m].
        after: Of the larger one [m].
        percent: Reduction of the weighted error, position and orientation each in units of the larger model's [%].
        ci95: Its interval, by bootstrap over poses [%].
        p_value: Chance of so much gain where there is none (Wilcoxon's signed ranks, one-sided).
        orientation_before: Rms orientation error of the smaller model [rad], None where orientation is not predicted.
        orientation_after: Of the larger one.
    """

    before: float
    after: float
    percent: float
    ci95: tuple[float, float]
    p_value: float
    orientation_before: float | None = None
    orientation_after: float | None = None

    @property
    def is_significant(self) -> bool:
        """Whether the larger model has earned its parameters."""
        return self.p_value < _SIGNIFICANCE_LEVEL and self.percent > 100 * _MIN_RELATIVE_GAIN

    def to_dict(self) -> dict[str, object]:
        """Return it as results spell it."""
        return {
            "rms_before": self.before,
            "rms_after": self.after,
            "orientation_rms_before": self.orientation_before,
            "orientation_rms_after": self.orientation_after,
            "reduction_percent": self.percent,
            "ci95": list(self.ci95),
            "p_value": self.p_value,
        }


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of predictions at poses that were left out of the fit.

    Attributes:
        position: (N, 3) [m].
        rotation: (N, 3) [rad], None where orientation is not predicted.
        relative: Stated standard errors of the measurements over their median (N, 6), None where none are stated.
        configuration: Which poses have the same joint positions (N,), None where all differ; such poses are no independent ones.
    """

    position: np.ndarray
    rotation: np.ndarray | None
    relative: np.ndarray | None = None
    configuration: np.ndarray | None = None

    def noise(self) -> tuple[float, float]:
        """Return the rms of a coordinate [m] and of an angle [rad] (1 where there is none), at the median stated error."""
        return _rms(self._weighted(0)) or 1.0, _rms(self._weighted(1)) or 1.0

    def score(self, noise: tuple[float, float]) -> np.ndarray:
        """Return squared errors of each configuration in units of the noise [m, rad]; unpredicted ones as the worst."""
        parts = [np.sum((self._weighted(k) / noise[k]) ** 2, axis=1) for k in (0, 1)]
        squares = _with_worst(parts[0] + parts[1])
        return squares if self.configuration is None else np.bincount(self.configuration, squares)

    def squared_distance(self) -> np.ndarray:
        """Return squared position errors (N,) [m^2]; a pose without prediction counts as the worst."""
        return _with_worst(np.sum(self.position**2, axis=1))

    def _weighted(self, block: int) -> np.ndarray:
        errors = (self.position, self.rotation)[block]
        if errors is None:
            return np.zeros_like(self.position)
        return errors if self.relative is None else errors / self.relative[:, 3 * block : 3 * block + 3]

    @property
    def rms(self) -> float:
        """Root mean square of the position errors [m]."""
        return float(np.sqrt(np.nanmean(np.sum(self.position**2, axis=1))))

    @property
    def orientation_rms(self) -> float | None:
        """Root mean square of the orientation errors [rad], None where orientation is not predicted."""
        return None if self.rotation is None else float(np.sqrt(np.nanmean(np.sum(self.rotation**2, axis=1))))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def _with_worst(squares: np.ndarray) -> np.ndarray:
    worst = np.nanmax(squares) if np.isfinite(squares).any() else 1.0
    return np.where(np.isfinite(squares), squares, worst)


def split_folds(configuration: np.ndarray, seed: int, many: int = FOLDS) -> list[np.ndarray]:
    """Return the indices of each fold, at random; poses of one configuration (N,) of the joints stay together."""
    n = int(configuration.max(initial=-1)) + 1
    parts = np.array_split(np.random.default_rng(seed).permutation(n), min(many, n))
    return [np.flatnonzero(np.isin(configuration, part)) for part in parts]


def cross_validate(fitted: GeometryFit, seed: int = 0) -> HeldOutErrors:
    """Return errors at training poses predicted by refits without their fold."""
    poses = fitted.poses
    position = np.full((poses.n, 3), np.nan)
    turned = poses.rotation is not None and fitted.geometry.orients
    rotation = np.full((poses.n, 3), np.nan) if turned else None
    for part in split_folds(poses.configuration, seed):
        rest = np.setdiff1d(np.arange(poses.n), part)
        errors = _without(fitted, rest).errors(poses.take(part))
        position[part] = errors.position
        if rotation is not None and errors.rotation is not None:
            rotation[part] = errors.rotation
    return HeldOutErrors(position, rotation, poses.relative_errors(6), poses.configuration)


def _without(fitted: GeometryFit, rest: np.ndarray) -> GeometryFit:
    """Return a fit to some of the poses, from where the whole one stands and with its noise."""
    poses = fitted.poses.take(rest)
    problem = Problem(
        fitted.geometry, poses, fitted.unknowns, fitted.kind, poses.rotation is not None and fitted.geometry.orients
    )
    s = fitted.state
    state = FitState(s.theta, s.frames, s.base.take(rest), s.ok[rest], s.slack)
    state = descend_near(WeightedProblem.of(problem, "none", fitted.noise), state, _REFIT_STEPS)
    return replace(fitted, poses=poses, state=state)


def summarise_held_out_errors(errors: PoseErrors, poses: PoseSet, *, oriented: bool) -> HeldOutErrors:
    """Return the errors at held-out poses as `HeldOutErrors`."""
    rotation = errors.rotation if oriented else None
    return HeldOutErrors(errors.position, rotation, poses.relative_errors(6), poses.configuration)


def compare_paired(small: HeldOutErrors, large: HeldOutErrors, seed: int = 0) -> CrossValidationGain:
    """Return what a larger model gains over a smaller one on the same poses; those of one joint configuration count as one.

    Position and orientation count as in a Gaussian likelihood: each in units of what the larger model leaves of it.
    """
    noise = large.noise()
    a, b = small.score(noise), large.score(noise)
    difference = a - b
    p = 1.0
    if np.any(difference != 0):  # signed ranks: a few poses near a singularity do not decide
        p = float(stats.wilcoxon(difference, alternative="greater").pvalue)  # type: ignore[union-attr]
    draws = np.random.default_rng(seed).integers(0, len(a), (_DRAWS, len(a)))
    ratio = 100 * (1 - np.sqrt(b[draws].sum(axis=1) / np.maximum(a[draws].sum(axis=1), 1e-300)))
    low, high = np.percentile(ratio, [2.5, 97.5])
    percent = 100 * (1 - float(np.sqrt(b.sum() / max(float(a.sum()), 1e-300))))
    before, after = (float(np.sqrt(x.squared_distance().mean())) for x in (small, large))
    return CrossValidationGain(
        before, after, percent, (float(low), float(high)), p, small.orientation_rms, large.orientation_rms
    )


def compute_rms_interval(unseen: HeldOutErrors, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the rms position error [m], by bootstrap over poses."""
    squares = unseen.squared_distance()
    draws = np.random.default_rng(seed).integers(0, len(squares), (_DRAWS, len(squares)))
    low, high = np.percentile(np.sqrt(squares[draws].mean(axis=1)), [2.5, 97.5])
    return float(low), float(high)
