"""Channels that are updated less often than they are logged: held, or interpolated linearly between updates.

The second differences of such a channel are large at its updates and nearly zero between them, or as small as the noise
that was added later. Updates that follow a clock of their own are a comb: the spectrum of the size of the second differences has
equal lines at all multiples of the update rate, which need not divide the rate of the log. The comb's period and phase follow
from the highest line; the mean size at the updates over that between them measures how much of a channel is interpolated. A
vibration has one line, and a quantised channel of changing speed has no line. A motion that repeats itself has a comb, too, but
reverses from line to line: it is recognised by positions that are not smooth at such updates.

A log whose slow channels share one clock is sampled at its updates, so that no sample is interpolated.

**The even clock of a device whose samples a logger stamped late**, seen in the motion itself.

A controller measures at even ticks. A logger that polls it, or receives from a network, stamps each sample when it arrives, part
of a step too late, and misses some. A speed of 1 rad/s turns 0.2 ms of scatter into 0.2 mrad, more than most encoders have of
noise, and after two derivatives it hides the acceleration. It acts on all joints at once, unlike encoder noise:

    q_j(i) = p_j(t_i) - v_j(i) d_i + noise

`p_j` is a cubic through six samples on each side of i, fitted without i, `v_j` its slope, and `d_i` how late the stamp is. Least
squares over the joints gives `d_i`. Subtracting it and fitting again a few times leaves stamps whose steps are right, except
for slow scatter that a cubic follows. If the device has an even clock, these steps are whole ticks. This is the test, and only
such a clock passes it: ripple of the motion, or samples that were truly taken at uneven times, give no whole numbers. A log
whose stamps are accurate to a few hundredths of a tick keeps them.

Ticks are then counted from row to row: by the motion if it is accurate enough, else by the stamp. A row that is no tick ahead
repeats the measurement of the one before. The device's clock is the straight line of the stamps over the ticks. Reference:
Savitzky & Golay 1964 (local polynomials).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from tau_dyn.log.filtering import estimate_quantisation_step
from tau_dyn.log.log import Log
from tau_dyn.log.resample import examine_clock, interpolate

MIN_CONTRAST = 3.0
"""Mean second difference at the updates over that between them. White noise and smooth motion give 1; a set-point generator with
steps of acceleration stays below 2, as the drive smooths them."""

MAX_PERIOD = 200
"""Longest period [samples] that is searched."""

MIN_UPDATES = 30
"""Fewer updates show no comb beyond chance."""

MIN_LINE = 30.0
"""Power of a line over the mean of the spectrum: white noise reaches it in one of 1e13 bins."""

WEAK_LINE = 8.0
"""The same for further lines of a comb whose strongest line is known: five bins of noise reach it once in 600 places."""

LINE_SHARE = 0.8
"""Share of a comb's lines that must be there, and share of its updates that must differ from the samples between them."""

MAX_CHANGES = 1.2
"""Changes of a held channel for each of its updates; a pulse has two."""

MIN_HELD_SHARE = 0.35
"""Share of samples without a change from which a channel is held: half of them are in one that is updated every second sample."""

HIGHEST_LINE = 0.35
"""Lines above this share of the sampling rate fade if updates fall between samples."""

MIN_UPDATE_HZ = 5.0
"""Lowest update rate [Hz] whose samples show dynamics; see `identify/preparation.py`."""

EXTRAPOLATED = 4.0
"""Period [samples] from which a straight piece holds the two samples needed to extrapolate its end between samples."""


class UpdateRate(NamedTuple):
    """The clock of channels that are updated less often than they are logged.

    Attributes:
        columns: Their names.
        period: Time between updates [samples].
        phase: Time of the first update [samples].
        held: Whether they keep their value between updates; else they are interpolated linearly.
    """

    columns: tuple[str, ...]
    period: float
    phase: float
    held: bool

    def list_updates(self, n: int) -> NDArray[np.float64]:
        """Return the times of all updates [samples] within n samples."""
        return np.arange(self.phase, n - 1 + 1e-6, self.period)

    def compute_distance(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far times (n,) are from the nearest update [samples]."""
        return np.abs((at - self.phase + self.period / 2) % self.period - self.period / 2)


def find_update_rates(log: Log, columns: Sequence[str]) -> list[UpdateRate]:
    """Return the clocks of the channels that are updated less often than logged, channels of the same clock together.

    With a motion that is not smooth from update to update, a clock counts only if all channels follow it.

    Args:
        log: A log as read.
        columns: Channels to look at; those that never change are left out, and under an uneven clock interpolated ones.
    """
    clock = examine_clock(log)
    even = clock.even or clock.rounded
    found: list[UpdateRate] = []
    motion = log.joint("q", log.joints("q"))
    for column in columns:
        x = log.channels[column]
        comb = find_comb(x) if np.all(np.isfinite(x)) else None
        if comb is None or not (even or comb.held):
            continue
        for k, other in enumerate(found):
            if other.held == comb.held and _is_same_clock(other, comb, log.n_samples):
                found[k] = other._replace(columns=(*other.columns, column))
                break
        else:
            found.append(comb._replace(columns=(column,)))
    alive = {column for column in columns if np.ptp(log.channels[column]) > 0}
    return [rate for rate in found if alive <= set(rate.columns) or _resolves(motion, rate)]


def _resolves(q: NDArray[np.float64], rate: UpdateRate) -> bool:
    """Return whether the motion (N, n) is smooth from update to update; else the comb is the period of the motion itself.

    A sine with six updates or more a period has second differences smaller than its first ones. They are twice as large for a
    motion that turns back at each update, and 1.7 times for noise.
    """
    seen = q[np.round(rate.list_updates(len(q))).astype(int)]
    return float(np.sum(np.diff(seen, 2, axis=0) ** 2)) < float(np.sum(np.diff(seen, axis=0) ** 2))


def _is_same_clock(one: UpdateRate, other: UpdateRate, n: int) -> bool:
    """Return whether two clocks update within a sample of each other from the first to the last of n samples."""
    drift = abs(one.period - other.period) * n / one.period
    return drift < 1.0 and float(one.compute_distance(np.array([other.phase]))[0]) < 1.0


def find_comb(x: NDArray[np.float64]) -> UpdateRate | None:
    """Return the clock of the updates of one channel (N,); None if its differences have no comb."""
    first = np.abs(np.diff(x))
    held = bool(np.mean(first == 0) > MIN_HELD_SHARE)
    size = first if held else np.abs(np.diff(x, 2))
    n = len(size)
    if n < 2 * MIN_UPDATES or not np.any(size > 0):
        return None
    local = uniform_filter1d(size, min(2 * MAX_PERIOD, n), mode="nearest")
    root = np.sqrt(size / np.maximum(local, 1e-3 * float(size.mean())))
    root -= root.mean()
    power = np.abs(np.fft.rfft(root)) ** 2 / max(float(np.sum(root**2)), 1e-300)
    lowest = max(int(n / MAX_PERIOD), MIN_UPDATES)
    line = lowest + int(np.argmax(power[lowest:])) if len(power) > lowest else 0
    if not line or power[line] < MIN_LINE:
        return None
    frequency, angle = _refine(root, _choose_fundamental(power, line, lowest) / n)
    period, phase = 1 / frequency, (-angle / (2 * np.pi * frequency)) % (1 / frequency)
    distance = UpdateRate((), period, phase, held).compute_distance(np.arange(float(n)))
    at, between = size[distance <= 0.5], size[distance >= min(1.25, period / 2 - 0.5)]
    if not at.size or not between.size or at.mean() < MIN_CONTRAST * between.mean():
        return None
    if np.mean(at > between.mean()) < LINE_SHARE * (1 - np.mean(local < 0.01 * size.mean())):
        return None  # the true period is a multiple, or the channel changes too seldom to decide
    if held and np.count_nonzero(size) > MAX_CHANGES * n / period:
        return None  # pulses, which change twice
    return UpdateRate((), period, (phase + 1.0) % period, held)


def _choose_fundamental(power: NDArray[np.float64], line: int, lowest: int) -> float:
    """Return the fundamental [bins] of which a line is a multiple: the lowest whose multiples are nearly all lines."""
    n = 2 * (len(power) - 1)
    best, least = float(line), float(np.clip(power[line] / 4, WEAK_LINE, MIN_LINE))
    for part in range(2, line // lowest + 1):
        bins = np.arange(1, max(int(HIGHEST_LINE * n * part / line), 1) + 1) * line / part
        near = [power[max(round(b) - 2, 0) : round(b) + 3].max() for b in bins]
        if np.mean(np.array(near) > least) >= LINE_SHARE:
            best = line / part
    return best


def _refine(size: NDArray[np.float64], frequency: float) -> tuple[float, float]:
    """Return a comb's frequency [1/samples] and the angle of its highest line there, from its lines, the lowest first."""
    n, time = len(size), np.arange(len(size)) - len(size) / 2
    line = 1
    while True:
        tried = line * frequency + np.linspace(-1, 1, 21) / n
        sums = [abs(np.exp(-2j * np.pi * f * time) @ size) for f in tried]
        frequency = float(tried[int(np.argmax(sums))]) / line
        if 2 * line * frequency > HIGHEST_LINE:
            break
        line *= 2
    angle = float(np.angle(np.exp(-2j * np.pi * frequency * np.arange(n)) @ size))
    return frequency, angle


def sample_at_updates(log: Log, rates: Sequence[UpdateRate]) -> Log | None:
    """Return a log at the updates of its slowest clock: channels as they were updated, others interpolated.

    Returns:
        The log; None if another clock has no update there, or updates are too rare to show dynamics.
    """
    slow = max(rates, key=lambda rate: rate.period)
    at = slow.list_updates(log.n_samples)
    if log.rate_hz / slow.period < MIN_UPDATE_HZ or any(rate.compute_distance(at).max() >= 1.0 for rate in rates):
        return None
    near = np.round(at)
    if np.all(np.abs(at - near) < 0.25) and abs(slow.period - round(slow.period)) * len(at) < 0.5:
        rows = near.astype(int)
        return Log(log.t[rows], {key: x[rows] for key, x in log.channels.items()}, log.name, log.sha256, log.warnings)
    samples = np.arange(log.n_samples, dtype=float)
    channels = {key: interpolate(samples, x, at) for key, x in log.channels.items()}
    for rate in rates:
        channels.update({key: _read_updates(log.channels[key], at, rate) for key in rate.columns})
    return Log(np.interp(at, samples, log.t), channels, log.name, log.sha256, log.warnings)


def _read_updates(x: NDArray[np.float64], at: NDArray[np.float64], rate: UpdateRate) -> NDArray[np.float64]:
    """Return a channel's values at its updates, which fall between samples."""
    if rate.held:
        return x[np.minimum(np.ceil(at).astype(int), len(x) - 1)]
    before = np.clip(np.floor(at).astype(int), 1, len(x) - 3)
    left = x[before] + (at - before) * (x[before] - x[before - 1])
    right = x[before + 1] - (before + 1 - at) * (x[before + 2] - x[before + 1])
    return (left + right) / 2 if rate.period >= EXTRAPOLATED else np.interp(at, np.arange(len(x)), x)


HALF_WIDTH = 6
"""Samples on each side of the one whose stamp is judged."""

DEGREE = 3
"""Degree of the polynomial through them."""

N_PASSES = 4
"""Fits, each with the stamps of the one before; every pass leaves a third of the scatter."""

MAX_STEP_STDERR = 0.05
"""Standard error of a step [ticks] up to which the motion decides how many ticks it has."""

MIN_INFORMED_SHARE = 0.3
"""Share of the steps at which the motion has to decide."""

MAX_TICK_DISTANCE = 0.25
"""Distance of a step from whole ticks up to which it counts as whole."""

MIN_WHOLE_SHARE = 0.97
"""Share of the informed steps that have to be whole; for steps of random length it is a half."""

MIN_SCATTER = 0.03
"""Median distance of the stamped steps from whole ticks below which the stamps are kept."""

MIN_RATIO = 2.0
"""Least ratio of the steps' distances from whole ticks, by the stamps over by the motion."""

MAX_STRAY_TICKS = 5.0
"""Distance of a stamp from the device's clock [ticks] that a correct count never reaches."""

TRACKING = 0.02
"""Share of a stamp's distance by which the count of ticks follows the stamps."""


class DeviceClock(NamedTuple):
    """Even times of the rows of a log.

    Attributes:
        t: Times of the rows on the device's clock (N,) [s], with whole ticks between them, and equal if a measurement was
            logged twice.
        tick_s: Length of a tick [s].
        scatter_s: Median distance of the stamps from these times [s].
    """

    t: NDArray[np.float64]
    tick_s: float
    scatter_s: float


def find_device_clock(t: NDArray[np.float64], q: NDArray[np.float64]) -> DeviceClock | None:
    """Return the even clock that the motion shows behind scattered stamps; None if stamps are good or there is no such clock.

    Args:
        t: Stamps (N,) [s], increasing, each of another measurement.
        q: Positions (N, n) [m or rad].
    """
    q = q[:, np.ptp(q, axis=0) > 0]
    if len(t) < 20 * HALF_WIDTH or not q.shape[1]:
        return None
    usual = float(np.median(np.diff(t)))
    corrected, stderr = _correct_stamps(t, q, usual)
    steps = np.diff(corrected)
    informed = np.maximum(stderr[1:], stderr[:-1]) * np.sqrt(2) < MAX_STEP_STDERR
    if np.mean(informed) < MIN_INFORMED_SHARE:
        return None
    single = steps[informed & (np.abs(steps / usual - 1) < 0.5)]
    if not single.size:
        return None
    tick = float(np.median(single))
    moved, stamped = (_measure_distance(x[informed] / tick) for x in (steps, np.diff(t)))
    whole = float(np.mean(moved < MAX_TICK_DISTANCE))
    scattered = float(np.median(stamped))
    if whole < MIN_WHOLE_SHARE or scattered < max(MIN_SCATTER, MIN_RATIO * float(np.median(moved))):
        return None
    ticks = _count_ticks(t, steps, informed, tick)
    start, length = np.polynomial.Polynomial.fit(ticks, t, 1).convert().coef
    even = start + length * ticks
    if np.max(np.abs(t - even)) > MAX_STRAY_TICKS * length:
        return None
    return DeviceClock(even, float(length), float(np.median(np.abs(t - even))))


def _correct_stamps(
    t: NDArray[np.float64], q: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stamps (N,) without each row's own delay, and their standard errors (N,) [steps]."""
    inner = slice(HALF_WIDTH, len(t) - HALF_WIDTH)
    floor = np.maximum(estimate_quantisation_step(q) / np.sqrt(12), 1e-12 * np.ptp(q, axis=0))
    stderr = np.full(len(t), np.inf)
    t = t.copy()
    for _ in range(N_PASSES):
        value, slope, spread = _fit_neighbours(t, q)
        residual = (q[inner] - value) / spread[:, None]
        noise = np.maximum(np.median(np.abs(residual), axis=0) / 0.6745, floor)
        u = slope * step / noise
        power = np.maximum(np.sum(u**2, axis=1), 1e-300)
        late = np.sum(u * residual / noise, axis=1) / power * spread
        stderr[inner] = 1 / np.sqrt(power)
        t[inner] += np.where(stderr[inner] < 1, np.clip(late, -1, 1), 0.0) * (1 - 1 / spread**2 / 2) * step
        t = np.maximum.accumulate(t)
    return t, stderr


def _fit_neighbours(
    t: NDArray[np.float64], q: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return value and slope (M, n) of polynomials through the neighbours of each inner row, and their error's spread (M,).

    The spread is the standard deviation of a row minus its polynomial, in standard deviations of one sample's noise.
    """
    around = np.delete(np.arange(2 * HALF_WIDTH + 1), HALF_WIDTH)
    away = np.lib.stride_tricks.sliding_window_view(t, 2 * HALF_WIDTH + 1)[:, around]
    away = away - t[HALF_WIDTH : len(t) - HALF_WIDTH, None]
    unit = away.std(axis=1, keepdims=True)
    powers = (away / unit)[:, :, None] ** np.arange(DEGREE + 1)
    inverse = np.linalg.pinv(np.swapaxes(powers, 1, 2) @ powers)
    weights = inverse[:, :2] @ np.swapaxes(powers, 1, 2)
    neighbours = np.lib.stride_tricks.sliding_window_view(q, 2 * HALF_WIDTH + 1, axis=0)[:, :, around]
    value, slope = (np.einsum("mi,mji->mj", weights[:, k], neighbours) for k in (0, 1))
    return value, slope / unit, np.sqrt(1 + inverse[:, 0, 0])


def _measure_distance(ticks: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.abs(ticks - np.round(ticks))


def _count_ticks(
    t: NDArray[np.float64], steps: NDArray[np.float64], informed: NDArray[np.bool_], tick: float
) -> NDArray[np.intp]:
    """Return the tick (N,) of each row: from the motion if it is accurate enough, else from the stamps."""
    whole = np.round(steps / tick)
    sure = informed & (np.abs(steps / tick - whole) < MAX_TICK_DISTANCE) & (whole >= 0)
    ticks, late = np.zeros(len(t), np.intp), 0.0
    stamped = (t - t[0]) / tick
    for i in range(len(steps)):
        n = whole[i] if sure[i] else max(1, round(stamped[i + 1] - ticks[i] - late))
        ticks[i + 1] = ticks[i] + int(n)
        late += TRACKING * (stamped[i + 1] - ticks[i + 1] - late)
    return ticks
