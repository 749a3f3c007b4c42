"""Uneven clocks become even ones where that is honest, and gaps stay gaps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.log import Log, ensure_even, examine_clock, resample_segments, split_at_gaps

RATE = 250.0


@pytest.fixture
def even(motion) -> Log:
    t = np.arange(2000) / RATE
    return Log(t, {"q_axis": motion(t), "tau_axis": 30 * motion(t)}, name="tuesday.csv")


@pytest.fixture
def lossy(even):
    """Return the log without the samples given."""

    def lose(samples) -> Log:
        keep = np.setdiff1d(np.arange(even.n_samples), samples)
        return Log(even.t[keep], {k: v[keep] for k, v in even.channels.items()}, name=even.name)

    return lose


def test_an_even_log_is_left_alone(even):
    """The very same log comes back, and is one segment."""
    assert ensure_even(even) is even
    assert split_at_gaps(even) == [even]
    assert examine_clock(even).even


def test_true_jitter_is_interpolated_away(motion, rng):
    """20 % of jitter on samples of a motion up to 8 Hz: after resampling it is the motion to 2 um, and a warning."""
    t = (np.arange(2000) + 0.2 * rng.uniform(-0.5, 0.5, 2000)) / RATE
    log = Log(t, {"q_axis": motion(t), "hole": np.where(np.arange(2000) == 7, np.nan, t)}, name="tuesday.csv")
    assert examine_clock(log).jitter == pytest.approx(0.2, abs=0.02)
    resampled = ensure_even(log)
    assert np.ptp(np.diff(resampled.t)) < 1e-9
    assert_allclose(resampled.channels["q_axis"][2:-2], motion(resampled.t)[2:-2], atol=2e-6)
    assert np.isnan(resampled.channels["hole"]).any()
    assert "steps vary by up to" in resampled.warnings[0] and resampled.warnings[0].startswith("tuesday.csv")


def test_single_lost_samples_are_interpolated_and_counted(even, lossy):
    """Three samples lost at two places come back to 20 um where the 8 Hz wave is 10 mm, with a warning."""
    log = lossy([500, 900, 901])
    assert examine_clock(log).n_missing == 3
    filled = ensure_even(log)
    assert_allclose(filled.t, even.t, atol=1e-9)
    assert_allclose(filled.channels["q_axis"], even.channels["q_axis"], atol=2e-5)
    assert "3 samples are missing" in filled.warnings[0] and "vary" not in filled.warnings[0]


def test_a_gap_is_never_bridged(even, lossy):
    """Twenty lost samples: no interpolation, and two segments that lose nothing else and say why."""
    log = lossy(np.arange(700, 720))
    with raises_code("time_stamps", "tuesday.csv", "1", "0.084", "=", "2.796"):
        ensure_even(log)
    parts = split_at_gaps(log)
    assert [part.n_samples for part in parts] == [700, 1280]
    assert_array_equal(np.concatenate([part.t for part in parts]), log.t)
    assert all("cut there, not bridged" in part.warnings[0] for part in parts)
    assert ensure_even(parts[0]) is parts[0]


def test_two_lost_samples_are_no_gap_and_three_are_one(lossy):
    """The limit lies between them."""
    assert len(split_at_gaps(lossy([700, 701]))) == 1
    assert len(split_at_gaps(lossy([700, 701, 702]))) == 2


def test_a_part_whose_own_step_is_shorter_is_not_cut_again():
    """Steps of 2 ms, then of 1.6 ms: a hole of 5.7 ms is short of a gap beside the whole log's step, so it is interpolated."""
    steps = np.concatenate([np.full(2000, 0.002), [0.02], np.full(300, 0.0016), [0.0057], np.full(300, 0.0016)])
    t = np.concatenate([[0.0], np.cumsum(steps)])
    parts = resample_segments(Log(t, {"q_axis": np.sin(t)}, name="tuesday.csv"))
    assert len(parts) == 2 and examine_clock(parts[1]).even
    with raises_code("time_stamps", "gap"):
        ensure_even(split_at_gaps(Log(t, {"q_axis": np.sin(t)}))[1])


def test_scraps_between_gaps_are_left_out(lossy):
    """Five samples between two gaps are no log."""
    parts = split_at_gaps(lossy([*range(700, 720), *range(725, 740)]))
    assert [part.n_samples for part in parts] == [700, 1260]


def test_rounded_stamps_of_an_even_clock_leave_the_channels_alone(motion):
    """300 Hz written in 0.1 ms steps is an even clock: stamps are replaced, positions are not touched."""
    true = np.arange(3000) / 300
    log = Log(np.round(true, 4), {"q_axis": motion(true)}, name="wednesday.csv")
    assert examine_clock(log).rounded
    result = ensure_even(log)
    assert_array_equal(result.channels["q_axis"], log.channels["q_axis"])
    assert_allclose(result.t, true, atol=1e-4)
    assert "times are rounded" in result.warnings[0]
    assert ensure_even(result) is result


def test_rounded_stamps_with_a_lost_sample_are_not_taken_for_even(motion):
    """A lost sample shifts all that follow, which rounding does not."""
    true = np.delete(np.arange(3000) / 300, 1000)
    log = Log(np.round(true, 4), {"q_axis": motion(true)})
    assert examine_clock(log).n_missing == 1
    assert_allclose(ensure_even(log).channels["q_axis"], motion(np.arange(3000) / 300), atol=3e-4)


def test_jitter_that_was_rounded_is_jitter(motion, rng):
    """Stamps in whole milliseconds that stray by up to 3 ms from an even 100 Hz are no rounding of it."""
    t = np.round(np.arange(1000) / 100 + 3e-3 * rng.uniform(-1, 1, 1000), 3)
    assert not examine_clock(Log(t, {"q_axis": motion(t)})).rounded
