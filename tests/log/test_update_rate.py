"""A channel of a lower rate shows its own updates, whether it is held or interpolated between them."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.log import Log, check_log, list_data_warnings, mend_log
from tau_dyn.log.update_rate import find_update_rates
from tau_dyn.message_codes import RepairedWarning, get_code

COLUMNS = ("q_a", "tau_a")


@pytest.fixture(scope="module")
def clean() -> Log:
    """Twenty seconds of one joint at 250 Hz, with noise on position and force."""
    rng, t = np.random.default_rng(7), np.arange(5000) / 250
    q = 0.8 * np.sin(1.9 * t) + 0.3 * np.sin(4.3 * t + 1)
    v = np.gradient(q, t)
    tau = 3 * np.gradient(v, t) + 4 * np.tanh(v / 0.01) + 0.2 * rng.standard_normal(t.size)
    return Log(t, {"q_a": q + 2e-5 * rng.standard_normal(t.size), "tau_a": tau}, "joint.csv")


def updated(log: Log, period: float, *, held: bool, phase: float = 0.0) -> Log:
    """Return a log whose channels change at multiples of a period [samples] only, or turn there."""
    n = np.arange(log.n_samples)
    at = np.arange(phase - period, log.n_samples + period, period)
    read = np.floor((n - phase) / period) * period + phase
    channels = {
        key: np.interp(read, n, x) if held else np.interp(n, at, np.interp(at, n, x)) for key, x in log.channels.items()
    }
    return Log(log.t, channels, log.name)


@pytest.mark.parametrize(("period", "phase"), [(2.0, 1.0), (5.0, 2.0), (25.0, 7.0), (7.77, 1.2), (24.37, 3.3)])
@pytest.mark.parametrize("held", [True, False])
def test_the_clock_of_updates_is_found(clean, period: float, phase: float, held: bool) -> None:
    """Period and phase come out to a part of a sample, also of a clock that does not divide the log's."""
    (rate,) = find_update_rates(updated(clean, period, held=held, phase=phase), COLUMNS)
    assert rate.columns == COLUMNS and rate.held is held
    assert rate.period == pytest.approx(period, abs=2e-3)
    late = 0.5 if held and period % 1 else 0.0  # a held update shows at the next sample, half a sample late on average
    assert abs((rate.phase - phase - late + period / 2) % period - period / 2) < 0.2


def test_noise_added_later_does_not_hide_the_updates_of_a_position(clean) -> None:
    """Between updates the second differences are those of the noise alone."""
    rng, log = np.random.default_rng(1), updated(clean, 25.0, held=False)
    noisy = {
        key: x + s * rng.standard_normal(x.size) for (key, x), s in zip(log.channels.items(), (1e-5, 0.1), strict=True)
    }
    (rate,) = find_update_rates(Log(log.t, noisy, log.name), COLUMNS)
    assert rate.period == pytest.approx(25.0, abs=2e-3) and "q_a" in rate.columns


def test_a_log_at_full_rate_has_no_updates(clean) -> None:
    """Noise, rounding and a vibration are no comb."""
    ringing = clean.channels["q_a"] + 1e-3 * np.sin(2 * np.pi * 11.3 * clean.t)
    rounded = {"q_a": np.round(clean.channels["q_a"], 3), "tau_a": np.round(clean.channels["tau_a"])}
    assert not find_update_rates(clean, COLUMNS)
    assert not find_update_rates(clean.with_channels(q_a=ringing), COLUMNS)
    assert not find_update_rates(clean.with_channels(**rounded), COLUMNS)


def test_a_motion_that_repeats_itself_is_no_update_rate() -> None:
    """A triangular stroke turns every 50 samples and is straight between; its positions at the turns are not smooth."""
    rng, t = np.random.default_rng(3), np.arange(5000) / 250
    q = 0.1 * np.abs((t / 0.2) % 2 - 1) + 1e-6 * rng.standard_normal(t.size)
    tau = 3 * np.sign(np.gradient(q)) + 0.1 * rng.standard_normal(t.size)
    assert not find_update_rates(Log(t, {"q_a": q, "tau_a": tau}, "strokes.csv"), COLUMNS)


def test_only_the_updates_are_used(clean) -> None:
    """The samples at the updates are those of the full log, and no result is blocked."""
    mended = mend_log(updated(clean, 5.0, held=False, phase=2.0))
    np.testing.assert_allclose(mended.t, clean.t[2::5])
    np.testing.assert_array_equal(mended.channels["q_a"], clean.channels["q_a"][2::5])
    warnings = list_data_warnings(updated(clean, 5.0, held=False))
    assert [get_code(w) for w in warnings] == ["updated_less_often"] and isinstance(warnings[0], RepairedWarning)
    assert "at 50 Hz instead of 250 Hz" in warnings[0] and check_log(updated(clean, 5.0, held=False)).fit_for_use


def test_a_force_of_a_lower_rate_is_taken_at_its_updates(clean) -> None:
    """The force that is held for five samples is in time where it was read."""
    held = updated(clean, 5.0, held=True, phase=1.0).channels["tau_a"]
    mended = mend_log(clean.with_channels(tau_a=held))
    np.testing.assert_array_equal(mended.channels["tau_a"], clean.channels["tau_a"][1::5])
    np.testing.assert_array_equal(mended.channels["q_a"], clean.channels["q_a"][1::5])


def test_updates_too_rare_for_dynamics_are_a_fault(clean) -> None:
    """At 2.5 Hz a motion of 0.7 Hz is lost between updates."""
    (warning,) = list_data_warnings(updated(clean, 100.0, held=False))
    assert get_code(warning) == "updated_less_often" and not isinstance(warning, RepairedWarning)
