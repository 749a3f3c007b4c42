"""Straightness of a guideway: measured positions of a point on its cart against a line (thesis (4.10) to (4.12), Table 4.1).

    P(q) = P_0 + q v + e,      e_par = e . v / |v|,      e_perp = e - e_par v / |v|

by least squares, `v` free in length: `|v| - 1` is a scale error of the drive, not of straightness. Along the motion e contains
the errors of the drive (transmission, resolver, backlash), across it those of the guideway. Positions are measured in any fixed
frame. Errors of a guideway are smooth, so standard errors are widened by the residual's own correlation from point to point.

A periodic error is found by the least-squares periodogram: for each frequency the share `z` of the residual's squares that one
sine and cosine explain. Points with spacing `D` cannot distinguish f from `k / D +- f` (aliasing): a pinion's teeth, finer than
the spacing, appear as one long wave.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.exceptions import InputError

MIN_CYCLE_POINTS = 12
"""Points below which no cycle is sought."""
_PLACE_DIGITS = 6  # of a position in its travel, beyond which two are one place
_FINE = 8
"""Frequencies tried per independent one."""


@dataclass(frozen=True)
class PeriodicError:
    """The strongest cycle.

    Attributes:
        period: Apparent length of one cycle at these points [m].
        amplitude: Half of its peak-to-peak value [m].
        p_value: Probability of an equally strong cycle in white noise, with all tested frequencies counted.
        aliases: Shorter periods [m] that evenly spaced points cannot distinguish from it, longest first; empty for uneven ones.
    """

    period: float
    amplitude: float
    p_value: float
    aliases: tuple[float, ...]


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


MIN_POINTS = 8
"""Points below which the shape of a line cannot be separated from scatter."""
SHAPE_DEGREE = 4
"""Polynomials up to this degree describe a guideway's slow shape."""
SIGNIFICANCE_LEVEL = 0.01
"""p-value below which a shape, a cycle or a backlash counts as significant."""
_MIXED = 3
"""Points in each direction of travel from which backlash is estimated."""


class SizeEstimate(NamedTuple):
    """A size with its standard error [m] and the p-value of the hypothesis that it is zero."""

    size: float
    stderr: float
    p_value: float

    @property
    def sure(self) -> bool:
        """Whether it is significant."""
        return self.p_value < SIGNIFICANCE_LEVEL


@dataclass(frozen=True, eq=False)
class Guideway:
    """One guideway against a straight line.

    Attributes:
        joint: The actuated joint.
        q: Actuated positions (N,) [m].
        origin: `P_0` (3,) [m], the point of the line at q = 0.
        slope: `v` (3,), metres of travel per metre of q.
        covariance: Covariance of `slope` (3, 3).
        along: `e_par` (N,) [m].
        across: `e_perp` (N, 3) [m].
        bow: Offset of the middle from the ends [m], across the guideway.
        shape: p-value of the hypothesis that the guideway has no slow shape across.
        cycle: The strongest cycle along the motion; None with too few points.
        backlash: Difference between the directions of travel [m]; None if all points were approached from one side.
        points: Measured positions of the cart (N, 3) [m].
    """

    joint: str
    q: np.ndarray
    origin: np.ndarray
    slope: np.ndarray
    covariance: np.ndarray
    along: np.ndarray
    across: np.ndarray
    bow: SizeEstimate
    shape: float
    cycle: PeriodicError | None
    backlash: SizeEstimate | None
    points: np.ndarray

    @property
    def direction(self) -> np.ndarray:
        """Unit direction (3,)."""
        return self.slope / np.linalg.norm(self.slope)

    @property
    def residuals(self) -> np.ndarray:
        """`e` of (4.10) (N, 3) [m]."""
        return self.along[:, None] * self.direction + self.across

    @property
    def sizes(self) -> np.ndarray:
        """`|e|` (N,) [m]; Table 4.1 has its mean and standard deviation."""
        return np.linalg.norm(self.residuals, axis=1)

    @property
    def scale(self) -> tuple[float, float]:
        """`|v| - 1` and its standard error."""
        d = self.direction
        return float(np.linalg.norm(self.slope)) - 1.0, float(np.sqrt(d @ self.covariance @ d))

    def bounds(self, share: float = 0.95) -> tuple[float, float]:
        """Return the quantile of the errors along and across [m] for this share of the measured points."""
        across = np.linalg.norm(self.across, axis=1)
        return float(np.quantile(np.abs(self.along), share)), float(np.quantile(across, share))

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        along, across = (1e6 * x for x in self.bounds())
        found = [f"95 % of its points lie within {along:.0f} um along and {across:.0f} um across a straight line"]
        if self.bow.sure:
            found.append(f"bow {1e6 * self.bow.size:.0f} +- {1e6 * self.bow.stderr:.0f} um")
        elif self.shape < SIGNIFICANCE_LEVEL:
            found.append("straightness error above the noise")
        else:
            found.append("no straightness error above the noise")
        if self.cycle is not None and self.cycle.p_value < SIGNIFICANCE_LEVEL:
            found.append(
                f"cyclic error along the motion: period {1e3 * self.cycle.period:.0f} mm, "
                f"amplitude {1e6 * self.cycle.amplitude:.0f} um"
            )
        if self.backlash is not None and self.backlash.sure:
            found.append(f"backlash {1e6 * self.backlash.size:.0f} +- {1e6 * self.backlash.stderr:.0f} um")
        return f"{self.joint}: {'; '.join(found)}."

    def to_dict(self) -> dict[str, Any]:
        """Return its content in a result file."""
        along, across = self.bounds()
        scale, scale_stderr = self.scale
        return {
            "joint": self.joint, "n_points": len(self.q), "sentence": self.sentence,
            "residual": {"mean": float(self.sizes.mean()), "std": float(self.sizes.std(ddof=1)), "max": float(self.sizes.max())},
            "within_95_percent": {"along": along, "across": across},
            "direction": self.direction, "scale_error": scale, "scale_error_stderr": scale_stderr,
            "bow": self.bow, "shape_p_value": self.shape, "cycle": self.cycle, "backlash": self.backlash,
        }  # fmt: skip


def fit_guideway(joint: str, q: np.ndarray, points: np.ndarray) -> Guideway:
    """Fit a line to the measured points of one cart.

    Args:
        joint: Name of the actuated joint.
        q: Actuated positions (N,) [m], in the order of measurement.
        points: Measured positions (N, 3) [m], in any fixed frame.

    Raises:
        InputError: Arrays of other shapes, values that are not finite, too few points, or a cart that hardly moved.
    """
    q, points = np.asarray(q, float), np.asarray(points, float)
    _check(joint, q, points)
    x = q - q.mean()
    slope = x @ points / (x @ x)
    centre = points.mean(axis=0)
    e = points - centre - x[:, None] * slope
    direction = slope / np.linalg.norm(slope)
    along, order = e @ direction, np.argsort(q, kind="stable")
    across = e - along[:, None] * direction
    covariance = e.T @ e / (len(q) - 2) * _correlation(e[order]) / (x @ x)
    shape, bow = _shape(q, across, direction)
    backlash, rest = _backlash(q, along)
    return Guideway(
        joint, q, centre - q.mean() * slope, slope, covariance, along, across, bow, shape,
        find_strongest_period(q, rest), backlash, points,
    )  # fmt: skip


def load_shift(line: Guideway, q: np.ndarray, points: np.ndarray) -> dict[str, Any]:
    """Return how far another load moved the cart from the fitted line (the squares of Figure 4.5).

    Args:
        line: The guideway, fitted with the end-effector at one place.
        q: Positions (N,) [m] of a second measurement, the end-effector elsewhere.
        points: Measured positions (N, 3) [m], in the same frame.
    """
    q, points = np.asarray(q, float), np.asarray(points, float)
    _check(line.joint, q, points)
    e = points - line.origin - q[:, None] * line.slope
    mean, n = e.mean(axis=0), len(q)
    variance = (e - mean).T @ (e - mean) / (n - 1) / n + line.residuals.T @ line.residuals / (len(line.q) - 2) / len(
        line.q
    )
    t2 = float(mean @ np.linalg.pinv(variance) @ mean)
    largest = float(np.linalg.norm(e, axis=1).max())
    p_value, size = float(stats.chi2.sf(t2, 3)), float(np.linalg.norm(mean))
    did = "moves" if p_value < SIGNIFICANCE_LEVEL else "does not visibly move"
    return {
        "joint": line.joint, "n_points": n, "shift": mean, "size": size, "p_value": p_value, "largest": largest,
        "sentence": f"{line.joint}: another load {did} the cart: {1e6 * size:.0f} um on average, {1e6 * largest:.0f} um at most.",
    }  # fmt: skip


def _check(joint: str, q: np.ndarray, points: np.ndarray) -> None:
    if q.ndim != 1 or points.shape != (len(q), 3):
        raise InputError(
            "wrong_shape",
            f"{joint}: a guideway needs positions (N,) and points (N, 3), not {q.shape} and {points.shape}",
        )
    if not (np.isfinite(q).all() and np.isfinite(points).all()):
        raise InputError("bad_sample", f"{joint}: every measured point needs finite numbers")
    if len(q) < MIN_POINTS:
        raise InputError(
            "too_little_data",
            f"{joint}: {len(q)} points cannot separate a line from its errors; measure at least {MIN_POINTS}",
        )
    travel = float(np.ptp(q))
    moved = travel >= 10 * np.finfo(float).eps * max(1.0, np.abs(q).max())
    places = len(np.unique(np.round((q - q.min()) / travel, _PLACE_DIGITS))) if moved else 1
    if places < SHAPE_DEGREE + 1:
        raise InputError("too_little_data", f"{joint}: the cart is at {places} places; measure it along its guideway")


def _correlation(e: np.ndarray) -> float:
    """Return the factor by which correlation of neighbours widens a variance: `(1 + rho) / (1 - rho)`."""
    spread = float(np.sum(e**2))
    rho = float(np.sum(e[1:] * e[:-1])) / spread if spread > 0 else 0.0
    rho = min(max(rho, 0.0), 0.95)
    return (1 + rho) / (1 - rho)


def _polynomials(q: np.ndarray) -> np.ndarray:
    """Return Legendre polynomials of degree 0 to `SHAPE_DEGREE` (N, d + 1) over the travel."""
    low, high = q.min(), q.max()
    return np.polynomial.legendre.legvander((2 * q - low - high) / (high - low), SHAPE_DEGREE)


def _fitted(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    return columns @ np.linalg.lstsq(columns, y, rcond=None)[0]


def _shape(q: np.ndarray, across: np.ndarray, direction: np.ndarray) -> tuple[float, SizeEstimate]:
    """Return the p-value of no slow shape, and the bow, in the plane across the guideway."""
    plane = np.linalg.svd(direction[None])[2][1:]
    y, columns = across @ plane.T, _polynomials(q)
    coefficients = np.linalg.lstsq(columns, y, rcond=None)[0]
    rest = y - columns @ coefficients
    lines = y - _fitted(columns[:, :2], y)
    more, free = SHAPE_DEGREE - 1, len(q) - SHAPE_DEGREE - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        F = ((lines**2).sum() - (rest**2).sum()) / (rest**2).sum() * free / more
    p = float(stats.f.sf(F, 2 * more, 2 * free)) if np.isfinite(F) else 1.0
    inverse = np.linalg.inv(columns.T @ columns)
    variance = float((rest**2).sum() / (2 * free) * inverse[2, 2])
    c = coefficients[2]
    size, stderr = (
        1.5 * float(np.linalg.norm(c)),
        1.5 * float(np.sqrt(variance)),
    )  # P2: -1/2 in the middle, 1 at the ends
    return p, SizeEstimate(
        size, stderr, float(stats.f.sf(float(c @ c) / (2 * variance), 2, 2 * free)) if variance > 0 else 1.0
    )


def _backlash(q: np.ndarray, along: np.ndarray) -> tuple[SizeEstimate | None, np.ndarray]:
    """Return twice the part of `e_par` that follows the direction of approach, None with only one; and the rest (N,)."""
    way = np.sign(np.diff(q, prepend=2 * q[0] - q[1]))
    columns = _polynomials(q)
    if min(np.sum(way > 0), np.sum(way < 0)) < _MIXED or len(q) <= columns.shape[1] + 1:
        return None, along - _fitted(columns, along)
    columns = np.column_stack([columns, way])
    c = np.linalg.lstsq(columns, along, rcond=None)[0]
    rest, free = along - columns @ c, len(q) - columns.shape[1]
    stderr = 2 * float(np.sqrt(float(rest @ rest) / free * np.linalg.pinv(columns.T @ columns)[-1, -1]))
    p = 2 * float(stats.t.sf(2 * abs(c[-1]) / stderr, free)) if stderr > 0 else 1.0
    return SizeEstimate(2 * abs(float(c[-1])), stderr, p), rest
