"""Late, low-passed and bent forces on the bench: the amplitude that was hidden comes out within its standard error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from tau_dyn.diagnose.preparation import find_timing
from tau_dyn.effects import Delay, DriveLag, Motion, QuadraticDrag, Stribeck, ViscousCurvature
from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence.candidate_scan import N_NULL_DRAWS, fit_group, scan_causes
from tau_dyn.evidence.null_model import compute_score_test
from tau_dyn.evidence.settings import estimate_amplitudes, refine_settings

RATE_HZ = 50.0


def pushed(motion: Motion) -> Motion:
    """Return the motion with the force that the bench's known baseline takes: mass 20, friction 15 and 30, offset 5."""
    force = 20 * motion.a + 15 * np.sign(motion.v) + 30 * motion.v + 5
    return replace(motion, signals={**motion.signals, "force": force})


def found(make, rng, hidden, causes, noise=1.0):
    """Return the causes tried on a bench with a hidden force, strongest first, and their null_model."""
    motion = pushed(make.moving(rng, ("x",), 6000, size=2.0))
    channel = make.bench(rng, hidden, motions=(motion,), causes=causes, noise=noise)
    null_model = make.null_model(channel)
    candidates = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), causes, set())
    return sorted(candidates, key=lambda c: -c.penalised_statistic), null_model


def late_by(seconds: float):
    """Return the change that a delay makes of the force."""

    def hidden(motion: Motion) -> np.ndarray:
        F = motion.signals["force"][:, 0]
        t = np.asarray(motion.t)
        return (CubicSpline(t, F)(t - seconds) - F)[:, None]

    return hidden


@pytest.mark.parametrize("seconds", [0.008, -0.006, 0.03, 0.06])
def test_a_delay_below_a_sample_and_above_comes_out(make, rng, seconds) -> None:
    """0.3 to 3 samples of 20 ms, either way: setting and amplitude agree with the truth."""
    ranked, null_model = found(make, rng, late_by(seconds), (Delay,))
    best = refine_settings(ranked[0], null_model).fits[0].effect
    (amplitude,) = estimate_amplitudes(best, null_model)
    C = null_model.rows(best)
    stderr = 1 / np.sqrt(compute_score_test(null_model, C, np.zeros(1, bool))[2][0, 0])
    assert abs(amplitude - seconds) < 3 * stderr + 0.03 * abs(seconds)
    assert best.settings["about"] == pytest.approx(seconds, abs=3 * stderr + 0.03 * abs(seconds))


def lagging_by(seconds: float):
    """Return the change that a low-pass makes of the force, stepped finely and written here once more."""

    def hidden(motion: Motion) -> np.ndarray:
        F, t = motion.signals["force"][:, 0], np.asarray(motion.t)
        fine = np.arange(t[0], t[-1], 2e-4)
        x = np.interp(fine, t, F)
        keep = np.exp(-2e-4 / seconds)
        late = lfilter([1 - keep], [1, -keep], x, zi=[keep * x[0]])[0]
        return (np.interp(t, fine, late) - F)[:, None]

    return hidden


def test_a_lag_and_a_delay_are_told_apart_where_data_are_plenty(make, rng) -> None:
    """40 ms of either, on forces of up to 1 Hz with steps: each is named, with its time."""
    for hidden, first, time in ((lagging_by(0.04), "drive_lag", 0.04), (late_by(0.04), "delay", 0.04)):
        ranked, null_model = found(make, rng, hidden, (Delay, DriveLag), noise=0.3)
        assert ranked[0].cause == first
        effect = refine_settings(ranked[0], null_model).fits[0].effect
        assert effect.settings["about"] == pytest.approx(time, rel=0.06)


@pytest.mark.parametrize(
    ("law", "name"),
    [
        (lambda v: 25 * np.arctan(v / 0.1), "viscous_curvature"),
        (lambda v: 40 * np.sign(v) * np.sqrt(np.abs(v)), "viscous_curvature"),
        (lambda v: 30 * v * np.abs(v), "quadratic_drag"),
        (lambda v: 12 * np.sign(v) * np.exp(-np.abs(v) / 0.06), "stribeck"),
    ],
)
def test_friction_that_bends_down_up_or_falls_has_its_own_name(make, rng, law, name) -> None:
    """An arctan and a square root level off; a square grows; a peak at low speed falls."""
    ranked, _ = found(make, rng, lambda m: law(m.v), (QuadraticDrag, Stribeck, ViscousCurvature), noise=0.5)
    assert ranked[0].cause == name


def test_bent_friction_is_predicted_by_its_amplitude(make, rng) -> None:
    """12 N that level off at 0.15 m/s: amplitude and knee within three standard errors."""
    hidden = ViscousCurvature(["x"], ["N"], knee=0.15)
    ranked, null_model = found(make, rng, lambda m: hidden.columns(m)[:, :, 0] * 12, (ViscousCurvature,), noise=0.3)
    effect = refine_settings(ranked[0], null_model).fits[0].effect
    assert effect.settings["power"] == 0.0 and effect.settings["knee"] == pytest.approx(0.15, rel=0.25)
    assert estimate_amplitudes(effect, null_model)[0] == pytest.approx(12, rel=0.25)


def test_a_clean_bench_has_no_timing(make, rng) -> None:
    """Nothing is late: no time is found, and the causes explain what chance does."""
    channel = make.bench(rng, motions=(pushed(make.moving(rng, ("x",), 4000)),))
    values = np.array([20.0, 15.0, 30.0, 5.0])
    assert find_timing(channel.runs, values, np.ones(4, bool)) is None
    null_model = make.null_model(channel)
    for cls in (Delay, DriveLag, ViscousCurvature):
        fit = fit_group(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), cls, ("x",))
        assert fit is not None and fit.p_value > 1e-3


def test_a_large_delay_is_taken_out_of_the_baseline(make, rng) -> None:
    """60 ms late, a fit takes less viscous friction; the values with the delay taken out are the true ones."""
    channel = make.bench(rng, late_by(0.06), motions=(pushed(make.moving(rng, ("x",), 6000, size=2.0)),), noise=0.1)
    (run,) = channel.runs
    run = RegressionRun(run.name, run.t, run.W, run.y, run.usable, run.W, run.y)
    W, y = run.W[run.usable], run.y[run.usable]
    wrong = np.linalg.lstsq(W, y, rcond=None)[0]
    timing = find_timing([run], wrong, np.ones(4, bool))
    assert timing is not None and timing.delays[0] == pytest.approx(0.06, abs=1e-3) and timing.lags[0] == 0
    assert abs(wrong[2] - 30) > 10
    np.testing.assert_allclose(wrong + timing.change, [20, 15, 30, 5], rtol=0.05)


@pytest.mark.parametrize(("peak", "expected"), [(-12.0, 0.0), (12.0, 12.0)])
def test_an_amplitude_that_cannot_be_negative_is_zero(make, rng, peak: float, expected: float) -> None:
    """Friction that is lower at low speed is no Stribeck peak of negative size."""
    hidden = Stribeck(["x"], ["N"], speed=0.06)
    motion = make.moving(rng, ("x",), 6000)
    channel = make.bench(rng, lambda m: hidden.columns(m)[:, :, 0] * peak, motions=(motion,), noise=0.1)
    (amplitude,) = estimate_amplitudes(hidden, make.null_model(channel))
    assert amplitude == pytest.approx(expected, abs=0.5)
