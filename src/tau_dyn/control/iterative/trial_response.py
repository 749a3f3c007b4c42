"""Response of one drive estimated from its trials: a frequency response with its uncertainty, and the non-repeating part.

The command changes by `du` between trials, and the position by `dy = G du` plus a non-repeating part. A first-order model P
with a delay, fitted to the first trial or given, is multiplied by a complex factor C(f) that varies slowly with frequency:

    G = C P,   Z = C X + noise,   X = F(P du),   Z = F(dy)

C has a prior (mean 1, variance from the residual of P on the first trial) and is updated with the changes, later ones with more
weight: a Gaussian posterior in bands whose width is a share of their frequency [Ljung 1999, 6.4; Pintelon & Schoukens 2012, 2.6].
Coulomb friction makes the response depend on the size of a change; that part is in the residual and so in the uncertainty.

The error of the next trial is predicted by its mean and by a 95 % interval of its RMS, from random draws of the unknowns. If a
trial has the error e, part of which (n) does not repeat, and the command changes by du, the next trial has the error

    e' = e - n - G du + n'

G and n have the distributions estimated from the trials (`TrialResponse`). The part n of e does not repeat and cannot be learnt:
given e it has at each frequency the mean `w e` and the variance `(1 - w) S`, `w = S / S_e` (Wiener). Coulomb friction may hold
the drive: until a change was measured, the upper end of the interval is at least the present error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.fft import next_fast_len

from tau_dyn.control.iterative.learned_outputs import OwnPositions
from tau_dyn.control.iterative.lifted_system import Operator, build_convolution
from tau_dyn.control.iterative.resonant_drive import DriveModel
from tau_dyn.modes import Actuator, Record, fit_actuators

POOR_MODEL = 2.0
"""Error of a model given over that of an actuator fitted to the trial, beyond which a warning states both."""

_BAND_SHARE = 0.25  # half-width of a band over its frequency
_BAND_BINS = 3.0  # least half-width, over the inverse of the trial's length
_KEPT_PER_TRIAL = 0.6  # weight of a change over that of the change after it
_MODEL_STDERR = 0.05  # of C where P explains the first trial completely: P is no more than a first-order model
_ALTERNATIONS = 3  # of response and noise in turn
_UPDATES = 50  # of the split into noise and bend; the likelihood then changes below its own spread
_LEAST_POWER = 1e-30  # m^2 or rad^2, of a transform: below any encoder's, and not zero
_MAX_VARIANCE = 4.0  # of C without any data: gains up to twice the model's, any phase
_SHOWN = 10.0  # times the encoder's noise from which a residual of P is the drive's: a resonance has no such bound


@dataclass(frozen=True, eq=False)
class Bands:
    """A band about each frequency, as wide as a share of it.

    Attributes:
        first: First frequency's index in each band (F,).
        end: Index after the last one (F,).
        independent: Complex values in each band that are independent (F,).
    """

    first: np.ndarray
    end: np.ndarray
    independent: np.ndarray

    @staticmethod
    def of(frequency: np.ndarray, duration: float) -> Bands:
        """Return the bands of evenly spaced frequencies (F,) [Hz] of signals of a duration [s]."""
        half = np.maximum(_BAND_BINS / duration, _BAND_SHARE * frequency)
        first = np.searchsorted(frequency, frequency - half)
        end = np.searchsorted(frequency, frequency + half, side="right")
        return Bands(first, end, (end - first) * (frequency[1] - frequency[0]) * duration)

    def average(self, x: np.ndarray) -> np.ndarray:
        """Return the mean (F, ...) of values (F, ...) in each band."""
        total = np.cumsum(np.concatenate([np.zeros((1, *x.shape[1:]), x.dtype), x]), axis=0)
        count = (self.end - self.first).reshape(-1, *(1,) * (x.ndim - 1))
        return (total[self.end] - total[self.first]) / count

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return complex noise (F, n) of unit variance, as even along frequency as the bands are wide."""
        white = rng.standard_normal((len(self.first), n)) + 1j * rng.standard_normal((len(self.first), n))
        return self.average(white) * np.sqrt((self.end - self.first) / 2)[:, None]


@dataclass(frozen=True, eq=False)
class TrialResponse:
    """One drive's response from command to position, (F,) over frequencies [Hz] on the trial's own grid.

    Attributes:
        model: P with its parameters.
        dt: Step [s].
        n: Samples of a trial.
        frequency: Frequencies [Hz], without zero.
        factor: C, posterior mean.
        stderr: Standard error of C.
        noise: Power of the part of a trial that does not repeat, of its transform (F,) [m^2 or rad^2].
        bend: Mean square of the residual of `G du`, over `|G du|^2` (F,): not zero if the response depends on the change.
        bands: The band about each frequency.
        freedom: Real degrees of freedom of the noise; 0 before the first change.
    """

    model: DriveModel
    dt: float
    n: int
    frequency: np.ndarray
    factor: np.ndarray
    stderr: np.ndarray
    noise: np.ndarray
    bend: np.ndarray
    bands: Bands
    freedom: float

    @property
    def length(self) -> int:
        """Samples of the transform."""
        return count_transform_samples(self.n)

    @property
    def mean(self) -> np.ndarray:
        """Posterior mean of G (F,)."""
        return self.factor * self.model.response(self.frequency, self.dt)

    @property
    def deviation(self) -> np.ndarray:
        """Standard error of G (F,)."""
        return self.stderr * np.abs(self.model.response(self.frequency, self.dt))

    @property
    def model_stderr(self) -> np.ndarray:
        """Standard error of C (F,) that no change of the command lowers: P is no more than a model."""
        return np.hypot(_MODEL_STDERR, self.model.unsure(self.frequency, self.dt))

    def transform(self, x: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) as transforms (F, ...)."""
        return np.fft.rfft(x, self.length, axis=0)[1:]

    def restore(self, spectrum: np.ndarray) -> np.ndarray:
        """Return transforms (F, ...) as signals (N, ...)."""
        zero = np.zeros((1, *spectrum.shape[1:]), spectrum.dtype)
        return np.fft.irfft(np.concatenate([zero, spectrum]), self.length, axis=0)[: self.n]

    def side(self) -> MeasuredSide:
        """Return the learned output for the stability test."""
        return MeasuredSide(self)


@dataclass(frozen=True, eq=False)
class MeasuredSide(OwnPositions):
    """One drive's position with the response estimated from its trials.

    Attributes:
        found: The response.
    """

    found: TrialResponse

    @property
    def dt(self) -> float:
        """Step [s]."""
        return self.found.dt

    def operator(self, n: int) -> Operator:
        """Return G (N, N) as a convolution."""
        whole = np.concatenate([[self.found.factor[0].real * self.found.model.gain], self.found.mean])
        return build_convolution(np.fft.irfft(whole, self.found.length)[:n, None, None])

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return G (F, 1, 1) at frequencies (F,) [Hz]."""
        f = np.asarray(frequency, float)
        known = self.found.frequency
        factor = np.interp(f, known, self.found.factor.real) + 1j * np.interp(f, known, self.found.factor.imag)
        return (factor * self.found.model.response(f, self.dt))[:, None, None]


def count_transform_samples(n: int) -> int:
    """Return the samples of a transform whose circle a trial of `n` samples does not close."""
    return cast(int, next_fast_len(2 * n, real=True))


def choose_model(
    given: DriveModel | None, sent: np.ndarray, position: np.ndarray, dt: float
) -> tuple[DriveModel, float | None, float]:
    """Return P: the given model or an actuator fitted to a trial, whichever explains the trial better.

    A smooth trial hardly shows resonances, so a given model with resonances is kept unless it is worse by `POOR_MODEL`.

    Args:
        given: Model from a file, or None.
        sent: Command of the trial (N,) [m or rad].
        position: Its measured position (N,).
        dt: Step [s].

    Returns:
        P, and RMS errors of the given model and of the fitted actuator on the trial [m or rad].

    Raises:
        CannotAnswer: The command never moves, or the position does not follow it.
    """
    record = Record(sent[:, None], position[:, None], dt, ("command",), ("position",), "trial")
    (fit,) = fit_actuators([record])
    own = float(np.sqrt(np.mean(fit.residuals[0] ** 2)))
    if given is None:
        return fit.actuator, None, own
    left = position - position[0] - (given.simulate(sent, dt) - given.gain * sent[0])
    other = float(np.std(left))
    patience = 1.0 if isinstance(given, Actuator) else POOR_MODEL
    return (given if other <= patience * own else fit.actuator), other, own


def estimate_response(
    model: DriveModel, sent: Sequence[np.ndarray], position: Sequence[np.ndarray], dt: float, full: slice
) -> TrialResponse:
    """Return a drive's response.

    Args:
        model: P.
        sent: Commands of the trials, each (N,) [m or rad], in their order.
        position: Measured positions, in the same form.
        dt: Step [s].
        full: Samples where learning acts fully; the non-repeating part is estimated there.
    """
    n = len(sent[0])
    frequency = np.fft.rfftfreq(count_transform_samples(n), dt)[1:]
    bands = Bands.of(frequency, n * dt)
    blank = np.zeros(len(frequency))
    found = TrialResponse(model, dt, n, frequency, blank + 1.0, blank, blank, blank, bands, 0.0)
    variance = _compute_prior_variance(found, sent[0], position[0])
    pairs = [(b - a, d - c) for a, b, c, d in zip(sent, sent[1:], position, position[1:], strict=False)]
    if not pairs:
        return replace(found, stderr=np.sqrt(variance), noise=blank + _estimate_encoder_power(position[0]))
    weight = (_KEPT_PER_TRIAL ** np.arange(len(pairs))[::-1])[:, None]
    size = _compute_powers(found, [found.model.simulate(du, dt) for du, _ in pairs], full)
    expected = np.where(size > 0, size, 1.0)  # a change of zero has no information about the response, at any weight
    for _ in range(_ALTERNATIONS):
        factor, stderr = _update(found, pairs, weight / expected, variance)
        left = [dy - found.restore(factor * found.transform(found.model.simulate(du, dt))) for du, dy in pairs]
        noise, bend = _split(size, _compute_powers(found, left, full))
        expected = 2 * noise + bend * size
    freedom = float(bands.independent[0])
    return replace(found, factor=factor, stderr=stderr, noise=noise, bend=bend, freedom=freedom)


def _compute_prior_variance(found: TrialResponse, sent: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the variance of C (F,) from the residual of P on a trial's speed."""
    X, Z = _transform_speeds(found, sent, position)
    left, there = found.bands.average(np.abs(Z - X) ** 2), found.bands.average(np.abs(X) ** 2)
    share = left / np.maximum(there, 1e-300)
    slopes = np.abs(2 * np.sin(np.pi * found.frequency * found.dt)) ** 2
    shown = left > _SHOWN * _estimate_encoder_power(position) * slopes
    return np.where(shown, share, np.minimum(share, _MAX_VARIANCE)) + found.model_stderr**2


def _transform_speeds(found: TrialResponse, sent: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return X and Z (F,) of the speeds: an end position that differs from the start has no effect on speeds."""
    X = found.transform(np.diff(found.model.simulate(sent, found.dt)))
    return X, found.transform(np.diff(position))


def _update(
    found: TrialResponse, pairs: list[tuple[np.ndarray, np.ndarray]], weight: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error of C (F,) after changes, each with a weight (K, F) over its residual's power."""
    both = [_transform_speeds(found, du, dy) for du, dy in pairs]
    told = weight * found.bands.independent / np.abs(2 * np.sin(np.pi * found.frequency * found.dt)) ** 2
    precision = 1 / variance + sum(
        g * found.bands.average(np.abs(X) ** 2) for g, (X, _) in zip(told, both, strict=True)
    )
    shown = sum(g * found.bands.average(Z * X.conj()) for g, (X, Z) in zip(told, both, strict=True))
    return (1 / variance + shown) / precision, np.sqrt(1 / precision + found.model_stderr**2)


def _split(size: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return noise (F,) and bend (F,) of residuals' powers (K, F) `2 noise + bend size`, by maximum likelihood.

    Multiplicative updates keep both positive [Fevotte, Bertin, Durrieu 2009, Neural Computation 21]. If all changes have the
    same size, each gets half of the residual.
    """
    power = np.maximum(power, max(1e-12 * power.max(), _LEAST_POWER))
    noise, bend = power.min(axis=0) / 4, np.min(power / np.maximum(size, 1e-300), axis=0) / 2
    for _ in range(_UPDATES):
        model = np.maximum(2 * noise + bend * size, 1e-300)
        towards, away = power / model**2, 1 / model
        noise = noise * np.sum(towards, axis=0) / np.sum(away, axis=0)
        bend = bend * np.sum(size * towards, axis=0) / np.maximum(np.sum(size * away, axis=0), 1e-300)
    return noise, bend


def _estimate_encoder_power(position: np.ndarray) -> float:
    """Return the power of white noise of an encoder: second differences have six times its variance."""
    return (float(np.median(np.abs(np.diff(position, 2)))) / 0.6745) ** 2 / 6 * len(position)


def _compute_powers(found: TrialResponse, signals: Sequence[np.ndarray], full: slice) -> np.ndarray:
    """Return powers (K, F) of signals (N,), scaled to the whole trial from the part where learning acts fully."""
    powers = []
    for x in signals:
        inside = np.zeros_like(x)
        inside[full] = x[full]
        powers.append(found.bands.average(np.abs(found.transform(inside)) ** 2) * found.n / len(x[full]))
    return np.array(powers)


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
        response: Response estimated from the trials so far.
        error: Error of the trial from which the change starts (N,) [m or rad].
        change: Change of the command (N,).
        full: Samples where learning acts fully.
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
