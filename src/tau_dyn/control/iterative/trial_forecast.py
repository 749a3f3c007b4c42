"""What the next trial's error will be: its mean, and a 95 % interval of its RMS from draws of what is not known.

With the error e of a trial, part of which (n) does not repeat, and a change du of the command, the next trial has

    e' = e - n - G du + n'

G and n have the distributions that the trials gave (`TrialResponse`). The part of e that is n is not learnable and not repeated:
given e it has at each frequency the mean `w e` and the variance `(1 - w) S`, `w = S / S_e` (Wiener). Coulomb friction may hold
the drive: before a change has been seen, the upper end is at least the error as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.control.iterative.trial_response import TrialResponse

_DRAWS = 400  # the ends of a 95 % interval then come from ten draws on each side
_QUANTILES = (0.025, 0.5, 0.975)
_SEED = 0  # the same trials give the same interval


@dataclass(frozen=True, eq=False)
class Forecast:
    """One drive's next trial.

    Attributes:
        error: Its mean error (N,) [m or rad].
        rms: Median of its RMS where learning acts fully [m or rad].
        low: Lower end of the 95 % interval.
        high: Upper end.
    """

    error: np.ndarray
    rms: float
    low: float
    high: float

    def widened(self, below: float, above: float) -> Forecast:
        """Return the same with each end further from the median by a factor, on a scale of ratios."""
        low, high = self.rms * (self.low / self.rms) ** below, self.rms * (self.high / self.rms) ** above
        return Forecast(self.error, self.rms, low, high)

    def score(self, rms: float) -> float:
        """Return how far an outcome is from the median, in standard deviations of a lognormal distribution."""
        end = self.high if rms > self.rms else self.low
        return float(np.log(rms / self.rms) / max(abs(np.log(end / self.rms)) / 1.96, 1e-9))


def forecast_trial(response: TrialResponse, error: np.ndarray, change: np.ndarray, full: slice) -> Forecast:
    """Return the next trial's error.

    Args:
        response: From the trials so far.
        error: Of the trial that the change starts from (N,) [m or rad].
        change: Of the command (N,).
        full: Where learning acts fully.
    """
    rng = np.random.default_rng(_SEED)
    E, moved = response.transform(error), response.mean * response.transform(change)
    size = np.maximum(response.bands.average(np.abs(E) ** 2), 1e-300)
    w = np.minimum(response.noise / size, 1.0)
    kept = (1 - w) * E
    mean = response.restore(kept - moved)
    power = (2 - w) * response.noise + response.bend * np.abs(moved) ** 2
    spread = np.sqrt(power * response.length / response.n)[:, None] * _draw_white(rng, len(E))  # no trial is that long
    unsure = (response.deviation * response.transform(change))[:, None] * response.bands.draw(rng, _DRAWS)
    heavy = np.sqrt(response.freedom / rng.chisquare(response.freedom, _DRAWS)) if response.freedom else 1.0
    drawn = (kept - moved)[:, None] + heavy * (spread + unsure)
    signals = response.restore(drawn)[full]
    low, middle, high = np.quantile(np.sqrt(np.mean(signals**2, axis=0)), _QUANTILES)
    if not response.freedom:
        high = max(float(high), float(np.sqrt(np.mean(error[full] ** 2))))
    return Forecast(mean, float(middle), float(low), float(high))


def _draw_white(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return complex noise (n, draws) of unit variance."""
    shape = (n, _DRAWS)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
