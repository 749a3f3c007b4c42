"""Recovery: what is identified from simulated logs is the truth, as often and as closely as the standard errors say.

The full study is `experiments/recovery.py` (50 seeds, five plants, other rates, encoders, colours and robots).
"""

from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.identify import build_regression, identify
from tau_dyn.simulate import Sensors, build_named_motion, measure, simulate

SEEDS = 10
NOISE = Sensors(encoder_noise=5e-6, force_noise=5.0, log_rate_hz=500.0)


def z_of(found, truth) -> np.ndarray:
    """Return how many standard errors each base parameter is off (r,)."""
    e = found.estimate
    true = e.base.combine(truth.parameters.select(e.base.names).values)
    return (e.beta - true) / e.stderr


@pytest.fixture(scope="module")
def trials(l1, driven):
    """Return what is found with ten seeds of noise on one plant: `[(found, held-out log), ...]`."""
    results = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([1, seed])
        fit, held = (measure(run, NOISE, rng, name) for run, name in zip(driven, ("fit", "held"), strict=True))
        results.append((identify(l1, fit, holdout=held), held))
    return results


def test_every_parameter_of_l1_comes_back(trials, truth):
    """All nineteen are identifiable and determined, each within 4.5 standard errors of the truth in ten seeds."""
    for found, _ in trials:
        rows = found.rows()
        assert len(rows) == 19
        assert all(row["identifiable"] for row in rows)
        values = {p.name: p.value for p in truth.parameters}
        off = {r["name"]: (r["value"] - values[r["name"]]) / r["stderr"] for r in rows}
        assert max(map(abs, off.values())) < 4.5, off


def test_intervals_cover_the_truth_about_as_often_as_they_say(trials, truth):
    """Of 190 intervals of 95 % at least 88 % hold: 4.4 binomial deviations of 1.6 %, as those of one seed are related.

    The rms of z lies between 0.8 and 1.2, so errors are neither understated nor blown up.
    """
    z = np.array([z_of(found, truth) for found, _ in trials])
    assert np.mean(np.abs(z) < 1.96) > 0.88
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.2


def test_held_out_residual_is_the_noise(trials, l1):
    """The held-out residual is that of the noise alone through the same filters and masks, to 4 % on average.

    Noise alone is a log whose forces are noise; what the fit does not know of 19 parameters adds about 1 %.
    """
    ratios = []
    for seed, (found, held) in enumerate(trials):
        noise = NOISE.read_forces(np.zeros((held.n_samples, 3)), np.random.default_rng([2, seed]))
        blank = replace(
            held, channels=dict(held.channels) | {f"tau_{j}": noise[:, k] for k, j in enumerate(l1.actuated)}
        )
        preparation = found.estimate.regression.preparation
        floor = np.sqrt(np.mean(build_regression(found.model, [blank], preparation=preparation).stacked()[1] ** 2))
        W, y, _ = found.held.stacked()
        ratios.append(np.sqrt(np.mean((y - W @ found.estimate.theta) ** 2)) / floor)
    assert 0.94 < np.mean(ratios) < 1.04


def test_reversals_leave_no_bias(l1, driven, truth):
    """At 1 kHz, 1 N and 1 um, where noise hides little, no parameter is off on average: means of ten z within 3.5 / sqrt(10).

    Gates a quarter as long, or blind to reversals between two samples, bias Coulomb friction beyond that.
    """
    sensors = replace(NOISE, log_rate_hz=1000.0, force_noise=1.0, encoder_noise=1e-6)
    z = []
    for seed in range(SEEDS):
        log = measure(driven[0], sensors, np.random.default_rng([3, seed]))
        z.append(z_of(identify(l1, log), truth))
    assert np.max(np.abs(np.mean(z, axis=0))) < 3.5 / np.sqrt(SEEDS)


def test_encoders_in_the_feedback_do_not_bias(l1, truth):
    """Where noise also drives the robot, as in a real controller, all parameters are within 4.5 standard errors."""
    log = simulate(truth, build_named_motion("fourier", truth, 20.0, 6), sensors=NOISE, seed=7)
    assert np.max(np.abs(z_of(identify(l1, log), truth))) < 4.5


def test_a_clean_log_gives_the_truth(l1, truth, make):
    """Without noise every mass is within 0.2 % and every friction coefficient within 0.1 %.

    What is left is what the position filter leaves of each reversal (0.3 %); central differences pass 1.2 Hz to 1e-6.
    """
    log = make.recorded(truth, build_named_motion("fourier", truth, 30.0, 1), force_noise=0.0, encoder_noise=0.0)
    for p in identify(l1, log).parameters:
        if p.free:
            tolerance = 2e-3 if p.name.endswith("mass") else 1e-3
            assert abs(p.value - truth.parameters[p.name].value) < tolerance * truth.parameters[p.name].value, p
