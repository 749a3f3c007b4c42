"""The extended model judged on data used for nothing else."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import ViscousAsymmetry
from tau_dyn.evidence.extended_fit import (
    build_extended_regression,
    compute_errors,
    compute_gain,
    estimate_noise_floor,
    fit_extended_model,
)
from tau_dyn.evidence.measurements import TEST, TRAIN

EFFECT = ViscousAsymmetry(("x",), ("N",))


@pytest.fixture
def channel(make, rng):
    """Two joints, of which x has a friction of 20 |v| that the baseline lacks."""
    return make.bench(rng, lambda m: 20 * np.abs(m.v) * [1, 0], joints=("x", "y"), n=8000)


def test_the_extended_fit_gets_the_amplitude_and_the_floor(channel):
    """Refitted beside the baseline the amplitude is 20 within four standard errors, and what is left is the noise of 1 N."""
    rng = np.random.default_rng(0)
    before, after = (fit_extended_model(channel, effects, None, rng) for effects in ((), (EFFECT,)))
    p = after.estimate.parameters["x.viscous_asymmetry"]
    assert_allclose(p.value, 20, atol=4 * p.stderr)
    assert before.errors.rms[0] > 1.3 > 1.1 > after.errors.rms[0]
    assert_allclose(after.errors.rms, 1.0, rtol=0.1)
    assert np.all(after.errors.ci95[:, 0] < after.errors.rms) and np.all(after.errors.rms < after.errors.ci95[:, 1])
    low, high = after.errors.relative_ci95
    assert low < after.errors.relative_error_percent < high


def test_a_gain_counts_the_part_that_measures_it_and_nothing_else(channel):
    """Residuals of 2 N that become 1 N are 50 % less; what happens in training, or where samples are masked, does not matter."""
    mask = channel.masks(TEST)[0]
    before, after = (np.where(mask, size, 1e6) for size in (2.0, 1.0))
    after[channel.parts[0] == TRAIN] = 0.0
    gain = compute_gain(channel, [before], [after], ["x"], np.random.default_rng(0))
    assert_allclose([gain.rms_before, gain.rms_after, gain.reduction_percent], [2.0, 1.0, 50.0])
    assert_allclose(gain.ci95, 50.0)
    errors = compute_errors(channel, [before], np.random.default_rng(0))
    assert_allclose(errors.rms, 2.0)


def test_a_gain_is_that_of_the_joints_that_the_cause_acts_on(channel):
    """Half the error of x and none of y is 50 % for a cause on x, 0 % for one on y, and less than 50 % for both."""
    before = np.full(channel.runs[0].y.shape, 2.0)
    after = before * [0.5, 1.0]
    gains = [
        compute_gain(channel, [before], [after], joints, np.random.default_rng(0)).reduction_percent
        for joints in (["x"], ["y"], ["x", "y"])
    ]
    assert_allclose(gains[:2], [50.0, 0.0], atol=1e-9)
    assert 0 < gains[2] < 50


def test_an_interval_covers_the_gain_of_other_data(channel, make):
    """Two models of random quality, judged block by block: the interval has the long-run gain in 9 of 10 draws or more."""
    rng, hits = np.random.default_rng(1), 0
    scale = np.repeat(rng.uniform(0.5, 2.0, 200), 100)[:8000, None]
    for _ in range(30):
        noise = rng.standard_normal((8000, 2)) * scale
        shift = rng.standard_normal((8000, 2))
        gain = compute_gain(channel, [noise + shift], [noise + 0.5 * shift], ["x", "y"], rng)
        expected = 100 * (1 - np.sqrt((np.mean(scale**2) + 0.25) / (np.mean(scale**2) + 1)))
        hits += gain.ci95[0] - 2.5 < expected < gain.ci95[1] + 2.5
    assert hits >= 27


def test_the_columns_of_effects_stand_after_the_baselines(channel):
    """Parameters and columns keep one order, so values find their columns."""
    regression = build_extended_regression(channel, (EFFECT,))
    assert regression.parameters.names == (*channel.parameters.names, "x.viscous_asymmetry")
    assert_allclose(regression.runs[0].W[:, 0, -1], np.abs(channel.motions[0].v[:, 0]))
    assert_allclose(regression.runs[0].W[:, :, :-1], channel.runs[0].W)


def test_errors_over_all_samples_stand_beside_those_on_the_used_ones(channel):
    """Misses of 1 N where samples are used and of 3 N where not: both are told, with the share used, of the third part alone."""
    run, inside = channel.runs[0], channel.parts[0] == TEST
    whole = np.where(run.usable, 1.0, 3.0)
    whole[~inside] = 1e6
    errors = compute_errors(channel, [np.where(run.usable, 1.0, 1e6)], np.random.default_rng(0), whole=[whole])
    used = run.usable[inside].mean(axis=0)
    assert_allclose(errors.rms, 1.0)
    assert_allclose(errors.all_samples.rms, np.sqrt(used + 9 * (1 - used)))
    told = errors.to_dict()
    assert_allclose(list(told["used_share_per_joint"].values()), used)
    assert 0 < told["used_share"] < 1
    power = np.linalg.norm(run.y_all[inside])
    assert_allclose(told["all_samples"]["relative_error_percent"], 100 * np.linalg.norm(whole[inside]) / power)


def test_a_fitted_model_knows_its_errors_over_all_samples(channel):
    """Every judged model carries both; a residual known on used samples alone carries one."""
    judged = fit_extended_model(channel, (), None, np.random.default_rng(0))
    assert judged.errors.all_samples is not None and len(judged.errors.used_shares) == 2
    assert "all_samples" not in compute_errors(channel, judged.residuals, np.random.default_rng(0)).to_dict()


def test_the_floor_is_the_noise_and_not_what_a_fit_leaves_of_it(make):
    """White noise of 1 N under forty free columns and 700 samples: the floor is 1 N in the mean of 30 logs, to 2 %."""
    floors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        channel = make.bench(rng, n=900)
        y = channel.runs[0].W @ channel.parameters.values + rng.standard_normal((900, 1))
        fit = fit_extended_model(make.measuring(channel, y), (), None, rng)
        floors.append(estimate_noise_floor(make.measuring(channel, y), fit, rng).rms[0] ** 2)
    assert_allclose(np.mean(floors), 1.0, atol=0.04)
