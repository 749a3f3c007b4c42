r"""Which parameters poses can tell, by rank-revealing QR on scaled columns, and on which others the rest depend.

A column is the whitened derivative of all residuals times the parameter's scale: what an error of that size would
show, in units of the noise. Parameters with smaller `priority` are preferred, but never at the price of a badly
conditioned set; a column that those kept explain is not identifiable, and `depends_on` names which. Blind
combinations have singular values of zero to rounding; one below 1 means that a combination is uncertain by more than
its scale, which is no matter of structure. Reference: Besnard & Khalil 2001; Khalil, Gautier & Enguehard 1991.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

STRUCTURAL = 1e-12
"""Part of the largest singular value below which a combination is blind whatever the noise."""

SCALES = {"m": 0.01, "rad": 0.01, "1": 0.01, "m/N": 1e-5}
"""By unit, the standard error beyond which a parameter is as good as unknown."""

_LESS = 0.5
"""Weight of a level of priority, relative to the one before."""

_LAST = 10
"""Level of priority that counts as the last: a factor of a thousand in weight."""

_INVOLVED = 1e-6
"""Share of the largest factor below which a parameter has no part in a dependence."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What poses can tell.

    Attributes:
        names: All free parameters (p,).
        kept: Indices of those that are estimated (r,).
        dropped: Indices of those that stay at their nominal value (p - r,).
        factors: How a unit change of a dropped parameter is made up for by the kept ones (r, p - r), each in its own
            unit.
        depends_on: For every dropped parameter, the kept ones of its dependence.
        singular_values: Of the scaled columns (p,), largest first.
    """

    names: tuple[str, ...]
    kept: np.ndarray
    dropped: np.ndarray
    factors: np.ndarray
    depends_on: tuple[tuple[str, ...], ...]
    singular_values: np.ndarray

    @property
    def rank(self) -> int:
        """Number of parameters that are estimated."""
        return len(self.kept)

    @property
    def condition_number(self) -> float:
        """Largest by smallest singular value of the kept part."""
        s = self.singular_values
        return float(s[0] / s[self.rank - 1]) if self.rank else float("inf")

    def to_dict(self) -> dict[str, object]:
        """Return the contract's `identifiability`."""
        rows = [
            {"parameter": self.names[k], "depends_on": list(d)}
            for k, d in zip(self.dropped, self.depends_on, strict=True)
        ]
        return {"rank": self.rank, "not_identifiable": rows}


def find_identifiable(
    columns: np.ndarray,
    names: tuple[str, ...],
    scales: np.ndarray,
    priority: np.ndarray,
) -> Identifiability:
    """Find which parameters can be told.

    Args:
        columns: Whitened derivatives (rows, p).
        names: Of the parameters.
        scales: Size of an error that matters (p,).
        priority: Those with smaller numbers are kept first (p,).
    """
    scaled = columns * scales
    r = np.asarray(np.linalg.qr(scaled, mode="r")) if len(scaled) > scaled.shape[1] else scaled
    s = np.linalg.svd(r, compute_uv=False)
    s = np.concatenate([s, np.zeros(len(names) - len(s))])
    blind = STRUCTURAL * s.max(initial=0.0)
    structural = int(np.sum(s > blind))
    kept = _chosen(r, priority, structural)
    dropped = np.setdiff1d(np.arange(len(names)), kept)
    factors = np.linalg.lstsq(r[:, kept], r[:, dropped], rcond=None)[0] if len(kept) else np.zeros((0, len(dropped)))
    depends = tuple(_involved(factors[:, d], [names[k] for k in kept]) for d in range(len(dropped)))
    factors = factors / scales[dropped] * scales[kept][:, None]
    return Identifiability(names, kept, dropped, factors, depends, s)


def _involved(factor: np.ndarray, names: list[str]) -> tuple[str, ...]:
    size = np.abs(factor)
    if not size.max(initial=0.0) > 0:
        return ()
    return tuple(name for name, x in zip(names, size, strict=True) if x > _INVOLVED * max(size.max(), 1e-12))


def _chosen(r: np.ndarray, priority: np.ndarray, rank: int) -> np.ndarray:
    """Return the columns to keep: by pivoting on unit columns, each level of priority at half the weight of the one before.

    A strict order would keep a set that barely spans the rest; then the others could not be put back to their nominal
    values.
    """
    norm = np.linalg.norm(r, axis=0)
    level = np.minimum(priority - priority.min(initial=0), _LAST)
    rounding = norm <= STRUCTURAL * norm.max(
        initial=0.0
    )  # a column that is rounding only must not be scaled up to count
    weight = np.where(rounding, 0.0, _LESS**level / np.where(rounding, 1.0, norm))
    order = np.asarray(linalg.qr(r * weight, mode="r", pivoting=True)[-1])
    return np.sort(order[:rank])
