"""Controlled actuators as first-order systems with a dead time, from step responses, with standard errors.

    tau y' + y = gain * r(t - delay)

The reference r is held over each sample, so sampling is exact for any delay, whole samples or not. The thesis writes the same
as `G(q) = q^-d b / (1 - a q^-1)`, (6.11): `d` counts the sample that the hold itself takes, so `delay = (d - 1) dt` there.

The output error, whose noise may be coloured, is minimised. Gain, offset and the decaying rest of an earlier motion
enter linearly and are solved for exactly (variable projection, Golub & Pereyra 1973); the time constant and the delay
are searched. The response has a kink where the delay crosses a sample boundary, so the search proceeds one sample
interval at a time, as long as the error decreases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import matmul_toeplitz
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from tau_dyn.estimate import fit_autoregression
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.modes.record import Record


@dataclass(frozen=True)
class Actuator:
    """One axis from position reference to position.

    Attributes:
        gain: Static gain.
        time_constant: Time constant [s].
        delay: Dead time [s].
    """

    gain: float
    time_constant: float
    delay: float

    @property
    def bandwidth_hz(self) -> float:
        """Frequency at which the gain has dropped by 3 dB [Hz]."""
        return 1 / (2 * np.pi * self.time_constant)

    def simulate(self, reference: np.ndarray, dt: float) -> np.ndarray:
        """Return positions (N,) to a reference (N,), at rest at its first value."""
        return self.gain * filter_at_rest(np.asarray(reference, float), dt, self.time_constant, self.delay)

    def discrete(self, dt: float) -> tuple[np.ndarray, float, int]:
        """Return b (2,), a and d of `G(q) = q^-d (b0 + b1 q^-1) / (1 - a q^-1)`; b1 is zero for a delay of whole samples."""
        whole, near, far, a = _sampled(dt, self.time_constant, self.delay)
        return self.gain * np.array([near, far]), a, whole + 1

    def response(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the sampled response (F,) at frequencies (F,) [Hz]."""
        b, a, d = self.discrete(dt)
        back = np.exp(-2j * np.pi * np.asarray(frequency, float) * dt)
        return (b[0] + b[1] * back) * back**d / (1 - a * back)

    def unsure(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return zeros (F,): the model states no tolerance of its own."""
        del dt
        return np.zeros(len(frequency))

    @staticmethod
    def from_discrete(b: float, a: float, d: int, dt: float) -> Actuator:
        """Return the actuator behind `q^-d b / (1 - a q^-1)`.

        Raises:
            InputError: `a` is not between 0 and 1, or `d` is below 1.
        """
        if not 0 < a < 1 or d < 1:
            raise InputError(
                "invalid_value",
                f"q^-{d} {b:g} / (1 - {a:g} q^-1) is no delayed first-order system: it takes 0 < a < 1 and d >= 1",
            )
        return Actuator(b / (1 - a), -dt / float(np.log(a)), (d - 1) * dt)


def filter_at_rest(reference: np.ndarray, dt: float, time_constant: float, delay: float) -> np.ndarray:
    """Return the response (N,) of unit gain, at rest at the reference's first value."""
    whole, near, far, a = _sampled(dt, time_constant, delay)
    rise = reference - reference[0]
    late = np.concatenate([np.zeros(min(whole + 1, len(rise))), rise])[: len(rise)]
    later = np.concatenate([[0.0], late])[: len(rise)]
    return reference[0] + np.asarray(lfilter([1.0], [1.0, -a], near * late + far * later))


def _sampled(dt: float, time_constant: float, delay: float) -> tuple[int, float, float, float]:
    """Return whole samples of delay, the weights of the input then and one sample earlier, and the pole."""
    whole = int(np.floor(delay / dt + 1e-9))
    part = max(delay - whole * dt, 0.0)  # for this part of each step the older input still acts
    a, left = np.exp(-dt / time_constant), np.exp(-(dt - part) / time_constant)
    return whole, float(1 - left), float(left - a), float(a)


_MAX_START_DELAY_SAMPLES = 64  # samples of delay up to which starts are tried; the search itself may exceed it
_STRIDE = 4  # samples of delay between two starts
_WIDTHS = 12  # time constants that are tried, from half a sample to the length of the test


@dataclass(frozen=True, eq=False)
class ActuatorFit:
    """A fitted actuator.

    Attributes:
        actuator: Gain, time constant, delay.
        covariance: Covariance of these three numbers (3, 3).
        residuals: Measured minus modelled position, test by test.
        fit_percent: `100 (1 - |y - model| / |y - mean|)` over all tests.
    """

    actuator: Actuator
    covariance: np.ndarray
    residuals: tuple[np.ndarray, ...]
    fit_percent: float

    @property
    def stderr(self) -> Actuator:
        """Standard errors of gain, time constant and delay."""
        return Actuator(*(float(x) for x in np.sqrt(np.diag(self.covariance))))

    @property
    def bandwidth_stderr_hz(self) -> float:
        """Standard error of the bandwidth [Hz]."""
        return self.actuator.bandwidth_hz * self.stderr.time_constant / self.actuator.time_constant


def fit_actuators(
    records: Sequence[Record], progress: Callable[[str], None] = lambda step: None
) -> tuple[ActuatorFit, ...]:
    """Return the actuator of each axis from all tests: input k is the reference of output k.

    Args:
        records: The tests.
        progress: Called with a description of each step.

    Raises:
        InputError: References and positions do not pair, the tests differ in rate, or numbers are missing.
        CannotAnswer: A reference never moves, a position does not follow, or a test is too short.
    """
    if not records or any(r.u.shape != r.y.shape or r.u.shape[1] == 0 for r in records):
        raise InputError(
            "mismatch", "every position needs its reference: name as many inputs as outputs, in the same order"
        )
    if any(r.u.shape[1] != records[0].u.shape[1] or abs(r.dt / records[0].dt - 1) > 1e-6 for r in records):
        raise InputError("mismatch", "the tests differ in their axes or their sampling rate")
    if not all(np.all(np.isfinite(r.u)) and np.all(np.isfinite(r.y)) for r in records):
        raise InputError("bad_sample", "a reference or a position is not a number")
    fits, n_axes = [], records[0].u.shape[1]
    for k in range(n_axes):
        progress(f"fitting axis {k + 1} of {n_axes}")
        fits.append(_axis([(r.u[:, k], r.y[:, k]) for r in records], records[0].dt))
    return tuple(fits)


Tests = list[tuple[np.ndarray, np.ndarray]]


def _axis(tests: Tests, dt: float) -> ActuatorFit:
    tests = [(r, y) for r, y in tests if len(r) >= 8 and np.ptp(r) > 0]
    if not tests:
        raise CannotAnswer(
            "poor_excitation",
            "the reference never moves",
            "record a step of the reference and wait until the axis is at rest",
        )
    time_constant, delay = _walk(tests, dt, *_scan(tests, dt))
    linear = np.linalg.lstsq(
        np.vstack(_basis(tests, dt, time_constant, delay)), np.concatenate([y for _, y in tests]), rcond=None
    )[0]
    errors = _errors(tests, dt, time_constant, delay)
    covariance = _covariance(tests, dt, time_constant, delay, linear, errors)
    spread = sum(np.sum((y - y.mean()) ** 2) for _, y in tests)
    percent = 100 * (1 - np.sqrt(sum(np.sum(e**2) for e in errors) / max(spread, 1e-300)))
    gain = float(linear[0])
    if not gain > 2 * np.sqrt(covariance[0, 0]):
        raise CannotAnswer(
            "mismatch", "the position does not follow its reference", "check that the two columns belong together"
        )
    return ActuatorFit(Actuator(gain, time_constant, delay), covariance, tuple(errors), float(percent))


def _basis(tests: Tests, dt: float, time_constant: float, delay: float) -> list[np.ndarray]:
    """Return each test's columns: response of unit gain, then an offset and a decay for each test."""
    out = []
    for k, (reference, _) in enumerate(tests):
        columns = np.zeros((len(reference), 1 + 2 * len(tests)))
        columns[:, 0] = filter_at_rest(reference, dt, time_constant, delay) - reference[0]
        columns[:, 1 + 2 * k] = 1.0
        columns[:, 2 + 2 * k] = np.exp(-np.arange(len(reference)) * dt / time_constant)
        out.append(columns)
    return out


def _errors(tests: Tests, dt: float, time_constant: float, delay: float) -> list[np.ndarray]:
    """Return each test's residual with the linear parameters at their best, by projection."""
    ready = []
    for reference, position in tests:
        decay = np.exp(-np.arange(len(reference)) * dt / time_constant)
        decay -= decay.mean()
        pair = np.column_stack([filter_at_rest(reference, dt, time_constant, delay), position])
        pair = pair - pair.mean(axis=0)
        ready.append(pair - np.outer(decay, decay @ pair / max(decay @ decay, 1e-300)))
    gain = sum(x @ y for x, y in (pair.T for pair in ready)) / max(sum(x @ x for x, _ in (p.T for p in ready)), 1e-300)
    return [pair[:, 1] - gain * pair[:, 0] for pair in ready]


def _scan(tests: Tests, dt: float) -> tuple[float, int]:
    """Return the best of a grid: a time constant, and whole samples of delay."""
    longest = max(len(y) for _, y in tests)
    best = (np.inf, dt, 0)
    for width in np.geomspace(0.5 * dt, longest * dt, _WIDTHS):
        for samples in range(0, min(_MAX_START_DELAY_SAMPLES, longest // 2), _STRIDE):
            loss = sum(float(e @ e) for e in _errors(tests, dt, float(width), samples * dt))
            best = min(best, (loss, float(width), samples))
    return best[1], best[2]


def _walk(tests: Tests, dt: float, width: float, low: int) -> tuple[float, float]:
    """Return the best time constant and delay, from sample to sample while the error falls."""
    loss, width, delay = _within(tests, dt, width, low)
    for direction in (-1, 1):
        at = low
        while at + direction >= 0:
            further = _within(tests, dt, width, at + direction)
            if further[0] >= loss:
                break
            loss, width, delay = further
            at += direction
    return width, delay


def _within(tests: Tests, dt: float, width: float, low: int) -> tuple[float, float, float]:
    """Return the least sum of squares, its time constant and its delay, between `low` and `low + 1` samples of delay."""

    def errors(x: np.ndarray) -> np.ndarray:
        return np.concatenate(_errors(tests, dt, float(np.exp(x[0])), float(x[1]) * dt))

    start = np.array([np.log(width), low + 0.5])
    unit = float(np.sqrt(np.mean(errors(start) ** 2))) or 1.0  # the solver's tolerances are for errors of order one
    found = least_squares(
        lambda x: errors(x) / unit, start, bounds=([-np.inf, low], [np.inf, low + 1]), x_scale=[0.1, 0.1]
    )
    best = (float(2 * found.cost) * unit**2, float(np.exp(found.x[0])), float(found.x[1]) * dt)
    return min([best, *(_at_delay(tests, dt, best[1], k) for k in (low, low + 1))])


def _at_delay(tests: Tests, dt: float, width: float, samples: int) -> tuple[float, float, float]:
    """Return the same for a whole number of samples: at the kink, which the search within a sample only approaches."""

    def loss(x: float) -> float:
        return sum(float(e @ e) for e in _errors(tests, dt, float(np.exp(x)), samples * dt))

    found = minimize_scalar(loss, bracket=(np.log(width), np.log(width) + 0.01))
    return float(found.fun), float(np.exp(found.x)), samples * dt


def _covariance(
    tests: Tests, dt: float, time_constant: float, delay: float, linear: np.ndarray, errors: list[np.ndarray]
) -> np.ndarray:
    """Return the covariance (3, 3) of gain, time constant and delay; residuals as an autoregression (Ljung 1999, 9.4)."""
    steps = (1e-5 * time_constant, 1e-4 * dt)

    def modelled(width: float, late: float) -> list[np.ndarray]:
        return [columns @ linear for columns in _basis(tests, dt, width, max(late, 0.0))]

    slow = zip(modelled(time_constant + steps[0], delay), modelled(time_constant - steps[0], delay), strict=True)
    late = zip(
        modelled(time_constant, delay + steps[1]), modelled(time_constant, max(delay - steps[1], 0.0)), strict=True
    )
    width = 2 * steps[1] if delay >= steps[1] else steps[1] + delay
    J = [
        np.column_stack([columns, (a - b) / (2 * steps[0]), (c - d) / width])
        for columns, (a, b), (c, d) in zip(_basis(tests, dt, time_constant, delay), slow, late, strict=True)
    ]
    n, q = sum(len(e) for e in errors), J[0].shape[1]
    if n <= q:
        raise CannotAnswer(
            "too_little_data", "the tests are too short", "record at least a few time constants after each step"
        )
    noise = fit_autoregression(errors)
    size = np.linalg.norm(np.vstack(J), axis=0)
    J = [part / np.where(size > 0, size, 1.0) for part in J]
    inverse = np.linalg.pinv(sum(part.T @ part for part in J), rcond=1e-13)
    middle = sum(part.T @ matmul_toeplitz(noise.autocovariance(len(part)), part) for part in J)
    scale = np.outer(size, size)  # zero if a parameter has no effect, such as a time constant far below a sample
    covariance = np.full_like(scale, np.inf)
    np.divide(inverse @ middle @ inverse * n / (n - q), scale, out=covariance, where=scale > 0)
    keep = [0, q - 2, q - 1]
    return covariance[np.ix_(keep, keep)]
