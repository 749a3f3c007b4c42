"""The even clock of a device whose samples a logger stamped late, seen in the motion itself.

A controller measures at even ticks. A logger that asks it, or is asked by a network, stamps each sample when it arrives, part of
a step too late, and misses some. A speed of 1 rad/s turns 0.2 ms of scatter into 0.2 mrad, more than most encoders have of
noise, and twice differentiated it hides the acceleration. All joints show it at once, which encoder noise does not:

    q_j(i) = p_j(t_i) - v_j(i) d_i + noise

`p_j` is a cubic through six samples on each side of i, fitted without i, `v_j` its slope, and `d_i` how late the stamp is. Least
squares over the joints gives `d_i`. Subtracting it and fitting again a few times leaves stamps whose steps are right, up to
slow scatter that a cubic follows. Where the device has an even clock, these steps are whole ticks. This is the test, and nothing
but such a clock passes it: ripple of the motion, or samples that were truly taken at uneven times, give no whole numbers. A log
whose stamps are good to a few hundredths of a tick keeps them.

Ticks are then counted from row to row: by the motion where it decides, else by the stamp. A row that is no tick ahead was
measured with the one before. The device's clock is the straight line of the stamps over the ticks. Reference: Savitzky & Golay
1964 (local polynomials).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.filtering import estimate_quantisation_step

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
"""Share of the informed steps that have to be whole; of steps of any length half are."""

MIN_SCATTER = 0.03
"""Median distance of the stamped steps from whole ticks below which the stamps are kept."""

MIN_RATIO = 2.0
"""How many times nearer to whole ticks the steps have to be by the motion than by the stamps."""

MAX_STRAY_TICKS = 5.0
"""Distance of a stamp from the device's clock [ticks] that no sound count leaves."""

TRACKING = 0.02
"""Share of a stamp's distance by which the count of ticks follows the stamps."""


class DeviceClock(NamedTuple):
    """Even times of the rows of a log.

    Attributes:
        t: Times of the rows on the device's clock (N,) [s], whole ticks apart, and equal where a measurement was logged twice.
        tick_s: Length of a tick [s].
        scatter_s: Median distance of the stamps from these times [s].
    """

    t: NDArray[np.float64]
    tick_s: float
    scatter_s: float


def find_device_clock(t: NDArray[np.float64], q: NDArray[np.float64]) -> DeviceClock | None:
    """Return the even clock that the motion shows behind scattered stamps; None where stamps are good or there is no such clock.

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
    """Return stamps (N,) from which each row's own delay is taken, and their standard errors (N,) [steps]."""
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
    """Return, of polynomials through the neighbours of each inner row, value and slope (M, n) and the spread of a miss (M,).

    The spread is the standard deviation of what a row is missed by, in standard deviations of one sample's noise.
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
    """Return the tick (N,) of each row: the motion counts where it decides, and the stamps where it does not."""
    whole = np.round(steps / tick)
    sure = informed & (np.abs(steps / tick - whole) < MAX_TICK_DISTANCE) & (whole >= 0)
    ticks, late = np.zeros(len(t), np.intp), 0.0
    stamped = (t - t[0]) / tick
    for i in range(len(steps)):
        n = whole[i] if sure[i] else max(1, round(stamped[i + 1] - ticks[i] - late))
        ticks[i + 1] = ticks[i] + int(n)
        late += TRACKING * (stamped[i + 1] - ticks[i + 1] - late)
    return ticks
