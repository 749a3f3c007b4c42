"""How data are divided, so that no sample serves two purposes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence.measurements import TEST, TRAIN, VALIDATION, split_by_blocks

RATE_HZ = 100.0


def run_of(duration: float, start: float = 0.0) -> RegressionRun:
    """Return a run of this length [s]."""
    n = round(duration * RATE_HZ)
    none, y = np.zeros((n, 1, 0)), np.zeros((n, 1))
    return RegressionRun("made", start + np.arange(n) / RATE_HZ, none, y, np.ones((n, 1), bool), none, y)


def share(parts: np.ndarray, number: int) -> float:
    return float(np.mean(parts[parts >= 0] == number))


@pytest.mark.parametrize("duration", [40.0, 110.0, 600.0])
def test_a_log_is_divided_three_to_one_to_one(duration):
    """60 % trains, 20 % confirms, 20 % measures, whatever the length and the start of the clock."""
    (parts,) = split_by_blocks([run_of(duration, start=1e4)], [False], 0.0)
    for number, expected in ((TRAIN, 0.6), (VALIDATION, 0.2), (TEST, 0.2)):
        assert_allclose(share(parts, number), expected, atol=0.01)


def test_parts_take_turns_through_the_whole_log():
    """Every third of a two-minute log holds all three parts, so each part sees the warm and the cold robot."""
    (parts,) = split_by_blocks([run_of(120.0)], [False], 0.1)
    for third in np.array_split(parts, 3):
        assert set(third) >= {TRAIN, VALIDATION, TEST}


def test_a_gap_separates_parts_on_both_sides():
    """Within the filter's memory of a border nothing counts, so no filtered sample holds two parts' measurements."""
    gap = 0.25
    (parts,) = split_by_blocks([run_of(110.0)], [False], gap)
    t = np.arange(len(parts)) / RATE_HZ
    used = np.flatnonzero(parts >= 0)
    apart = np.diff(t[used])[np.diff(parts[used]) != 0]
    assert len(apart) > 5
    assert np.all(apart >= 2 * gap - 1.5 / RATE_HZ)
    (plain,) = split_by_blocks([run_of(110.0)], [False], 0.0)
    assert_array_equal(parts[used], plain[used])  # the gaps are taken away from both and moved nowhere
    borders = np.sum(np.diff(plain) != 0)
    assert_allclose(np.sum(parts < 0) / RATE_HZ, borders * 2 * gap, rtol=0.05)


def test_held_out_logs_confirm_and_measure_in_turn_and_the_others_only_train():
    """With held-out logs a training log is used as a whole; a held-out one is halved between confirmation and gain."""
    train, held = split_by_blocks([run_of(60.0), run_of(60.0)], [False, True], 0.0)
    assert_array_equal(train, TRAIN)
    assert_allclose([share(held, VALIDATION), share(held, TEST)], 0.5, atol=0.01)
    assert TRAIN not in held


def test_many_short_pieces_together_have_all_parts():
    """Pieces of 3 s, as lost samples leave them, still give every part its share."""
    parts = np.concatenate(split_by_blocks([run_of(3.0)] * 40, [False] * 40, 0.02))
    for number, expected in ((TRAIN, 0.6), (VALIDATION, 0.2), (TEST, 0.2)):
        assert_allclose(share(parts, number), expected, atol=0.05)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_scrap_of_a_log_does_not_fail(n):
    """One sample, or a few, get some part each."""
    (parts,) = split_by_blocks([run_of(n / RATE_HZ)], [False], 0.1)
    assert parts.shape == (n,)
    assert set(parts) <= {-1, TRAIN, VALIDATION, TEST}


def test_blocks_of_a_short_log_stay_several_gaps_long():
    """Where the filters remember half a second, 20 s are cut into few long blocks: each part keeps two thirds of its samples."""
    gap = 0.5
    (parts,) = split_by_blocks([run_of(20.0)], [False], gap)
    for number, expected in ((TRAIN, 0.6), (VALIDATION, 0.2), (TEST, 0.2)):
        assert np.sum(parts == number) / RATE_HZ > 0.6 * expected * 20.0
    assert np.sum(np.diff(parts[parts >= 0]) != 0) == 4  # train, confirm, train, gain, train


def test_short_pieces_are_blocks_as_a_whole_and_take_turns():
    """Between gaps of a broken log nothing leaks: pieces of 1 s go to one part each, in the order 3 : 1 : 1."""
    found = split_by_blocks([run_of(1.0)] * 10, [False] * 10, 0.15)
    assert all(len(set(parts)) == 1 for parts in found)
    assert [int(parts[0]) for parts in found] == 2 * [TRAIN, VALIDATION, TRAIN, TEST, TRAIN]


def test_a_very_short_log_still_has_three_parts():
    """Four seconds with a memory of 0.2 s on both sides of a border give every part something."""
    (parts,) = split_by_blocks([run_of(4.0)], [False], 0.2)
    assert {TRAIN, VALIDATION, TEST} <= set(parts)
