"""Sensors: noise of the size and colour asked for, rounding, sampling without averaging."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.signal import welch

from tau_dyn.exceptions import InputError
from tau_dyn.simulate import Sensors, build_fourier_motion, measure, simulate_drive


@pytest.fixture(scope="module")
def run(block):
    """One ideal run of 8 s, measured in many ways below."""
    return simulate_drive(
        block, build_fourier_motion(block, 8.0), None, Sensors(), np.random.default_rng(0), feedback="ideal"
    )


def test_perfect_sensors_show_the_truth(run, rng):
    """Without noise the log is the run."""
    log = measure(run, Sensors(), rng)
    assert_allclose(log.joint("q", ["axis"]), run.q, rtol=0, atol=0)
    assert_allclose(log.joint("tau", ["axis"]), run.tau, rtol=0, atol=0)
    assert_allclose(log.joint("q_ref", ["axis"]), run.reference.q, rtol=0, atol=0)


def test_log_is_sampled_and_not_averaged(run, rng):
    """At a quarter of the control rate each sample is exactly every fourth of the run, at its own time."""
    log = measure(run, Sensors(log_rate_hz=250), rng)
    assert_allclose(log.rate_hz, 250)
    assert np.array_equal(log.channels["tau_axis"], run.tau[::4, 0]) and np.array_equal(log.t, run.t[::4])
    with raises_code("invalid_value", "300", "1000"):
        measure(run, Sensors(log_rate_hz=300), rng)


def test_force_noise_has_the_size_asked_for(run, rng):
    """White noise of 5 N, and noise of 1 % of the force's rms, within the sampling error of 8001 samples (0.8 %)."""
    noise = measure(run, Sensors(force_noise=5.0), rng).channels["tau_axis"] - run.tau[:, 0]
    assert_allclose(np.std(noise), 5.0, rtol=0.04)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.04
    relative = measure(run, Sensors(force_noise_relative=0.01), rng).channels["tau_axis"] - run.tau[:, 0]
    assert_allclose(np.std(relative), 0.01 * np.sqrt(np.mean(run.tau**2)), rtol=0.04)


def test_force_noise_has_the_colour_asked_for():
    """AR(2) noise has the autocorrelation of Yule and Walker and the requested standard deviation."""
    c1, c2 = 1.2, -0.5
    sensors = Sensors(force_noise=3.0, force_ar=(c1, c2))
    noise = sensors.read_forces(np.zeros((200_000, 2)), np.random.default_rng(4))
    rho1 = c1 / (1 - c2)
    assert_allclose(noise.std(axis=0), 3.0, rtol=0.03)
    for x in noise.T:
        assert_allclose(np.mean(x[1:] * x[:-1]) / np.var(x), rho1, atol=0.01)
        assert_allclose(np.mean(x[2:] * x[:-2]) / np.var(x), c1 * rho1 + c2, atol=0.02)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.02


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_power_law_noise_falls_with_its_exponent(exponent):
    """The spectral density is `1 / f^b`; its mean standard deviation is the one asked for."""
    sensors = Sensors(force_noise=2.0, force_power_law=exponent)
    noise = sensors.read_forces(np.zeros((65_536, 40)), np.random.default_rng(1))
    f, density = welch(noise, fs=1.0, nperseg=4096, axis=0)
    band = (f > 0.01) & (f < 0.3)
    slope = np.polyfit(np.log(f[band]), np.log(density[band].mean(axis=1)), 1)[0]
    assert_allclose(slope, -exponent, atol=0.1)
    assert_allclose(np.sqrt(np.mean(noise**2)), 2.0, rtol=0.25 if exponent > 1.5 else 0.05)


def test_encoder_rounds_to_its_resolution(run, rng):
    """Positions stand on the encoder's grid, and rounding alone errs by at most half a step."""
    q = measure(run, Sensors(encoder_resolution=1e-5), rng).channels["q_axis"]
    assert_allclose(q / 1e-5, np.round(q / 1e-5), atol=1e-6)
    assert 0.4e-5 < np.max(np.abs(q - run.q[:, 0])) <= 0.5e-5 + 1e-15
    noisy = measure(run, Sensors(encoder_noise=2e-5), rng).channels["q_axis"]
    assert_allclose(np.std(noisy - run.q[:, 0]), 2e-5, rtol=0.04)


def test_tool_is_measured_where_there_is_one(gantry, rng):
    """The gantry's tool appears with its noise; a robot without tool frame has no such columns."""
    ideal = simulate_drive(gantry, build_fourier_motion(gantry, 4.0), None, Sensors(), rng, feedback="ideal")
    log = measure(ideal, Sensors(tool_noise=1e-4, log_rate_hz=500), rng)
    error = np.column_stack([log.channels[f"{x}_tool"] for x in "xyz"]) - gantry.mechanism.tool_position(ideal.q[::2])
    assert_allclose(error.std(axis=0), 1e-4, rtol=0.1)
    assert "x_tool" not in measure(ideal, Sensors(tool=False), rng).channels


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"force_noise": -1.0}, "force_noise must not be below zero"),
        ({"force_ar": (1.1,)}, "would grow"),
        ({"force_ar": (0.5,), "force_power_law": 1.0}, "not by both"),
        ({"force_power_law": 5.0}, "between 0"),
    ],
)
def test_impossible_sensors_are_refused(wrong, words):
    """Each fault in one sentence."""
    with pytest.raises(InputError, match=words):
        Sensors(**wrong)


def test_numbers_must_fit_the_joints(run, rng):
    """Three numbers for one joint are refused by name."""
    with raises_code("wrong_shape", "encoder_noise", "3", "1"):
        measure(run, Sensors(encoder_noise=(1e-6, 1e-6, 1e-6)), rng)
