"""Scans of many periods by Fourier sums: against exact regressions on sine and cosine."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tau_dyn.diagnose.periodogram import (
    build_displacement_terms,
    build_force_terms,
    compute_period_statistics,
    project_to_samples,
)
from tau_dyn.effects import CyclicRipple

CUTOFF_HZ = 10.0
OPEN_HZ = 1e9  # nothing is filtered


def passed(speed, periods):
    """Return what the low-pass leaves of a ripple at a speed."""
    return 1 / (1 + (abs(speed) / periods / CUTOFF_HZ) ** 8)


def accelerated(speed, periods):
    """Return the acceleration that it leaves of a displacement at a constant speed."""
    return passed(speed, periods) * (2 * np.pi * speed / periods) ** 2


def strokes(n, speeds, stroke=0.4, rate=50.0):
    """Return positions (n,) and velocities of strokes at one speed after the other, back and forth."""
    v = np.zeros(n)
    for k, speed in enumerate(np.resize(speeds, 400)):
        start, steps = sum_of(speeds, k, stroke, rate), round(stroke / speed * rate)
        v[start : start + steps] = speed if k % 2 == 0 else -speed
        if start + steps >= n:
            break
    return np.cumsum(v) / rate, v


def sum_of(speeds, k, stroke, rate):
    """Return the sample at which stroke k begins."""
    return int(sum(round(stroke / s * rate) for s in np.resize(speeds, k)))


def lines_of(q, fewest=4.0, most=60.0):
    """Return periods a quarter of a line apart, as effects lay out their grid."""
    travel = np.ptp(q)
    return travel / np.arange(fewest, most, 0.25)


def exact(q, weights, periods, e):
    """Return T of sine and cosine, their mean refitted away by nothing, for white residuals e (n,)."""
    found = []
    for w, period in zip(weights.T, periods, strict=True):
        C = w[:, None] * np.column_stack([np.sin(2 * np.pi * q / period), np.cos(2 * np.pi * q / period)])
        found.append(float((C.T @ e) @ np.linalg.solve(C.T @ C, C.T @ e)))
    return np.array(found)


def scanned(q, v, force, periods, rng, cutoff_hz=OPEN_HZ, terms=None, draws=24):
    """Return T (g,) of a white residual that holds a force, and T (g, d) of noise alone."""
    e = force + rng.standard_normal(len(q))
    u = np.column_stack([e, rng.standard_normal((len(q), draws))])
    T = compute_period_statistics(q, v, u, np.ones(len(q), bool), periods, cutoff_hz, terms or build_force_terms(q))
    return e, T[:, 0], T[:, 1:]


@pytest.mark.parametrize("period", [0.0807, 0.0209, 0.0101])
@pytest.mark.parametrize("speeds", [[0.1], [0.02, 0.05, 0.1, 0.2]])
def test_the_hidden_period_is_found_with_its_exact_T(rng, period, speeds):
    """A ripple of any period among strokes of any speeds is the highest line, its T within 20 % of sine and cosine's."""
    q, v = strokes(6000, speeds)
    periods = lines_of(q)
    force = 0.25 * np.sin(2 * np.pi * q / period + 1.0)
    e, T, _ = scanned(q, v, force, periods, rng)
    truth = exact(q, np.ones((6000, len(periods))), periods, e)
    best = int(np.argmax(T))
    assert abs(np.ptp(q) / periods[best] - np.ptp(q) / period) < 0.3  # within a step of the grid
    assert T[best] > 100
    assert_allclose(T[best], truth[best], rtol=0.2)


@pytest.mark.parametrize("weight", [passed, accelerated], ids=["force", "displacement"])
def test_a_filtered_ripple_is_weighed_by_what_its_speed_leaves_of_it(rng, weight):
    """Passed too fast the low-pass removes it, passed slowly acceleration hardly shows it: T is exact with these weights.

    Half of the time the teeth pass at 2.4 times the cutoff, where a scan without weights would only add noise.
    """
    period = 0.0209
    q, v = strokes(8000, [0.05, 0.1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])
    periods = lines_of(q, most=30.0)
    weights = np.array([weight(abs(s), periods) for s in v])
    mine = weight(0.1, np.array([period]))[0]
    size = np.array([weight(abs(s), np.array([period]))[0] for s in v]) / mine
    terms = build_force_terms(q) if weight is passed else build_displacement_terms(v, 0 * v)
    e, T, noise = scanned(q, v, 0.4 * size * np.sin(2 * np.pi * q / period), periods, rng, CUTOFF_HZ, terms)
    truth = exact(q, weights / mine, periods, e)
    best = int(np.argmax(T))
    assert abs(np.ptp(q) / periods[best] - np.ptp(q) / period) < 0.3
    assert_allclose(T[best], truth[best], rtol=0.2)
    assert T[best] > noise.max()


def test_a_long_wave_is_seen_by_its_slope_times_the_acceleration(rng):
    """Shaking while it creeps: a displacement's force is `(i w a - w^2 v^2)` of its wave, and `w a` is most of it."""
    t = np.arange(8000) / 50.0
    q, v, a = 0.3 * np.sin(0.1 * t), 0.03 * np.cos(0.1 * t), -0.003 * np.sin(0.1 * t)
    q, v, a = q + 0.02 * np.sin(12 * t), v + 0.24 * np.cos(12 * t), a - 2.88 * np.sin(12 * t)
    periods = lines_of(q, fewest=2.0, most=12.0)
    w = 2 * np.pi / periods[9]
    force = np.real((1j * w * a - w**2 * v**2) * np.exp(1j * (w * q + 0.7)))
    e, T, _ = scanned(q, v, 0.3 / np.std(force) * force, periods, rng, terms=build_displacement_terms(v, a))
    assert abs(int(np.argmax(T)) - 9) <= 1 and T[9] > 300
    without = scanned(q, v, 0.3 / np.std(force) * force, periods, rng, terms=build_displacement_terms(v, 0 * a))[1]
    assert T[9] > 2 * without[9]


def test_noise_stays_at_its_level(rng):
    """T of noise alone is chi-square of two degrees of freedom at a typical period, so its mean is two at all of them."""
    q, v = strokes(6000, [0.03, 0.1])
    periods = lines_of(q)
    _, T, noise = scanned(q, v, 0.0, periods, rng, draws=200)
    assert_allclose(noise.mean(axis=1), 2.0, atol=0.8)
    assert_allclose(noise.mean(), 2.0, rtol=0.05)
    assert stats.kstest(noise[len(periods) // 2], stats.chi2(2).cdf).pvalue > 0.01
    assert T.max() < noise.max()


def test_the_scan_sees_through_whitening_gaps_and_a_refitted_baseline(make, rng):
    """On a bench with AR(1) noise, gaps and a friction to refit, T is that of exact white rows at the best period."""
    period = 0.0209
    channel = make.bench(rng, lambda m: 0.6 * np.sin(2 * np.pi * m.q / period), n=8000)
    null_model = make.null_model(channel)
    grid = [{"period": x} for x in lines_of(channel.motions[0].q, most=40.0)]
    both = np.column_stack([null_model.e, null_model.draw_null_residuals(24, rng)])
    (u,) = project_to_samples(null_model.whiten.rows, both)
    motion, mask = channel.motions[0], channel.masks(0)[0][:, 0]
    periods = np.array([s["period"] for s in grid])
    T = compute_period_statistics(
        motion.q[:, 0], motion.v[:, 0], u, mask, periods, OPEN_HZ, build_force_terms(motion.q)
    )[:, 0]
    best = int(np.argmax(T))
    C = null_model.whiten_columns(channel.columns(CyclicRipple(("x",), ("N",), **grid[best])))
    s = C.T @ null_model.e
    assert_allclose(T[best], s @ np.linalg.solve(null_model.gram(C), s), rtol=0.2)
    assert abs(1 / periods[best] - 1 / period) < 0.5 / np.ptp(motion.q)


def test_samples_that_do_not_count_do_not_count(rng):
    """What stands beside the mask has no influence; without any sample nothing is explained."""
    q, v = strokes(3000, [0.1])
    periods = lines_of(q)
    u, mask = rng.standard_normal((3000, 25)), rng.uniform(size=3000) < 0.7
    T = compute_period_statistics(q, v, u, mask, periods, OPEN_HZ, build_force_terms(q))
    assert_allclose(
        compute_period_statistics(q, v, np.where(mask[:, None], u, 1e9), mask, periods, OPEN_HZ, build_force_terms(q)),
        T,
    )
    assert not compute_period_statistics(q, v, u, np.zeros(3000, bool), periods, OPEN_HZ, build_force_terms(q)).any()
