"""Search for the coefficients of a Fourier series that minimise a criterion while all bounds hold.

    q_j(t) = home_j + sum_h a_jh sin(h w t) + b_jh (cos(h w t) - 1),   w = 2 pi / period,   h = 1 .. harmonics

with `sum_h h a_jh = 0` (no speed at t = 0) and `sum_h h^2 b_jh = 0` (no acceleration): the motion starts from rest, stops after
any number of whole periods, and contains no frequency above its highest harmonic (Swevers et al. 1997). The problem is

    minimise  criterion(M(x)) + sum over bounds  mean over samples  (mu / 2) max(0, c + lambda / mu)^2

an augmented Lagrangian with exact gradients, each iteration by L-BFGS; multipliers and `mu` grow until the excess over the bounds
is within the margin's slack. Finally the motion is scaled about home until every bound holds on a fine grid. The search may be
stopped at any time; it returns the best motion that keeps all bounds.

If a motion is composed of pieces, their information adds up, and one piece is exchanged at a time until there is no improvement.
Reference: Nocedal & Wright 2006, ch. 17; Fedorov 1972 (exchange).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.excitation.bounds import Bounds, Excess
from tau_dyn.excitation.information import Criterion, Information, compute_information_matrix
from tau_dyn.simulate import MotionProfile


@dataclass(frozen=True, eq=False)
class Series:
    """The family of motions that is searched.

    Attributes:
        home: Positions at the start of every period (na,) [m or rad].
        reach: Largest displacement of each joint (na,) [m or rad]; the size of a coefficient of one.
        period: Length of a period [s].
        harmonics: Number of harmonics, at least 2.
        periods: Number of periods.
    """

    home: np.ndarray
    reach: np.ndarray
    period: float
    harmonics: int
    periods: int

    @property
    def free(self) -> np.ndarray:
        """Directions that start at rest (2 harmonics, 2 harmonics - 2); sines first, then cosines."""
        h = np.arange(1, self.harmonics + 1)
        size = 1 / h  # of one unit, so that all directions move about as fast
        rest = np.zeros((2, 2 * self.harmonics))
        rest[0, : self.harmonics], rest[1, self.harmonics :] = h * size, h**2 * size
        return np.tile(size, 2)[:, None] * null_space(rest)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients: joints, free directions."""
        return len(self.home), 2 * self.harmonics - 2

    @property
    def duration(self) -> float:
        """Length of all periods [s]."""
        return self.period * self.periods

    def waves(self, t: np.ndarray) -> MotionProfile:
        """Return displacement, speed and acceleration of each free direction (n, k) at times (n,) [s], per unit of reach."""
        w = 2 * np.pi / self.period * np.arange(1, self.harmonics + 1)
        sine, cosine = np.sin(t[:, None] * w), np.cos(t[:, None] * w)
        made = (
            np.hstack([sine, cosine - 1]),
            np.hstack([w * cosine, -w * sine]),
            np.hstack([-(w**2) * sine, -(w**2) * cosine]),
        )
        return MotionProfile(*(x @ self.free for x in made))

    def path(self, waves: MotionProfile, x: np.ndarray) -> MotionProfile:
        """Return the motion (n, na) of coefficients (na, k)."""
        scaled = (self.reach[:, None] * x).T
        return MotionProfile(self.home + waves.q @ scaled, waves.v @ scaled, waves.a @ scaled)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Return coefficients (na, k) of a motion that uses all harmonics."""
        return 0.3 * rng.standard_normal(self.shape)


MAX_ITERATIONS = 6  # iterations of the augmented Lagrangian; bounds hold to 1 % after three to five
ITERATIONS = 40  # of L-BFGS within an iteration; it need not converge
_SLACK = 0.01  # share by which a bound may be exceeded between iterations; the last step scales the motion
_FIRST_MU, _GROWTH = 10.0, 5.0
_UNREACHABLE = 1e6  # a cost above any that a motion within reach has
_FINE = 4  # times finer than the samples bounds are checked at
_STARTING = 0.2
"""Share of the time for random motions."""


class Stopped(Exception):
    """The deadline passed, or the user stopped the search."""


@dataclass(eq=False)
class MotionSearch:
    """One search; `best` is its current result.

    Attributes:
        series: The family of motions.
        information: Builder of the regressor's rows.
        bounds: Bounds of a motion.
        criterion: The criterion to be minimised.
        added: Information in addition to the series (prior, strokes), per run (r, r).
        rate_hz: Rate of the log to come [Hz].
        samples: Grid of one period.
        deadline: Time at which the search stops, on the monotonic clock [s].
        progress: Callback that receives a sentence from time to time.
        evaluations: Number of evaluations of the model.
        best: Coefficients (na, k) of the best motion that keeps all bounds; None before there is one.
        value: Its criterion.
    """

    series: Series
    information: Information
    bounds: Bounds
    criterion: Criterion
    added: np.ndarray
    rate_hz: float
    samples: int
    deadline: float
    progress: Callable[[str], None] = lambda step: None
    evaluations: int = 0
    best: np.ndarray | None = None
    value: float = np.inf
    _multipliers: dict[str, np.ndarray] = field(default_factory=dict)
    _mu: float = _FIRST_MU
    _last: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Prepare the grid."""
        self._t = self.series.period * np.arange(self.samples) / self.samples
        self._waves = self.series.waves(self._t)
        self._weight = self.rate_hz * self.series.duration / self.samples

    def matrix(self, x: np.ndarray) -> np.ndarray:
        """Return the information of a motion's coefficients (na, k)."""
        rows = self.information.rows(self.series.path(self._waves, x), steep=False)
        return self._weight * compute_information_matrix(rows) + self.added

    def merit(self, x: np.ndarray) -> float:
        """Return the criterion of coefficients (na, k)."""
        return self.criterion(self.matrix(x), self.information.scale)[0]

    def start(self, rng: np.random.Generator, trials: int) -> None:
        """Try random motions, scaled to the bounds; the best of them is the first `best`, if any keeps them."""
        begun = time.monotonic()
        for k in range(trials):
            self.progress(f"random motion {k + 1} of {trials}")
            self._offer(self.series.random(rng))
            if self.best is not None and time.monotonic() > begun + _STARTING * (self.deadline - begun):
                break

    def improve(self, x: np.ndarray) -> None:
        """Search from coefficients (na, k) until there is no improvement or the deadline passes.

        Raises:
            Stopped: The deadline passed.
        """
        self._multipliers, self._mu = {}, _FIRST_MU
        for k in range(MAX_ITERATIONS):
            before = self.value
            try:
                found = minimize(
                    self._lagrangian, x.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS}
                )
                x = found.x.reshape(self.series.shape)
            finally:
                if self._last is not None:
                    self._offer(self._last)
            left = self._update(x)
            self.progress(
                f"round {k + 1} of {MAX_ITERATIONS}: criterion {self.value:.4g}, bounds exceeded by {100 * left:.1f} %"
            )
            if left < _SLACK and k and before - self.value < 1e-3:
                return

    def _lagrangian(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        if time.monotonic() > self.deadline:
            raise Stopped
        x = flat.reshape(self.series.shape)
        path = self.series.path(self._waves, x)
        try:
            value, slopes = self._value(path)
        except LoopClosureError:
            return _UNREACHABLE, np.zeros_like(flat)
        self._last = x.copy()
        gradient = sum(s.T @ w for s, w in zip(slopes, self._waves, strict=True)) * self.series.reach[:, None]
        return value, np.asarray(gradient).ravel()

    def _value(self, path: MotionProfile) -> tuple[float, list[np.ndarray]]:
        """Return the Lagrangian along a path (n, na) and its derivative by positions, speeds and accelerations (n, na)."""
        self.evaluations += 1
        rows = self.information.rows(path, steep=False)
        changes = self.information.derivatives(path, rows)
        value, gamma = self.criterion(
            self._weight * compute_information_matrix(rows) + self.added, self.information.scale
        )
        pull = 2 * self._weight * rows.Y @ gamma
        slopes = [np.zeros_like(path.q) for _ in range(3)]
        for kind, j, dY, _ in changes:
            slopes[kind][:, j] += np.sum(pull * dY, axis=(1, 2))
        by_tau = [(kind, j, dtau) for kind, j, _, dtau in changes]
        for excess in [*self.bounds.of_states(path, rows.tau, by_tau), *self.bounds.of_places(path.q)]:
            value += self._penalty(excess, slopes)
        return value, slopes

    def _penalty(self, excess: Excess, slopes: list[np.ndarray]) -> float:
        n = len(excess.values)
        pushed = np.maximum(0.0, excess.values + self._multiplier(excess) / self._mu)
        for kind, j, slope in excess.by:
            slopes[kind][:, j] += self._mu / n * np.sum(pushed * slope, axis=1)
        return float(0.5 * self._mu * np.sum(pushed**2) / n)

    def _multiplier(self, excess: Excess) -> np.ndarray:
        known = self._multipliers.get(excess.name)
        return np.zeros_like(excess.values) if known is None else known

    def _update(self, x: np.ndarray) -> float:
        """Update the multipliers, increase the penalty, and return the largest remaining excess."""
        path = self.series.path(self._waves, x)
        rows, most = self.information.rows(path, steep=False), 0.0
        for excess in [*self.bounds.of_states(path, rows.tau, []), *self.bounds.of_places(path.q, slopes=False)]:
            self._multipliers[excess.name] = np.maximum(0.0, self._multiplier(excess) + self._mu * excess.values)
            most = max(most, float(excess.values.max()))
        self._mu *= _GROWTH
        return most

    def _offer(self, x: np.ndarray) -> None:
        """Scale coefficients until all bounds hold, and keep them if they are the best so far."""
        share = self.share(x)
        value = self.merit(share * x) if share else np.inf
        if value < self.value:
            self.best, self.value = share * x, value

    def share(self, x: np.ndarray) -> float:
        """Return the largest share of a motion, to 0.5 %, that keeps all bounds on a fine grid; 0 without any."""
        t = self.series.period * np.arange(_FINE * self.samples) / (_FINE * self.samples)
        waves = self.series.waves(t)
        low, high = 0.0, 1.0
        if self._holds(self.series.path(waves, x)):
            return 1.0
        while high - low > 0.005 and high > 0.01:
            middle = (low + high) / 2
            low, high = (middle, high) if self._holds(self.series.path(waves, middle * x)) else (low, middle)
        return low

    def _holds(self, path: MotionProfile) -> bool:
        """Return whether a path keeps all bounds: cheap bounds first, forces on the coarse grid."""
        if not _kept(self.bounds.of_states(path, np.zeros_like(path.q), [])):
            return False
        few = MotionProfile(*(y[::_FINE] for y in path))
        try:
            if not _kept(self.bounds.of_places(path.q, slopes=False)):
                return False
            return _kept(self.bounds.of_states(few, self.information.rows(few).tau, []))
        except LoopClosureError:
            return False


def _kept(found: list[Excess]) -> bool:
    return all(float(e.values.max()) <= 1e-9 for e in found)


_SWEEPS = 5  # of the exchange over all places; bounds the time


def choose_by_exchange(merit: Callable[[np.ndarray], float], information: np.ndarray, number: int) -> list[int]:
    """Return the pieces, with repetition, whose information adds up to the largest merit.

    Args:
        merit: Function of an information matrix (r, r) to be maximised: determined parameters, or separated causes.
        information: Information of each piece (n, r, r).
        number: Number of pieces to choose.
    """
    merits = [merit(number * one) for one in information]
    chosen, best = [int(np.argmax(merits))] * number, max(merits)
    for _ in range(_SWEEPS):
        before = best
        for slot in range(number):
            rest = sum((information[k] for j, k in enumerate(chosen) if j != slot), np.zeros_like(information[0]))
            found = [merit(rest + one) for one in information]
            if max(found) > best * (1 + 1e-9):
                chosen[slot], best = int(np.argmax(found)), max(found)
        if best <= before * (1 + 1e-3):
            break
    return chosen
