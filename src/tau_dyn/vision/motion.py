r"""Images of a moving plate: their times, the robot's positions in a log of another clock, and the offset between the clocks.

The robot's kinematics are not known here. The plate's position is approximated by a polynomial of the joint positions, which is
possible for any robot near the poses of the motion. The offset `d` between the clocks is the one with the best fit:

    p(t_k) = f(q(t_k + d)) + e_k

Errors have one unknown covariance `S` (the depth is worse than the rest), so the profile log-likelihood of `d` is
`-(n/2) log det(R'R)` with the residuals `R` (n, 3); the degree of `f` minimises BIC. `1 / sum_k D_k' S^-1 D_k` is the variance
of `d`, with the part `D` of the derivative `f_q v` that `f` itself does not explain. Errors of neighbouring images may be
correlated, as `f` is only an approximation, so the variance by Newey and West (1987) is used if it is larger. The plate's
velocity is `f_q v`. Images of one sweep without a return determine `d` poorly: `f` explains a delay equally well, and the
variance is large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Table, read_table

_MAX_DEGREE = 3  # an arm turned by half a radian is a cubic to half a percent
_MIN_ROWS_A_TERM = 2.0  # images for each coefficient of `f`, in each coordinate
_MIN_IMAGES = 12  # fewer leave no degrees of freedom to estimate the error
_MIN_SHARE_INSIDE = 0.7  # of the images that must fall into the log
_GRID_SHARE = 0.08
"""Step of the first search, relative to the time in which joints move by their spread: the minimum is about ten steps wide."""
_MAX_GRID = 20_000  # offsets tried first; bounds the time to a few seconds
_MIN_ADVANTAGE = 6.0  # log-likelihood [nats] by which any other offset must be worse: odds of 400 to 1
_MAX_UNEXPLAINED = 0.25
"""Largest unexplained share of the plate's motion (rms, corrected for degrees of freedom). An arm that turns by radians leaves
0.2 with degree 1, and 0.005 with degree 3; the log of another motion leaves 0.36 or more at its best offset (40 images)."""
_CANDIDATES = 6  # local optima of the first search that are refined
_MAX_GAP_STEPS, _MIN_GAP_S = 8.0, 0.05
"""A gap of a log is longer than this many of its usual steps and this time [s]; the joint positions in it are unknown."""


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """When images were taken, by file name or in their order.

    Attributes:
        t: Times (n,) [s], increasing, of the middle of the exposure.
        images: File names (n,), or None if images are matched by order.
        source: File.
    """

    t: np.ndarray
    images: tuple[str, ...] | None
    source: str


@dataclass(frozen=True, eq=False)
class JointLog:
    """Joint positions over time.

    Attributes:
        t: Times (N,) [s], increasing, by any clock.
        q: Joint positions (N, na).
        source: File.
    """

    t: np.ndarray
    q: np.ndarray
    source: str

    @property
    def curve(self) -> CubicSpline:
        """The positions as a function of time."""
        return CubicSpline(self.t, self.q, axis=0)

    def is_covered(self, t: np.ndarray) -> np.ndarray:
        """Return the mask of times (n,) that are inside the log and outside its gaps."""
        step = np.diff(self.t)
        gap = step > max(_MAX_GAP_STEPS * float(np.median(step)), _MIN_GAP_S)
        index = np.searchsorted(self.t, t, side="right") - 1
        inside = (t >= self.t[0]) & (t <= self.t[-1])
        return inside & ~gap[index.clip(0, len(gap) - 1)]


@dataclass(frozen=True, eq=False)
class LogOffset:
    """The offset between the clocks of images and log, and the plate's velocity.

    Attributes:
        value: Time of the log minus time of the images [s].
        stderr: Its standard error [s].
        degree: Degree of the polynomial of the joint positions.
        velocity: Velocity of the plate at each image (n, 3) [m/s]; nan if the log does not cover the image.
    """

    value: float
    stderr: float
    degree: int
    velocity: np.ndarray


def read_times(path: str | Path) -> ImageTimes:
    """Read times of images: a column `t` [s], and optionally `image` with file names.

    Raises:
        InputError: There is no column `t`, a cell is not a number, times do not increase, or an image is named twice.
    """
    table = read_table(path)
    t = read_increasing(table, "t")
    images = read_image_names(table)
    return ImageTimes(t, images, table.name)


def read_increasing(table: Table, column: str) -> np.ndarray:
    """Return a column of times (n,) that increase.

    Raises:
        InputError: Times do not increase, or the column is missing.
    """
    t = table.numbers(column)
    wrong = np.flatnonzero(np.diff(t) <= 0)
    if wrong.size:
        k = int(wrong[0]) + 1
        raise InputError(
            "time_stamps",
            f"{table.where(k)}, column {column}: {t[k]:g} s comes after {t[k - 1]:g} s; times must increase from row to row",
        )
    return t


def read_image_names(table: Table) -> tuple[str, ...] | None:
    """Return the file names of a column `image`, or `None` if there is no such column.

    Raises:
        InputError: A name occurs twice.
    """
    if "image" not in table.cells:
        return None
    images = tuple(Path(str(cell).strip()).name for cell in table.cells["image"])
    twice = next((name for k, name in enumerate(images) if name in images[:k]), None)
    if twice:
        raise InputError(
            "duplicate_name", f"{table.name}, column image: {twice} is there twice; every image has one row"
        )
    return images


def estimate_clock_offset(t: np.ndarray, position: np.ndarray, weight: np.ndarray, log: JointLog) -> LogOffset:
    """Return the offset between the clock of images and that of a log.

    Args:
        t: Times of images (n,) [s].
        position: The plate's positions (n, 3) [m].
        weight: Inverse of their standard deviations, up to a factor (n,).
        log: Joint positions.

    Raises:
        CannotAnswer: Too few images, a plate that does not follow the joints, or several offsets that fit equally well.
    """
    if len(t) < _MIN_IMAGES:
        raise CannotAnswer(
            "too_little_data",
            f"{len(t)} images with a time show the plate; the offset between the clocks of images and {log.source} needs "
            f"{_MIN_IMAGES}",
            "take 50 images while the robot moves to and fro",
        )
    fit = _OffsetFit(t, position, weight / np.median(weight), log)
    step, grid = fit.list_offsets()
    first = np.array([fit.compute_gain(d, fit.degrees[min(1, len(fit.degrees) - 1)]) for d in grid])
    peaks = _find_peaks(first)
    tried = [fit.refine(grid[k], step) for k in peaks]
    tried.sort(key=lambda found: -found[0])
    gain, value, degree = tried[0]
    stderr, dependence, velocity, unexplained = fit.measure(value, degree)
    if gain / dependence < 2 * _MIN_ADVANTAGE or unexplained > _MAX_UNEXPLAINED:
        raise CannotAnswer(
            "poor_excitation",
            f"the plate's motion does not follow the joints of {log.source} at any offset between the clocks",
            "check that log and images are of one motion; move the joints while images are taken",
        )
    others = [(g, d) for g, d, _ in tried[1:] if abs(d - value) > 2 * step and (gain - g) / dependence < _MIN_ADVANTAGE]
    if others or stderr > 2 * step:
        which = f"{value:.4g} s and {others[0][1]:.4g} s" if others else f"{value:.4g} ± {2 * stderr:.2g} s"
        raise CannotAnswer(
            "not_identifiable",
            f"the images do not determine the offset between their clock and that of {log.source}: {which} fit equally well",
            "move to and fro through the same places, at speeds that do not repeat, and take 50 images or more",
        )
    return LogOffset(value, stderr, degree, velocity)


def _find_peaks(gain: np.ndarray) -> list[int]:
    """Return the indices of the highest local optima."""
    padded = np.concatenate([[-np.inf], gain, [-np.inf]])
    peak = np.flatnonzero((gain >= padded[:-2]) & (gain >= padded[2:]) & np.isfinite(gain))
    return peak[np.argsort(-gain[peak], kind="stable")][:_CANDIDATES].tolist() or [int(np.argmax(gain))]


class _OffsetFit:
    """Fits of a polynomial of the joint positions at any offset."""

    def __init__(self, t: np.ndarray, position: np.ndarray, weight: np.ndarray, log: JointLog) -> None:
        self.t, self.position, self.weight, self.log, self.curve = t, position, weight, log, log.curve
        low, high = log.q.min(axis=0), log.q.max(axis=0)
        self.moving = np.flatnonzero(high - low > 1e-9)
        if not len(self.moving):
            raise CannotAnswer(
                "poor_excitation", f"no joint of {log.source} moves", "take images while the robot moves"
            )
        self.middle, self.half = (low + high)[self.moving] / 2, (high - low)[self.moving] / 2
        n = len(self.moving)
        size = {d: len(_list_terms(n, d)) for d in range(1, _MAX_DEGREE + 1)}
        self.degrees = [d for d, terms in size.items() if _MIN_ROWS_A_TERM * terms <= len(t)]
        if not self.degrees:
            raise CannotAnswer(
                "too_little_data",
                f"{len(t)} images of a robot with {n} moving joints; the offset between the clocks needs "
                f"{int(np.ceil(_MIN_ROWS_A_TERM * size[1]))}",
                "take 50 images or more",
            )

    def list_offsets(self) -> tuple[float, np.ndarray]:
        """Return the step of the first search and all offsets (m,) at which the log covers enough images [s]."""
        speed = np.sqrt(np.mean(np.diff(self.log.q, axis=0) ** 2, axis=0) / np.mean(np.diff(self.log.t)) ** 2)
        spread = self.log.q.std(axis=0)
        step = _GRID_SHARE * float(np.min((spread / np.maximum(speed, 1e-12))[self.moving]))
        ordered = np.sort(self.t)
        outside = int((1 - _MIN_SHARE_INSIDE) * len(ordered))
        low = self.log.t[0] - ordered[outside]
        high = self.log.t[-1] - ordered[len(ordered) - 1 - outside]
        if high < low:
            raise CannotAnswer(
                "too_little_data",
                f"{self.log.source} lasts {np.ptp(self.log.t):.3g} s and the images {np.ptp(self.t):.3g} s: most images are "
                "outside the log at any offset between the clocks",
                "log the joints while all images are taken",
            )
        step = max(step, (high - low) / _MAX_GRID)
        return step, np.arange(low, high + step, step)

    def compute_gain(self, offset: float, degree: int) -> float:
        """Return the log-likelihood minus that of a plate at rest, minus BIC's penalty [nats]."""
        inside = self.log.is_covered(self.t + offset)
        terms = len(_list_terms(len(self.moving), degree))
        n = int(inside.sum())
        if n < max(_MIN_ROWS_A_TERM * terms, _MIN_SHARE_INSIDE * len(self.t)):
            return -np.inf
        x, y = self._build_rows(offset, degree, inside)
        still = x[:, :1]
        before = y - still @ (still.T @ y) / (still.T @ still)
        after = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        floor = 1e-12 * np.trace(before.T @ before) * np.eye(3)
        rise = np.linalg.slogdet(before.T @ before + floor)[1] - np.linalg.slogdet(after.T @ after + floor)[1]
        return 0.5 * n * rise - 1.5 * (terms - 1) * np.log(n)

    def refine(self, offset: float, step: float) -> tuple[float, float, int]:
        """Return gain, offset and degree of the best fit near an offset."""
        found = []
        for degree in self.degrees:
            best: Any = minimize_scalar(
                lambda d, degree=degree: -max(self.compute_gain(d, degree), -1e9),
                bounds=(offset - step, offset + step),
                method="bounded",
                options={"xatol": 1e-4 * step},
            )
            found.append((-float(best.fun), float(best.x), degree))
        return max(found)

    def measure(self, offset: float, degree: int) -> tuple[float, float, np.ndarray, float]:
        """Return the results of a fit.

        Returns:
            The offset's standard error [s], the factor by which dependent errors increase its variance, velocities (n, 3), and
            the unexplained share of the plate's motion.
        """
        inside = self.log.is_covered(self.t + offset)
        x, y = self._build_rows(offset, degree, inside)
        weights, *_ = np.linalg.lstsq(x, y, rcond=None)
        residual = y - x @ weights
        free = max(len(x) - x.shape[1] - 1, 1)
        precision = np.linalg.pinv(residual.T @ residual / free, hermitian=True)
        h = 0.5 * float(np.median(np.diff(self.log.t)))
        ahead, back = (self._compute_terms(offset + d, degree, inside) for d in (h, -h))
        slope = (ahead - back) @ weights / (2 * h)
        own = self.weight[inside, None] * slope
        own = own - x @ np.linalg.lstsq(x, own, rcond=None)[0]
        information = float(np.einsum("ni,ij,nj->", own, precision, own))
        score = np.einsum("ni,ij,nj->n", own, precision, residual) * np.sqrt(len(x) / free)
        dependence = max(1.0, _sum_covariances(score[np.argsort(self.t[inside])]) / max(information, 1e-300))
        velocity = np.full((len(self.t), 3), np.nan)
        velocity[inside] = slope
        spread = y - x[:, :1] @ (x[:, :1].T @ y) / (x[:, :1].T @ x[:, :1])
        share = np.sqrt((residual**2).sum() / free / max(float((spread**2).sum()) / (len(x) - 1), 1e-300))
        return float(np.sqrt(dependence / max(information, 1e-300))), dependence, velocity, float(share)

    def _build_rows(self, offset: float, degree: int, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        w = self.weight[inside, None]
        return w * self._compute_terms(offset, degree, inside), w * self.position[inside]

    def _compute_terms(self, offset: float, degree: int, inside: np.ndarray) -> np.ndarray:
        """Return the monomials (n, terms) of the scaled joint positions."""
        z = (self.curve(self.t[inside] + offset)[:, self.moving] - self.middle) / self.half
        terms = _list_terms(len(self.moving), degree)
        return np.column_stack([np.prod(z[:, list(which)], axis=1) for which in terms])


def _list_terms(n: int, degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of n variables up to a degree, each as a tuple of its variables."""
    return [term for d in range(degree + 1) for term in combinations_with_replacement(range(n), d)]


def _sum_covariances(score: np.ndarray) -> float:
    """Return the variance of the sum of scores (n,) that depend on their neighbours (Newey & West 1987, Bartlett weights)."""
    n = len(score)
    lags = int(np.floor(4 * (n / 100) ** (2 / 9)))
    total = float(score @ score)
    for lag in range(1, min(lags, n - 1) + 1):
        total += 2 * (1 - lag / (lags + 1)) * float(score[lag:] @ score[:-lag])
    return total


def compute_velocity(t: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return velocities (n, 3) [m/s] by differences to the images before and after; times (n,) may have any order."""
    if len(t) < 2:
        return np.full((len(t), 3), np.nan)
    order = np.argsort(t)
    out = np.empty((len(t), 3))
    out[order] = np.gradient(position[order], t[order], axis=0)
    return out


def list_uncovered(log: JointLog, t: np.ndarray, names: Sequence[str]) -> dict[str, str]:
    """Return the images that a log does not cover, with the reason."""
    out = {}
    for k in np.flatnonzero(~log.is_covered(t)).tolist():
        inside = log.t[0] <= t[k] <= log.t[-1]
        where = "in a gap of" if inside else "outside of"
        out[names[k]] = f"it was taken at {t[k]:.4g} s by the clock of {log.source}, {where} that log"
    return out
