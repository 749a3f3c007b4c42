"""Rows that went to disk come back as they were, run by run, in order, as often as they are asked for."""

from __future__ import annotations

from numpy.testing import assert_array_equal

from tau_dyn.estimate import RegressionRows, StoredRows


def test_what_was_written_comes_back(rng) -> None:
    """Two runs of three and one pieces, a column of zeros and an output that nothing touches; read between writes, and twice."""
    stored, given = StoredRows(4), []
    for lengths in ((5, 1, 7), (3,)):
        stored.begin()
        given.append([])
        for n in lengths:
            W = rng.normal(size=(n, 2, 4)) * [[1, 0, 1, 1], [0, 0, 0, 0]]
            given[-1].append(RegressionRows(rng.random(n), W, rng.normal(size=(n, 2)), rng.random((n, 2)) > 0.5))
            stored.add(given[-1][-1])
            assert_array_equal(stored.runs[0][0].W, given[0][0].W)
    for _ in range(2):
        assert [len(run) for run in stored.runs] == [3, 1]
        for run, expected in zip(stored.runs, given, strict=True):
            for one, other in zip(run, expected, strict=True):
                for read, wrote in zip(one, other, strict=True):
                    assert_array_equal(read, wrote)
    assert_array_equal(stored.runs[0][-1].y, given[0][2].y)
