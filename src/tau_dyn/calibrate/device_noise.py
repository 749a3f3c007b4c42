"""Accuracy of each of several devices and fixtures: a fit weights a wire, a tracker and a pin by their own residuals.

The variance of a device is the sum of its squared residuals over their degrees of freedom. Devices of one kind are equally
accurate unless an F test separates them. Weights and fit are computed in turn (iterated weighted least squares; Carroll & Ruppert
1988, 2).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.model_family import Family
from tau_dyn.calibrate.model_selection import Options
from tau_dyn.calibrate.outliers import fit_robustly

_MAX_FITS = 6  # fits; each brings the weights nearer by a factor of about ten
_SETTLED = 0.02  # relative change of a device's standard error at which weights stay
_SIGNIFICANCE_LEVEL = 1e-3  # of the F test of a device against the others of its kind
_MIN_NUMBERS = 6.0  # numbers beyond the parameters' share; with fewer, the scatter is known to no better than a third


class _Scatter(NamedTuple):
    """Sum of squared residuals of devices, in units of the fit's noise, and their degrees of freedom."""

    square: np.ndarray
    left: np.ndarray


def weigh_devices(family: Family, poses: PoseSet, options: Options) -> PoseSet:
    """Return the poses with the standard error of each device over that of the first; one device stays as it is."""
    if len(poses.devices) == 1:
        return poses
    errors = np.array(poses.device_errors or (1.0,) * len(poses.devices))
    for _ in range(_MAX_FITS):
        scatter = _measure_scatter(fit_robustly(family, poses, options, None))
        new = _pool(poses, scatter._replace(square=scatter.square * errors**2))
        change = np.abs(new / new[0] / (errors / errors[0]) - 1).max()
        errors = new / new[0]
        poses = replace(poses, device_errors=tuple(float(x) for x in errors))
        if change < _SETTLED:
            break
    return poses


def _pool(poses: PoseSet, scatter: _Scatter) -> np.ndarray:
    """Return the standard error of each device (devices,): that of its kind, or its own if it differs significantly."""
    out = np.ones(len(poses.devices))
    for kind in set(poses.kinds):
        alike = np.array([one == kind for one in poses.kinds]) & (scatter.left >= _MIN_NUMBERS)
        while alike.any():
            square, left = scatter.square[alike].sum(), scatter.left[alike].sum()
            odd = (
                [(_test_alike(scatter, alike, k), k) for k in np.flatnonzero(alike).tolist()] if alike.sum() > 1 else []
            )
            if odd and min(odd)[0] < _SIGNIFICANCE_LEVEL / len(odd):
                k = min(odd)[1]
                out[k], alike[k] = np.sqrt(scatter.square[k] / scatter.left[k]), False
                continue
            few = np.array([one == kind for one in poses.kinds]) & (scatter.left < _MIN_NUMBERS)
            out[alike | few] = np.sqrt(square / left)
            break
    return np.maximum(out, 1e-6 * out.max())


def _test_alike(scatter: _Scatter, alike: np.ndarray, k: int) -> float:
    """Return the p-value, two-sided, of a device's scatter against that of the others of its kind."""
    others = alike & (np.arange(len(alike)) != k)
    own, rest = (
        (float(scatter.square[mask].sum()), float(scatter.left[mask].sum()))
        for mask in (np.arange(len(alike)) == k, others)
    )
    ratio = stats.f(own[1], rest[1])
    f = own[0] / own[1] / max(rest[0] / rest[1], 1e-300)
    return 2 * float(min(ratio.cdf(f), ratio.sf(f)))


def _measure_scatter(fitted: GeometryFit) -> _Scatter:
    """Return each device's sum of squared residuals and degrees of freedom; measurements without weight do not count."""
    poses, n, m = fitted.poses, *fitted.residuals.shape
    used = fitted.state.ok & (fitted.weights > 0)
    square = np.where(used, fitted.weights * np.sum((fitted.residuals / fitted.sigma) ** 2, axis=1), 0.0)
    share = np.sum(np.linalg.qr(fitted.columns.reshape(n * m, -1))[0].reshape(n, -1) ** 2, axis=1)
    count = len(poses.devices)
    left = np.bincount(poses.device, np.where(used, fitted.weights * fitted.numbers, 0.0) - share, count)
    return _Scatter(np.bincount(poses.device, square, count), left)
