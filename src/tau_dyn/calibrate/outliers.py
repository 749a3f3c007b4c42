"""Poses that are grossly wrong: found with robust weights, named, and left out."""

from __future__ import annotations

import numpy as np
from scipy import stats

from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.pose_set import PoseSet

_TIMES = 6.0
"""How many times the distance that one good pose in a hundred has; a model that lacks something leaves tails, not this."""


def find_outliers(fitted: GeometryFit) -> np.ndarray:
    """Return the indices of poses that a robustly fitted model misses by far more than all others.

    Args:
        fitted: A fit with robust weights.
    """
    m = fitted.residuals.shape[1]
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(fitted.residuals / fitted.sigma, axis=1)
    good = float(np.sqrt(stats.chi2.ppf(0.99, m)))
    crowd = float(np.nanpercentile(distance, 90))
    return np.flatnonzero(~(distance < max(_TIMES * good, 5 * crowd)))


def describe_outliers(poses: PoseSet, fitted: GeometryFit, index: np.ndarray) -> str:
    """Return the warning that names the poses left out."""
    size = np.linalg.norm(fitted.residuals[index][:, :3], axis=1)
    shown = [f"{poses.names[k]} (off by {1e3 * s:.3g} mm)" for k, s in zip(index[:5], size[:5], strict=True)]
    more = f" and {len(index) - 5} more" if len(index) > 5 else ""
    what = "pose was" if len(index) == 1 else "poses were"
    kind = "gross outlier" if len(index) == 1 else "gross outliers"
    return f"{len(index)} {what} left out as {kind}: {', '.join(shown)}{more}; measure again"
