"""A fit whose columns depend on what it finds: friction in proportion to a load, a gain of the model's own force.

The columns are made with the signals of the last estimate and the fit is repeated. Each pass brings a gain error `g` closer by a
factor `g`, and a load's friction by the share of the force that it is; two or three passes are the rule.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.estimate import Estimate, Regression
from tau_dyn.model import Model

PARAMETER_DEPENDENT_SIGNALS = frozenset({"force", "rigid_force", "load", "inertia", "damping", "weight_gradient"})
"""Signals that follow from the parameters' values, so that a fit changes the columns it was made with."""

MAX_ITERATIONS = 8  # bounds the time of a fit that does not converge
RELATIVE_CHANGE_TOL = 0.01
"""A fit is repeated until the predicted force moves by less than this share of what it leaves unexplained."""


def iterate_to_fixed_point(
    model: Model,
    training: Regression,
    solve: Callable[[Regression], Estimate],
    build: Callable[[Model], Regression],
    warnings: list[str],
) -> tuple[Regression, Estimate]:
    """Return the fit and its regression, repeated where effects feel what the fitted values make of forces and loads.

    Args:
        model: What is fitted, at the values to start from.
        training: Its regression with signals at those values.
        solve: The estimation.
        build: Makes the regression with signals at a model's values.
        warnings: Told where the fit does not settle.
    """
    estimate = solve(training)
    feeling = [effect.name for effect in model.effects if PARAMETER_DEPENDENT_SIGNALS & set(effect.needs)]
    if not feeling:
        return training, estimate
    for _ in range(MAX_ITERATIONS):
        before, theta = training, estimate.theta
        training = build(model.with_parameters(estimate.parameters))
        estimate = solve(training)
        moved, left = _changed(before, theta, training, estimate.theta)
        if moved <= RELATIVE_CHANGE_TOL * left:
            return training, estimate
    warnings.append(
        f"no convergence in {MAX_ITERATIONS} iterations: effect {feeling[0]} depends on a force or load that "
        f"changes with the estimate"
    )
    return training, estimate


def _changed(before: Regression, theta: np.ndarray, after: Regression, now: np.ndarray) -> tuple[float, float]:
    """Return by how much the residual moved and how large it is now: roots of sums of squares over usable samples."""
    moved = left = 0.0
    for one, other in zip(before.rows(), after.rows(), strict=True):
        for x, y in zip(one, other, strict=True):
            e = y.y - y.W @ now
            moved += float(np.sum((e - (x.y - x.W @ theta))[y.usable] ** 2))
            left += float(np.sum(e[y.usable] ** 2))
    return moved**0.5, left**0.5
