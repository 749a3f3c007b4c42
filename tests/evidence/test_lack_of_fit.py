"""A joint's fit is poor where much of its force is neither fitted nor noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from tau_dyn.estimate import Preparation, Regression, RegressionRun
from tau_dyn.evidence import describe_poor_fits, find_poor_fits
from tau_dyn.message_codes import format_warnings
from tau_dyn.parameters import Parameters

RATE_HZ, CUTOFF_HZ = 25.0, 10.0


def make_residual(missed: float, noise: float, seed: int = 0) -> tuple[Regression, list[np.ndarray]]:
    """Return 40 s of a force of rms 1 through the fit's low-pass, and a residual that misses a share of it beyond noise.

    Args:
        missed: Rms of the slow force that the model lacks.
        noise: Rms of the noise before the low-pass, in its band.
        seed: Seed of the noise.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(40 * RATE_HZ)) / RATE_HZ
    fast = rng.standard_normal(16 * len(t))
    sections = butter(4, CUTOFF_HZ, fs=16 * RATE_HZ, output="sos")
    white = sosfiltfilt(sections, fast)[::16]
    e = noise * white / white.std() + missed * np.sqrt(2) * np.sin(2 * np.pi * 0.3 * t)
    y = (np.sqrt(2) * np.sin(2 * np.pi * 0.5 * t + 1.0))[:, None]
    blank = np.zeros((len(t), 1, 0))
    run = RegressionRun("log", t, blank, y, np.ones(y.shape, bool), blank, y)
    band = Preparation(80.0, CUTOFF_HZ, RATE_HZ, np.zeros(1), 0.01)
    return Regression(Parameters(()), ("j1",), ("N m",), (run,), band), [e[:, None]]


@pytest.mark.parametrize("missed", [0.25, 0.5, 0.9])
def test_a_slow_force_that_the_model_lacks_is_a_poor_fit(missed):
    """A quarter of the force at a frequency of the motion is no noise."""
    (found,) = find_poor_fits(*make_residual(missed, 0.05))
    assert found.joint == "j1"
    assert found.missed_share == pytest.approx(missed, rel=0.05)
    assert found.noise_rms == pytest.approx(0.05, rel=0.2)


def test_friction_that_no_law_describes_is_no_poor_fit():
    """Models of sound geared robots miss up to 15 % of the force."""
    assert find_poor_fits(*make_residual(0.15, 0.02)) == ()


@pytest.mark.parametrize("seed", range(5))
def test_noise_as_large_as_the_force_is_no_poor_fit(seed):
    """A joint that carries hardly any force is fitted as well as its noise allows."""
    assert find_poor_fits(*make_residual(0.0, 0.8, seed)) == ()


def test_a_joint_without_usable_samples_is_not_judged():
    """Nothing is known of a joint whose samples are all masked."""
    regression, residuals = make_residual(0.9, 0.1)
    run = regression.runs[0]
    masked = RegressionRun(run.name, run.t, run.W, run.y, ~run.usable, run.W_all, run.y_all)
    assert find_poor_fits(Regression(regression.parameters, ("j1",), ("N m",), (masked,)), residuals) == ()


def test_the_joints_of_a_poor_fit_are_listed_by_code():
    """A program finds the joints in `warning_joints`."""
    fields = format_warnings(describe_poor_fits(find_poor_fits(*make_residual(0.6, 0.05))))
    assert fields["warning_codes"] == ["poor_fit"]
    assert fields["warning_joints"] == {"poor_fit": ["j1"]}
    assert describe_poor_fits(()) == []
