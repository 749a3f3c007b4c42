"""Cross-validation: prediction errors at training poses left out of the fit, and a paired comparison of two models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from tau_dyn.calibrate.fit_problem import FitState, Problem, WeightedProblem, descend_near
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseErrors, PoseSet
from tau_dyn.evidence import Gain

FOLDS = 5  # a common choice between bias and variance (Hastie et al. 2009, section 7.10)
_REFIT_STEPS = 6  # from the whole fit's optimum, which is near
_DRAWS = 1000  # bootstrap draws of an interval; its ends vary by a few per cent of its width
_SIGNIFICANCE_LEVEL = 0.01  # of the paired comparison by which a larger model is chosen
_MIN_RELATIVE_GAIN = 0.02  # share of the weighted rms error that a larger model must take away


def earns_parameters(gain: Gain) -> bool:
    """Return whether a larger model is worth its parameters, by its gain on training poses left out of the refits."""
    significant = gain.p_value is not None and gain.p_value < _SIGNIFICANCE_LEVEL
    return significant and gain.reduction_percent > 100 * _MIN_RELATIVE_GAIN


def split_folds(configuration: np.ndarray, seed: int, many: int = FOLDS) -> list[np.ndarray]:
    """Return the indices of each fold, at random; poses of one configuration (N,) of the joints stay together."""
    n = int(configuration.max(initial=-1)) + 1
    parts = np.array_split(np.random.default_rng(seed).permutation(n), min(many, n))
    return [np.flatnonzero(np.isin(configuration, part)) for part in parts]


def split_in_order(poses: PoseSet) -> list[np.ndarray]:
    """Return the indices of each fold: a block in the file's order of every campaign; neighbours are left out together."""
    parts: list[list[np.ndarray]] = [[] for _ in range(FOLDS)]
    for campaign in np.unique(poses.campaign):
        own = np.flatnonzero(poses.campaign == campaign)
        number = poses.configuration[own]
        for k, block in enumerate(np.array_split(list(dict.fromkeys(number.tolist())), FOLDS)):
            parts[k].append(own[np.isin(number, block)])
    return [np.sort(np.concatenate(part)) for part in parts if sum(map(len, part))]


def cross_validate(fitted: GeometryFit, seed: int = 0, parts: Sequence[np.ndarray] | None = None) -> PoseErrors:
    """Return errors at training poses predicted by refits without their fold; folds at random unless given."""
    poses = fitted.poses
    position = np.full((poses.n, 3), np.nan)
    turned = poses.rotation is not None and fitted.geometry.orients
    rotation = np.full((poses.n, 3), np.nan) if turned else None
    for part in split_folds(poses.configuration, seed) if parts is None else parts:
        rest = np.setdiff1d(np.arange(poses.n), part)
        errors = _without(fitted, rest).errors(poses.take(part))
        position[part] = errors.position
        if rotation is not None and errors.rotation is not None:
            rotation[part] = errors.rotation
    relative = poses.relative_errors(6)
    of_tool = ~poses.of_encoders
    return PoseErrors(position, rotation, relative, poses.configuration, numbers=poses.numbers, of_tool=of_tool)


def _without(fitted: GeometryFit, rest: np.ndarray) -> GeometryFit:
    """Return a fit to some of the poses, started from the fit to all poses and with its noise."""
    poses = fitted.poses.take(rest)
    problem = Problem(
        fitted.geometry, poses, fitted.unknowns, fitted.kind, poses.rotation is not None and fitted.geometry.orients
    )
    s = fitted.state
    state = FitState(s.theta, s.frames, s.base.take(rest), s.ok[rest], s.slack)
    state = descend_near(WeightedProblem.of(problem, "none", fitted.noise), state, _REFIT_STEPS)
    return replace(fitted, poses=poses, state=state)


def compare_paired(small: PoseErrors, large: PoseErrors, seed: int = 0) -> Gain:
    """Return the gain of a larger model over a smaller one on the same poses; those of one joint configuration count as one.

    Position and orientation are weighted as in a Gaussian likelihood, each in units of the larger model's residual. The p-value
    is that of Wilcoxon's one-sided signed-rank test; the interval is by bootstrap over poses.
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
    before, after = (float(np.sqrt(x.squared_distance()[x.counted].mean())) for x in (small, large))
    turned = [None if e.orientation_size is None or not e.oriented else e.orientation_size.rms for e in (small, large)]
    return Gain(before, after, percent, (float(low), float(high)), p, *turned)


_MAX_ERROR_GROWTH = 1.5
"""Largest error with an addition over that without, in folds by order: the largest of many poses varies by a tenth by chance."""


def is_worse_in_order(small: GeometryFit, large: GeometryFit) -> bool:
    """Return whether a larger model predicts blocks of neighbouring poses worse: on the whole, or the worst of them."""
    parts = split_in_order(small.poses)
    a, b = (cross_validate(fitted, parts=parts) for fitted in (small, large))
    noise = b.noise()
    before, after = a.score(noise), b.score(noise)
    return bool(after.sum() > before.sum() or after.max() > _MAX_ERROR_GROWTH**2 * before.max())


def compute_rms_interval(unseen: PoseErrors, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the rms position error [m], by bootstrap over poses."""
    squares = unseen.squared_distance()[unseen.counted]
    draws = np.random.default_rng(seed).integers(0, len(squares), (_DRAWS, len(squares)))
    low, high = np.percentile(np.sqrt(squares[draws].mean(axis=1)), [2.5, 97.5])
    return float(low), float(high)
