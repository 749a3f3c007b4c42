"""Levenberg-Marquardt steps downhill until they are small against the standard errors.

Reference: Ljung 1999, 10.2; Nocedal & Wright 2006, 10.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.modes.gauss_newton import FitPoint, assemble_normal_equations, evaluate
from tau_dyn.modes.modal_form import ModalForm, free_numbers
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace
from tau_dyn.modes.tangent import Tangent, append_initial_states, balance_model, compute_tangent, split_initial_states

SMALL_STEP = 0.02  # mean step of a parameter over its standard error at which we stop
SMALL_GAIN = 0.05  # log-likelihood gained by a round; two such in a row end the descent
MIN_UNIT_CIRCLE_DISTANCE = 1e-8  # of a pole to the unit circle
MAX_DAMPING_TRIALS = 12  # dampings tried before the point counts as a minimum


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Where the descent ended.

    Attributes:
        point: The best point.
        rounds: Accepted steps.
        converged: Whether the steps had become small, or no step led further down.
    """

    point: FitPoint
    rounds: int
    converged: bool


def minimise(
    point: FitPoint,
    records: Sequence[Record],
    direct: np.ndarray,
    maximum_rounds: int,
    allowed: Callable[[ModalForm], bool] = lambda form: True,
) -> DescentResult:
    """Walk down from a point.

    Args:
        point: Where to start.
        records: Aligned and scaled.
        direct: Which entries of D are free (p, m).
        maximum_rounds: Most accepted steps.
        allowed: Says whether a model may be visited at all.
    """
    damping, slow, easy = 1e-12, 0, False
    model = balance_model(append_initial_states(point))
    point = evaluate(*split_initial_states(model, direct.shape[1]), records)
    for rounds in range(maximum_rounds):
        normal = assemble_normal_equations(point, free_numbers(point.form, direct))
        tangent = compute_tangent(model, point, normal)
        if _mean_step(tangent) < SMALL_STEP:
            return DescentResult(_tried(tangent.step(0.0), point, records, allowed) or point, rounds, True)
        for attempt in range(MAX_DAMPING_TRIALS):
            model = balance_model(_kept_inside(tangent.step(damping), point.form))
            trial = _tried(model, point, records, allowed)
            if trial is not None:
                easy = attempt == 0
                break
            damping *= 20
        else:
            return DescentResult(point, rounds, True)
        gain = point.n_samples * (point.loss - trial.loss) / 2
        point, damping = trial, damping / 20 if easy else damping
        slow = slow + 1 if gain < SMALL_GAIN else 0
        if slow == 2:
            return DescentResult(point, rounds + 1, True)
    return DescentResult(point, maximum_rounds, False)


def _tried(
    model: StateSpace, point: FitPoint, records: Sequence[Record], allowed: Callable[[ModalForm], bool]
) -> FitPoint | None:
    """The point of a model, where it may be visited and is better than the last point."""
    if not np.isfinite(model.A).all() or model.spectral_radius() >= 1:
        return None
    form, x0 = split_initial_states(model, point.form.D.shape[1])
    if not allowed(form):
        return None
    trial = evaluate(form, x0, records)
    return trial if trial.loss < point.loss else None


def _mean_step(tangent: Tangent) -> float:
    """Size of an undamped step in standard errors, averaged over the free numbers."""
    counts = tangent.values > 1e-14 * tangent.values[-1]
    return float(np.sqrt(np.mean(tangent.slopes[counts] ** 2 / tangent.values[counts])))


def _kept_inside(model: StateSpace, old: ModalForm) -> StateSpace:
    """The model with poles beyond the unit circle drawn back to a tenth of the old model's distance from it."""
    limit = 1 - max(0.1 * (1 - np.abs(old.poles).max(initial=0.0)), MIN_UNIT_CIRCLE_DISTANCE)
    if not np.isfinite(model.A).all():
        return model
    values, vectors = np.linalg.eig(model.A)
    size = np.abs(values)
    if (size <= limit).all():
        return model
    A = (vectors * (values * np.minimum(1, limit / np.maximum(size, 1e-300)))) @ np.linalg.inv(vectors)
    return replace(model, A=A.real)


def normalise_shapes(point: FitPoint) -> FitPoint:
    """Return the point with the largest entry of every output shape equal to 1."""
    form = point.form.normalised()
    index = np.arange(len(form.poles))
    factor = point.form.c[point.form.pivots, index]
    return replace(point, form=form, x0=point.x0 * np.where(factor == 0, 1.0, factor))
