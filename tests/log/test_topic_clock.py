"""A signal on another topic's clock: exact at its own times, a spline where that is honest, else refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.log.resample import (
    MAX_INTERPOLATION_ERROR,
    MIN_CLOCK_SAMPLES,
    MIN_GAP_STEPS,
    estimate_interpolation_error,
    resample_to_clock,
)

STEP = 0.01
T = STEP * np.arange(200)


def test_its_own_times_give_its_own_samples_without_a_word() -> None:
    """All of them, some of them, or one, however few it has."""
    x = np.cos(T)
    for part in (slice(None), slice(3, 150, 7), slice(5, 6)):
        found, said = resample_to_clock("motor", T, x, T[part])
        assert said == ""
        assert_array_equal(found, x[part])
    assert resample_to_clock("motor", T[:2], x[:2], T[:2])[1] == ""


@pytest.mark.parametrize("hertz", [0.5, 5.0, 10.0])
def test_the_error_said_is_about_the_error_made(hertz: float) -> None:
    """A sine between its samples: what is said, in per cent of its spread, is of the size of what is missed."""
    wanted = T[20:-20] + 0.0037
    x = np.sin(2 * np.pi * hertz * T)
    found, said = resample_to_clock("motor", T, x, wanted)
    missed = 100 * np.sqrt(np.mean((found - np.sin(2 * np.pi * hertz * wanted)) ** 2)) / np.std(x)
    start, percent = said.removesuffix(" %").split("error about ")
    assert start == "interpolated from 100 Hz, "
    assert max(missed, 0.01) / 4 < float(percent) < 4 * max(missed, 0.02)


def test_the_first_ten_samples_are_enough_and_nine_are_not() -> None:
    """Of the signal as a whole, and of it during the log."""
    x = np.cos(T)
    _, said = resample_to_clock(
        "motor", T[:MIN_CLOCK_SAMPLES], x[:MIN_CLOCK_SAMPLES], T[: MIN_CLOCK_SAMPLES - 1] + 0.004
    )
    assert "interpolated" in said
    with raises_code("too_little_data", "9"):
        resample_to_clock(
            "motor", T[: MIN_CLOCK_SAMPLES - 1], x[: MIN_CLOCK_SAMPLES - 1], T[: MIN_CLOCK_SAMPLES - 2] + 0.004
        )
    with raises_code("too_little_data", "6"):
        resample_to_clock("motor", T, x, T[50:55] + 0.004)


@pytest.mark.parametrize(("lost", "read"), [(1, True), (2, True), (3, False), (40, False)])
def test_a_gap_is_named_with_its_place_and_not_bridged(lost: int, read: bool) -> None:
    """Longer than three and a half steps; a gap outside the log does not matter."""
    t = np.delete(T, 100 + np.arange(lost))
    assert ((lost + 1) > MIN_GAP_STEPS) is not read
    if read:
        resample_to_clock("motor", t, np.cos(t), T[10:-10] + 0.004)
    else:
        with raises_code("time_stamps", f"{(lost + 1) * STEP:.3g}", "=", "0.99", "0.01"):
            resample_to_clock("motor", t, np.cos(t), T[10:-10] + 0.004)
    resample_to_clock("motor", t, np.cos(t), T[10:80] + 0.004)


def test_what_changes_too_fast_for_its_clock_is_refused(rng) -> None:
    """Noise cannot be told from its neighbours, a sine of a quarter of the rate neither; a constant has nothing to tell."""
    for x in (rng.standard_normal(200), np.sin(2 * np.pi * 25 * T + 0.5)):
        assert estimate_interpolation_error(T, x) > MAX_INTERPOLATION_ERROR
        with raises_code("time_stamps", "100"):
            resample_to_clock("motor", T, x, T[10:-10] + 0.004)
    assert (
        estimate_interpolation_error(T, np.full(200, 3.0)) == 0.0
        and estimate_interpolation_error(T, np.zeros(200)) == 0.0
    )
    assert estimate_interpolation_error(T, 1e9 + 1e-6 * rng.standard_normal(200)) == 0.0  # rounding of a large constant
    found, said = resample_to_clock("motor", T, np.full(200, 3.0), T[10:-10] + 0.004)
    assert_allclose(found, 3.0)
    assert said.endswith("error about 0.01 %")


def test_what_is_missed_is_a_share_of_the_spread() -> None:
    """Noise of a tenth on a slow wave is missed by a tenth of the wave's spread, times what a spline makes of noise, some 1.3."""
    rng = np.random.default_rng(2)
    wave = np.sqrt(2) * np.sin(2 * np.pi * T)
    assert estimate_interpolation_error(T, wave) < 1e-4
    share = estimate_interpolation_error(T, wave + 0.1 * rng.standard_normal(200))
    assert 0.1 < share < 0.17
    assert estimate_interpolation_error(T, 50 * (wave + 0.1 * np.random.default_rng(2).standard_normal(200))) < 0.17
