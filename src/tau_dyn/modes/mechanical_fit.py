r"""The two fits of M, D and K: a whole structure by maximum likelihood, and a stand-in with fewer degrees of freedom than modes.

Both work in scaled units and start from the conic program. The whole one is weighed by the covariance of the model's parameters.
The stand-in cannot be right everywhere: it spreads its relative error evenly over its band, with the static end counted more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tau_dyn.modes.mechanical_convex import solve_conic
from tau_dyn.modes.mechanical_evidence import Evidence
from tau_dyn.modes.mechanical_likelihood import Target, compute_whitening, maximise_likelihood, split
from tau_dyn.modes.mechanical_validation import (
    Agreement,
    compute_misfit_p_value,
    compute_worst_relative_stderr,
    find_valid_band,
    get_covariance,
)
from tau_dyn.modes.places import Places
from tau_dyn.modes.second_order import SecondOrder

_LIFT = 0.05
"""The likelihood looks at the response off the imaginary axis by this part of the frequency: there a shift of a resonance by its
standard error changes the response in proportion, however light the damping."""
_STATIC = 4.0
"""Weight of a stand-in's error below half the first resonance, against one above."""


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be fitted.

    Attributes:
        evidence: The model and its uncertainty.
        places: Which degree of freedom each of its inputs and outputs belongs to.
        modes_hz: Its modes in the band [Hz].
        span_hz: The band [Hz].
        tolerance: Relative error of the response that counts as fitting.
    """

    evidence: Evidence
    places: Places
    modes_hz: np.ndarray
    span_hz: tuple[float, float]
    tolerance: float


@dataclass(frozen=True, eq=False)
class MechanicalFit:
    """A fit, in the user's units.

    Attributes:
        structure: M, D, K.
        covariance: Of the upper triangles of M, D, K, one after another (q, q); None without uncertainty.
        agreement: Where it stands for the model.
        consistency: Probability of so large a misfit by chance, where the weights allow to tell.
        unknown: Standard error of the worst relative direction of M and of K.
    """

    structure: SecondOrder
    covariance: np.ndarray | None
    agreement: Agreement
    consistency: float | None
    unknown: Mapping[str, float] = field(default_factory=lambda: {"M": 0.0, "K": 0.0})


def fit_full_structure(task: Task) -> MechanicalFit:
    """Return the maximum-likelihood structure with as many degrees of freedom as modes."""
    f = _grid(task.modes_hz, task.span_hz)
    s = 2j * np.pi * f
    if task.evidence.has_covariance:
        s = s + _LIFT * np.abs(s)
    return _fit(task, s, task.modes_hz, None)


def fit_condensed_structure(task: Task, count: int) -> MechanicalFit:
    """Return the structure of the named degrees of freedom that best stands for the first `count` modes.

    Between the named places the modes are known from every force to every sensor by reciprocity; all of that is fitted.
    """
    wanted = task.modes_hz[:count]
    more = len(task.modes_hz) > count
    top = np.sqrt(task.modes_hz[count - 1] * task.modes_hz[count]) if more else task.span_hz[1]
    f = _grid(wanted, (task.span_hz[0], max(top, 1.01 * wanted[-1])))
    return _fit(task, 2j * np.pi * f, wanted, np.where(f < 0.5 * wanted[0], _STATIC, 1.0))


def _fit(task: Task, s: np.ndarray, wanted: np.ndarray, weight: np.ndarray | None) -> MechanicalFit:
    """Return the fit at points s: by likelihood, or with relative errors under `weight` (F,) of the completed response."""
    units = _Units.of(task, s)
    square = task.places.square
    full = task.evidence.at.completed(task.places).response(s)
    start = solve_conic(s / units.rate, units.divide(full, square), square.driven)
    evidence, places = task.evidence, task.places
    if weight is not None:
        evidence, places = evidence.completed(places), square
    target, factor = _target(evidence, places, s, units, weight)
    fitted = maximise_likelihood(target, start)
    covariance = get_covariance(target, fitted, factor)
    worst = compute_worst_relative_stderr(fitted, covariance) if covariance is not None else {"M": 0.0, "K": 0.0}
    found = units.restore(fitted)
    agrees = find_valid_band(task.evidence, found, task.places, wanted, task.span_hz, task.tolerance)
    if weight is not None:  # between unmeasured pairs too, and from rest on
        elsewhere = find_valid_band(evidence, found, places, wanted, task.span_hz, task.tolerance)
        agrees = agrees.both(elsewhere).reaching(0.5 * wanted[0])
    chance = compute_misfit_p_value(target, fitted) if target.whitens else None
    return MechanicalFit(
        found, None if covariance is None else units.restore_covariance(covariance), agrees, chance, worst
    )


@dataclass(frozen=True, eq=False)
class _Units:
    """Sizes of the degrees of freedom (n,) and a rate [rad/s] that make M, D, K of order one."""

    scale: np.ndarray
    rate: float

    @staticmethod
    def of(task: Task, s: np.ndarray) -> _Units:
        return _Units(task.places.scale(task.evidence.at.response(s)), float(np.sqrt(abs(s[0]) * abs(s[-1]))))

    def divide(self, response: np.ndarray, places: Places) -> np.ndarray:
        """Return a response (F, p, m, ...) in scaled units."""
        unit = np.outer(self.scale[list(places.sensed)], self.scale[list(places.driven)])
        return response / unit.reshape(unit.shape + (1,) * (response.ndim - 3))

    def restore(self, fitted: SecondOrder) -> SecondOrder:
        unit = np.outer(self.scale, self.scale)
        return SecondOrder(fitted.M / unit / self.rate**2, fitted.D / unit / self.rate, fitted.K / unit)

    def restore_covariance(self, covariance: np.ndarray) -> np.ndarray:
        unit = np.outer(self.scale, self.scale)[np.triu_indices(len(self.scale))]
        size = np.concatenate([1 / unit / self.rate**2, 1 / unit / self.rate, 1 / unit])
        return covariance * np.outer(size, size)


def _target(
    evidence: Evidence, places: Places, s: np.ndarray, units: _Units, weight: np.ndarray | None
) -> tuple[Target, np.ndarray | None]:
    """Return what to fit, and the factor (F, p, m, r) of its covariance where there is one."""
    H = units.divide(evidence.at.response(s), places)
    factor = None
    if evidence.has_covariance:
        factor = units.divide(evidence.factor(s).reshape(*H.shape, -1), places)
    if weight is None and factor is not None:
        return Target(s / units.rate, H, places, compute_whitening(split(factor)), True), factor
    relative = (1.0 if weight is None else weight) / np.linalg.norm(H, axis=(1, 2))
    rows = np.tile(np.repeat(relative, H[0].size), 2)
    return Target(s / units.rate, H, places, rows, False), factor


def _grid(modes_hz: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """Return frequencies [Hz] over the band and closer around each mode."""
    near = (modes_hz[:, None] * (1 + np.array([-0.08, -0.04, -0.02, -0.01, 0.0, 0.01, 0.02, 0.04, 0.08]))).ravel()
    f = np.unique(np.concatenate([np.geomspace(*span, 24), near]))
    return f[(f >= span[0]) & (f <= span[1])]
