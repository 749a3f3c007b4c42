r"""A periodic error along a guideway, found in unevenly or evenly spaced points; what it may be an alias of.

Least-squares periodogram: for each frequency the share `z` of the residual's squares that one sine and cosine explain. Points
`D` apart cannot tell f from `k / D +- f`: a pinion's teeth, finer than the spacing, show up as one long wave (thesis 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

MIN_CYCLE_POINTS = 12
"""Points below which no cycle is sought."""
_FINE = 8
"""Frequencies tried per independent one."""


@dataclass(frozen=True)
class PeriodicError:
    """The strongest cycle.

    Attributes:
        period: Length of one cycle as the points show it [m].
        amplitude: Half of its swing [m].
        p_value: Chance of one as strong in white scatter, all frequencies tried counted.
        aliases: Shorter periods [m] that evenly spaced points cannot tell from it, longest first; empty for uneven ones.
    """

    period: float
    amplitude: float
    p_value: float
    aliases: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return what a result file holds of it."""
        return {
            "period": self.period,
            "amplitude": self.amplitude,
            "p_value": self.p_value,
            "aliases": list(self.aliases),
        }


def find_strongest_period(q: np.ndarray, e: np.ndarray) -> PeriodicError | None:
    """Return the strongest cycle of `e` (N,) [m] over positions `q` (N,) [m]; None with too few points or no scatter."""
    places, index = np.unique(q, return_inverse=True)
    n, total = len(places), float(e @ e)
    if n < MIN_CYCLE_POINTS or not total > 0:
        return None
    span, spacing = float(np.ptp(places)), float(np.median(np.diff(places)))
    f = np.linspace(1.5 / span, 0.5 / spacing, max(2, int(_FINE * n / 2)))
    z, amplitude = _explained(q, e, f)
    best = int(np.argmax(z))
    independent, share = n / 2, min(float(z[best]), 1 - 1e-15)
    once = (1 - share) ** ((len(e) - 3) / 2)  # F test of two columns, exact for white normal scatter
    p = -np.expm1(independent * np.log1p(-min(once, 1 - 1e-15)))
    even = np.ptp(np.diff(places)) < 0.02 * spacing
    return PeriodicError(
        1 / float(f[best]), float(amplitude[best]), float(p), _aliases(float(f[best]), spacing) if even else ()
    )


def _explained(q: np.ndarray, e: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each frequency (F,) the explained share of the squares and the amplitude, by normal equations."""
    phase = 2 * np.pi * np.outer(f, q)
    columns = np.stack([np.cos(phase), np.sin(phase)], axis=1)  # (F, 2, N)
    projected = columns @ e
    c = np.linalg.solve(columns @ columns.transpose(0, 2, 1) + 1e-9 * len(q) * np.eye(2), projected[..., None])[..., 0]
    return np.sum(c * projected, axis=1) / (e @ e), np.linalg.norm(c, axis=1)


def _aliases(f: float, spacing: float, most: int = 4) -> tuple[float, ...]:
    frequencies = sorted(g for k in range(1, most + 1) for g in (k / spacing - f, k / spacing + f))
    return tuple(1 / g for g in frequencies[:most])
