"""The two fits of M, D and K, and the checks of their validity.

A complete structure is fitted by maximum likelihood, weighed by the covariance of the model's parameters. A condensed
model with fewer degrees of freedom than modes cannot fit everywhere: its relative error is spread evenly over its band,
with more weight at the static end. Both fits work in scaled units and start from the conic program.

A feasible program is not an identified matrix. `identified` requires as many modes as named degrees of freedom, a
misfit that is not significant (`SIGNIFICANCE_LEVEL`) and that is small at every mode, and enough information to
determine M and K: the standard error of `E` in `M = L (I + E) L'` below `MAX_RELATIVE_STDERR` in every direction. If
fewer degrees of freedom are sensed than there are modes, the same matrices are at most `condensed`: a condensed model
on the band in which it fits. These checks cannot count a mode that the data do not show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from tau_dyn.modes.mechanical.estimation import (
    Target,
    compute_relative_frame,
    compute_whitening,
    maximise_likelihood,
    solve_conic,
    split,
)
from tau_dyn.modes.mechanical.structure import STEP, Evidence, Places, SecondOrder

MAX_RELATIVE_STDERR = 0.3  # standard error of a relative change of M or K beyond which the matrix is not determined
_SURE, _VAGUE = 3.0, 0.25
"""Standard errors within which a misfit at the modes may be chance, and the part of the response beyond which it may not."""
SIGNIFICANCE_LEVEL = 1e-3
"""Probability of a misfit by chance below which the model holds more than M, D, K of its degrees of freedom can."""


@dataclass(frozen=True)
class Agreement:
    """The band in which a structure reproduces the model.

    Attributes:
        valid_hz: The widest band around all wanted modes in which it does; None if it does not fit at the modes.
        misfit: Greatest relative error of the response in that band, or at the modes if there is no band.
    """

    valid_hz: tuple[float, float] | None
    misfit: float

    def both(self, other: Agreement) -> Agreement:
        """Return the band in which this and another agreement hold."""
        band = None
        if self.valid_hz and other.valid_hz:
            band = (max(self.valid_hz[0], other.valid_hz[0]), min(self.valid_hz[1], other.valid_hz[1]))
        return Agreement(band, max(self.misfit, other.misfit))

    def reaching(self, low_hz: float) -> Agreement:
        """Return it if its band begins at `low_hz` or below: a fit around a resonance alone is not valid elsewhere."""
        return self if self.valid_hz and self.valid_hz[0] <= low_hz else Agreement(None, self.misfit)


def find_valid_band(
    evidence: Evidence,
    structure: SecondOrder,
    places: Places,
    modes_hz: np.ndarray,
    span_hz: tuple[float, float],
    tolerance: float,
) -> Agreement:
    """Return the band in which a structure reproduces a model's response (matrix norm) within its uncertainty or `tolerance`.

    Args:
        evidence: The model.
        structure: M, D, K.
        places: Which degrees of freedom the model's inputs and outputs belong to.
        modes_hz: Modes that the band must hold (k,) [Hz].
        span_hz: Frequencies to compare.
        tolerance: Relative error that is accepted whatever the uncertainty.
    """
    f = np.unique(np.concatenate([np.geomspace(*span_hz, 160), *(modes_hz * (1 + d) for d in (-0.01, 0.0, 0.01))]))
    s = 2j * np.pi * f
    H = evidence.at.response(s)
    unit = places.unit(H)  # metres and radians have equal weight
    size = np.linalg.norm(H / unit, axis=(1, 2))
    error = np.linalg.norm((places.select(structure.compliance(s)) - H) / unit, axis=(1, 2)) / size
    sigma = np.zeros(len(f))
    if evidence.has_covariance:
        spread = evidence.factor(s).reshape(*H.shape, -1) / unit[:, :, None]
        sigma = np.sqrt(np.sum(np.abs(spread) ** 2, axis=(1, 2, 3))) / size
    inside = (f >= 0.99 * modes_hz.min()) & (f <= 1.01 * modes_hz.max())
    if np.any(error[inside] > np.maximum(tolerance, np.minimum(_SURE * sigma[inside], _VAGUE))):
        return Agreement(None, float(error[inside].max()))
    fits = inside | (error <= np.maximum(tolerance, np.minimum(_SURE * sigma, 2 * tolerance)))
    low = _last_false(fits[: np.argmax(inside)])
    high = len(f) - _last_false(fits[::-1][: np.argmax(inside[::-1])])
    return Agreement((float(f[low]), float(f[high - 1])), float(error[low:high].max()))


def _last_false(fits: np.ndarray) -> int:
    """Return the index after the last False."""
    return len(fits) - int(np.argmax(np.append(~fits[::-1], True)))


def compute_worst_relative_stderr(structure: SecondOrder, covariance: np.ndarray) -> dict[str, float]:
    """Return for M and K the standard error of the worst relative direction."""
    size = len(covariance) // 3
    frame = compute_relative_frame(structure)
    relative = np.linalg.solve(frame, np.linalg.solve(frame, covariance).T)
    worst = {}
    for name, first in (("M", 0), ("K", 2 * size)):
        block = relative[first : first + size, first : first + size]
        value = np.linalg.eigvalsh(0.5 * (block + block.T))[-1] if np.all(np.isfinite(block)) else np.inf
        worst[name] = float(np.sqrt(max(value, 0)))
    return worst


def get_covariance(target: Target, structure: SecondOrder, factor: np.ndarray | None) -> np.ndarray | None:
    """Return the covariance (q, q) of the entries of M, D, K.

    Args:
        target: The response that was fitted.
        structure: The fit.
        factor: Covariance factor (F, p, m, r) of the response if the target's weights do not whiten it; else None.
    """
    frame = compute_relative_frame(structure)
    J = target.jacobian(structure) @ frame
    U, S, Vt = np.linalg.svd(J, full_matrices=False)
    if len(S) < len(frame) or S[-1] < 1e-9 * S[0]:
        return np.full((len(frame), len(frame)), np.inf)  # some direction of M, D, K leaves no trace in the response
    gain = frame @ (Vt.T / S) @ U.T
    if target.whitens:
        return gain @ gain.T
    if factor is None:
        return None
    spread = gain @ target.weigh(factor)
    return spread @ spread.T


def compute_misfit_p_value(target: Target, structure: SecondOrder) -> float:
    """Return the p-value of the misfit under the hypothesis that this structure is true."""
    free = len(target.T) - 3 * target.places.n * (target.places.n + 1) // 2
    return float(chi2.sf(np.sum(target.misfit(structure) ** 2), free)) if free > 0 else 1.0


def measure_asymmetry(evidence: Evidence, places: Places, signs: np.ndarray | float = 1.0) -> tuple[float, float]:
    """Return how far the collocated part of the worst mode's residue is from symmetric, and its standard error.

    Args:
        evidence: The model and its uncertainty.
        places: Which degree of freedom each input and output belongs to.
        signs: Sign of each output (p,).
    """
    rows, columns = [i for _, i in places.pairs], [j for j, _ in places.pairs]
    if len(rows) < 2:
        return 0.0, 0.0

    residues = evidence.at.residues
    unit = places.unit(residues) * np.broadcast_to(signs, residues.shape[1])[:, None]

    def difference(values: np.ndarray) -> np.ndarray:
        block = (values / unit)[:, rows][:, :, columns]
        return block - block.transpose(0, 2, 1)

    size = np.linalg.norm((residues / unit)[:, rows][:, :, columns], axis=(1, 2)) + 1e-300
    found = np.linalg.norm(difference(residues), axis=(1, 2)) / size
    variance = np.zeros(len(size))
    for up, down in evidence.nearby:
        if up.residues.shape == down.residues.shape == residues.shape:
            change = (difference(up.residues) - difference(down.residues)) / (2 * STEP)
            variance += np.sum(np.abs(change) ** 2, axis=(1, 2)) / size**2
    worst = int(np.argmax(found - 4 * np.sqrt(variance)))
    return float(found[worst]), float(np.sqrt(variance[worst]))


_LIFT = 0.05
"""The likelihood looks at the response off the imaginary axis by this part of the frequency: there a shift of a resonance by its
standard error changes the response in proportion, however light the damping."""
_STATIC = 4.0  # weight of a condensed model's error below half the first resonance, relative to one above


@dataclass(frozen=True, eq=False)
class Task:
    """Input of a fit of M, D and K.

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
        covariance: Covariance of the upper triangles of M, D, K, one after another (q, q); None without uncertainty.
        agreement: The band in which it reproduces the model.
        consistency: Probability of so large a misfit by chance, if the weights allow this test.
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
    """Return the structure of the named degrees of freedom that best reproduces the first `count` modes.

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
    """Return the target of the fit, and the factor (F, p, m, r) of its covariance if available."""
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
