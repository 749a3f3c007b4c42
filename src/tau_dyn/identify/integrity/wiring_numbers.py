"""Numbers of a reading, such as scales and gear ratios: their maximum of the posterior density and their standard errors.

A search starts from a grid. A bounded search over the logarithm finds the maximum; the standard error follows from the
curvature.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from tau_dyn.evidence import MIN_MODEL_ERROR
from tau_dyn.identify.integrity.reading_fit import Design, LogModel
from tau_dyn.identify.integrity.wiring_alternatives import UNITS, Number, Rewiring

REACH = np.log(2.5)
"""Half width of the search for a number, about its start (logarithm): the grid's largest gap is a factor of five."""

NUMBER_STEP = 0.03
"""Step of the differences for the curvature (logarithm): well below the standard error that the bodies' prior leaves."""

MAX_STEP_NATS = 4.0
"""Loss at which a step is halved [nats]: beyond about three standard errors the posterior is no parabola."""

MIN_STEP_NATS = 0.5
"""Loss below which a step is too short to show the curvature [nats]."""

MIN_NUMBER_STEP = 1e-4
"""Smallest step (logarithm): no unit or ratio needs more digits."""

MIN_CURVATURE = 0.01
"""Least curvature of the log posterior: a standard error of a factor of e^10."""

NEWTON_STEPS = 4
"""Newton steps for numbers that depend on each other, such as the torque constants of all joints."""

ROUNDING_STDERRS = 2.0
"""Standard errors within which an estimate is rounded to a conversion of units."""

MIN_ROUNDED = 0.02
"""Relative difference from a conversion of units that is always rounded: geometry and bodies of the file are not better."""

MAX_ROUNDED = 0.05
"""Largest relative change of an estimate by rounding; beyond it the estimate is no evidence for the unit."""

_UNREACHED = 1e12
"""Loss of a number with which the robot does not reach its positions [nats]; finite, since a parabola is put through losses."""


def refine_numbers(model: LogModel, reading: Rewiring, numbers: tuple[Number, ...], reach: float = REACH) -> Rewiring:
    """Return the reading with some numbers at the maximum of the posterior density, one after another, twice."""
    for width in (reach, reach / 4) if len(numbers) > 1 else (reach,):
        for number in numbers:
            design = model.design(reading) if number[0] == "tau" else None

            def loss(
                x: float, number: Number = number, design: Design | None = design, at: Rewiring = reading
            ) -> float:
                fit = model.fit(at.times(number, float(np.exp(x))), design)
                return _UNREACHED if fit is None else -fit.log_posterior

            found = minimize_scalar(loss, bounds=(-width, width), method="bounded", options={"xatol": 2e-3})
            if found.fun < _UNREACHED:
                reading = reading.times(number, float(np.exp(found.x)))
    return reading


def separate_numbers(model: LogModel, reading: Rewiring) -> Rewiring:
    """Return the reading with one number for each column, at the maximum: torque constants and units belong to single drives."""
    numbers = tuple(
        dict.fromkeys(
            (signal, (j,)) if joints else (signal, joints) for signal, joints in reading.numbers for j in joints or (0,)
        )
    )
    reading = refine_numbers(model, replace(reading, numbers=numbers), numbers)
    for _ in range(NEWTON_STEPS if len(numbers) > 1 else 0):
        gradient, cov = _expand(model, reading)
        step = np.clip(cov @ gradient, -REACH, REACH)
        trial = reading
        for number, x in zip(numbers, step, strict=True):
            trial = trial.times(number, float(np.exp(x)))
        if compute_posterior(model, trial) <= compute_posterior(model, reading):
            break
        reading = trial
    return reading


def estimate_errors(model: LogModel, reading: Rewiring) -> dict[Number, float]:
    """Return the relative standard errors of a reading's numbers, from the curvature of the posterior density."""
    _, cov = _expand(model, reading)
    return {number: float(np.sqrt(cov[i, i])) for i, number in enumerate(reading.numbers)}


def compute_posterior(model: LogModel, reading: Rewiring) -> float:
    """Return the log posterior density of a reading at its maximum [nats]; minus infinity if the robot cannot move like this."""
    fit = model.fit(reading)
    return -np.inf if fit is None else fit.log_posterior


def _expand(model: LogModel, reading: Rewiring) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (n,) and covariance (n, n) of the logarithms of a reading's numbers, by central differences."""
    numbers, n = reading.numbers, len(reading.numbers)

    def compute(*changes: tuple[Number, float]) -> float:
        trial = reading
        for number, x in changes:
            trial = trial.times(number, float(np.exp(x)))
        return compute_posterior(model, trial)

    def find_step(number: Number) -> tuple[float, float, float]:
        step, found = NUMBER_STEP, (0.0, 0.0, 0.0)
        while True:
            up, down = (compute((number, x)) for x in (step, -step))
            loss = middle - min(up, down)
            if found[0] and loss < MIN_STEP_NATS:  # a plateau: the residual is below the model error
                return found
            if loss < MAX_STEP_NATS or step < MIN_NUMBER_STEP:
                return step, up, down
            step, found = step / 2, (step, up, down)

    middle = compute()
    found = np.array([find_step(number) for number in numbers]).reshape(n, 3)
    steps, ends = found[:, 0], found[:, 1:]
    losses = 2 * middle - ends.sum(axis=1)
    H = np.diag(losses / steps**2)
    for i in range(n):
        for k in range(i):
            both = [compute((numbers[i], s * steps[i]), (numbers[k], s * steps[k])) for s in (1, -1)]
            H[i, k] = H[k, i] = (2 * middle - sum(both) - losses[i] - losses[k]) / (2 * steps[i] * steps[k])
    if not np.all(np.isfinite(H)):
        return np.zeros(n), np.full((n, n), np.inf)
    values, vectors = np.linalg.eigh(H)
    if n and values[0] < MIN_CURVATURE:  # edges of a plateau are no parabola
        values, vectors = np.diag(H), np.eye(n)
    gradient = (ends[:, 0] - ends[:, 1]) / (2 * steps)
    return gradient, vectors @ np.diag(1 / np.maximum(values, MIN_CURVATURE)) @ vectors.T


def try_units(model: LogModel, reading: Rewiring) -> Rewiring:
    """Return the reading with all its positions in one other unit, if that is likelier than the estimated factors.

    The density has several maxima where the robot's shape limits its positions, and the search for a factor finds one of them.
    Both are compared with the residual of the best joint as the model error, so that the forces decide and not the bodies' prior.
    """
    numbers = [number for number in reading.numbers if number[0] == "q"]
    if not numbers:
        return reading
    best = reading
    for unit in UNITS["q"]:
        for factor in (unit, 1 / unit):
            trial = best
            for number in numbers:
                trial = trial.times(number, factor / abs(best.get(number)))
            if (fit := model.fit(trial)) is None:
                continue
            share = float(np.min(np.sqrt(fit.power) / model.size[list(trial.tau_from)]))
            least = min(model.test.model_error, max(share, MIN_MODEL_ERROR))
            sharp = replace(model, test=replace(model.test, model_error=least))
            if compute_posterior(sharp, trial) > compute_posterior(sharp, best):
                best = trial
    return best


def round_to_units(reading: Rewiring, errors: dict[Number, float]) -> Rewiring:
    """Return the reading with numbers rounded to conversions of units with which they are consistent."""
    for number, error in errors.items():
        value = abs(reading.get(number))
        for unit in UNITS.get(number[0], ()):
            for factor in (unit / value, 1 / unit / value):
                off = abs(np.log(factor))
                if off < min(MAX_ROUNDED, max(ROUNDING_STDERRS * error, MIN_ROUNDED)):
                    reading = reading.times(number, factor)
    return reading
