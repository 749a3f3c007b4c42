"""What pieces of logs have in common: sure directions of motion, and samples free of the filter's ends."""

import numpy as np
from numpy.testing import assert_array_equal

from tau_dyn.diagnose.measured_channel import find_directions, mask_filter_edges
from tau_dyn.log import compute_edge_samples, lowpass


def test_a_joint_stays_on_the_side_from_which_it_came():
    """Too slow to tell, it keeps the last sure direction; before the first, that of the first, which is known to be a guess."""
    v = np.array([0.1, -2.0, 0.1, 0.3, 2.0, -0.1])[:, None]
    sign, known = find_directions(v, np.array([1.0]))
    assert_array_equal(sign[:, 0], [-1, -1, -1, -1, 1, 1])
    assert_array_equal(known[:, 0], [False, True, True, True, True, True])


def test_a_joint_that_never_surely_moves_has_no_direction():
    """Beside one that moves."""
    v = np.array([[0.1, 3.0], [-0.2, -3.0]])
    sign, known = find_directions(v, np.array([1.0, 1.0]))
    assert_array_equal(sign, [[0, 1], [0, -1]])
    assert_array_equal(known, [[False, True], [False, True]])


def test_samples_that_count_do_not_feel_how_a_filter_starts():
    """Of a knock at a log's first and last sample less than 1 % of its peak is felt where samples count, which is nearly all."""
    rate, cutoff, factor, n = 500.0, 20.0, 3, 900
    knock = np.zeros(n)
    knock[0] = knock[-1] = 1.0
    felt = np.abs(lowpass(np.pad(knock, n), cutoff, rate)[n : 2 * n])[::factor]
    counts = mask_filter_edges(np.ones((n, 2), bool), cutoff, rate, factor)
    assert counts.shape == (len(felt), 2)
    assert felt[counts[:, 0]].max() < 0.01 * felt.max()
    assert (~counts[:, 1]).sum() <= 2 * (compute_edge_samples(cutoff, rate) / factor + 1)
