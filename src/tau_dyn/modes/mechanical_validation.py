r"""Whether a fit of M, D and K means something: counted modes, information, and how well it stands for the model it came from.

A feasible program is not an identified matrix. `identified` takes as many modes as named degrees of freedom, a misfit that chance
explains (`SIGNIFICANCE_LEVEL`) and that is small at every mode, and enough information to tell M and K: the standard error of
`E` in
`M = L (I + E) L'` below `MAX_RELATIVE_STDERR` in every direction. Where fewer are sensed than there are modes, the same
matrices are at most
`condensed`: a stand-in on the band where it fits. A mode that the data do not show cannot be counted by any of this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from tau_dyn.modes.mechanical_evidence import STEP, Evidence
from tau_dyn.modes.mechanical_likelihood import Target, compute_relative_frame
from tau_dyn.modes.places import Places
from tau_dyn.modes.second_order import SecondOrder

MAX_RELATIVE_STDERR = 0.3
"""Standard error of a relative change of M or K beyond which the matrix is not known."""
_SURE, _VAGUE = 3.0, 0.25
"""Standard errors within which a misfit at the modes may be chance, and the part of the response beyond which it may not."""
SIGNIFICANCE_LEVEL = 1e-3
"""Probability of a misfit by chance below which the model holds more than M, D, K of its degrees of freedom can."""


@dataclass(frozen=True)
class Agreement:
    """Where a structure stands for the model.

    Attributes:
        valid_hz: The widest band around all wanted modes in which it does; None where it does not even there.
        misfit: Greatest relative error of the response in that band, or at the modes where there is none.
    """

    valid_hz: tuple[float, float] | None
    misfit: float

    def both(self, other: Agreement) -> Agreement:
        """Return where this and another agreement hold."""
        band = None
        if self.valid_hz and other.valid_hz:
            band = (max(self.valid_hz[0], other.valid_hz[0]), min(self.valid_hz[1], other.valid_hz[1]))
        return Agreement(band, max(self.misfit, other.misfit))

    def reaching(self, low_hz: float) -> Agreement:
        """Return it if its band begins at `low_hz` or below: what fits around a resonance alone stands for nothing else."""
        return self if self.valid_hz and self.valid_hz[0] <= low_hz else Agreement(None, self.misfit)


def find_valid_band(
    evidence: Evidence,
    structure: SecondOrder,
    places: Places,
    modes_hz: np.ndarray,
    span_hz: tuple[float, float],
    tolerance: float,
) -> Agreement:
    """Return where a structure reproduces a model's response, as a matrix norm, within its uncertainty or `tolerance`.

    Args:
        evidence: The model.
        structure: M, D, K.
        places: Which degrees of freedom the model's inputs and outputs belong to.
        modes_hz: Modes that the band must hold (k,) [Hz].
        span_hz: Frequencies to look at.
        tolerance: Relative error that is good enough whatever the uncertainty.
    """
    f = np.unique(np.concatenate([np.geomspace(*span_hz, 160), *(modes_hz * (1 + d) for d in (-0.01, 0.0, 0.01))]))
    s = 2j * np.pi * f
    H = evidence.at.response(s)
    unit = places.unit(H)  # metres and radians weigh alike
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
        target: What was fitted.
        structure: The fit.
        factor: Covariance factor (F, p, m, r) of the response, where the target's weights do not whiten it; None where they do.
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
    """Return the probability of a misfit at least as large if the model's truth is this structure; small speaks against it."""
    free = len(target.T) - 3 * target.places.n * (target.places.n + 1) // 2
    return float(chi2.sf(np.sum(target.misfit(structure) ** 2), free)) if free > 0 else 1.0


def measure_asymmetry(evidence: Evidence, places: Places) -> tuple[float, float]:
    """Return how far the collocated part of the worst mode's residue is from symmetric, and its standard error."""
    rows, columns = [i for _, i in places.pairs], [j for j, _ in places.pairs]
    if len(rows) < 2:
        return 0.0, 0.0

    residues = evidence.at.residues
    unit = places.unit(residues)

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
