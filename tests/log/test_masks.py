"""Stretches of a mask: every true sample is in exactly one, and no false one in any."""

import numpy as np
import pytest

from tau_dyn.log import find_true_runs


@pytest.mark.parametrize(
    ("mask", "found"),
    [
        ("", []),
        ("....", []),
        ("xxxx", [(0, 4)]),
        ("x..xx.x", [(0, 1), (3, 5), (6, 7)]),
        (".xx.", [(1, 3)]),
    ],
)
def test_stretches_end_where_the_mask_does(mask, found):
    """At the first and the last sample as well as inside."""
    stretches = find_true_runs(np.array([c == "x" for c in mask], bool))
    assert [(s.start, s.stop) for s in stretches] == found
