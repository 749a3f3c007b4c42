"""Gaps that the samples around tell are filled; longer ones, and those of a motion that is too fast, stay."""

import numpy as np
import pytest
from numpy.random import default_rng

from tau_dyn.log import Log, split_at_gaps
from tau_dyn.log.data_integrity import repair_log
from tau_dyn.log.resample import fill_short_gaps


def build_log(lost: int, hertz: float = 0.5, noise: float = 1e-5) -> tuple[Log, np.ndarray]:
    """Return a log at 1 kHz that lacks rows in five places, and the positions at all times."""
    t = 1e-3 * np.arange(10000)
    true = np.sin(2 * np.pi * hertz * t)
    q = true + noise * default_rng(1).normal(size=len(t))
    keep = np.ones(len(t), bool)
    for start in (1500, 3100, 5000, 6900, 8300):
        keep[start : start + lost] = False
    tau = 5 * true + 0.01 * default_rng(2).normal(size=len(t))
    return Log(t[keep], {"q_axis": q[keep], "tau_axis": tau[keep]}, "gaps.csv"), true


def test_short_gaps_are_filled_within_the_noise() -> None:
    log, true = build_log(6)
    filled, n, longest = fill_short_gaps(log, ["axis"])
    assert (n, filled.n_samples) == (5, 10000)
    assert longest == pytest.approx(7e-3)
    assert np.max(np.abs(filled.channels["q_axis"] - true)) < 6e-5
    assert np.array_equal(
        np.intersect1d(filled.channels["q_axis"], log.channels["q_axis"]), np.unique(log.channels["q_axis"])
    )


@pytest.mark.parametrize("kind", [{"lost": 6, "hertz": 25.0}, {"lost": 6, "noise": 0.0}, {"lost": 150}])
def test_unknown_motion_is_not_invented(kind: dict) -> None:
    log, _ = build_log(**kind)
    assert fill_short_gaps(log, ["axis"])[0] is log
    assert len(split_at_gaps(repair_log(log, ["axis"]).log)) == 6


def test_repair_says_what_was_filled() -> None:
    log, _ = build_log(6)
    repair = repair_log(log, ["axis"])
    assert [w.code for w in repair.warnings] == ["lost_samples"]
    assert "5 gaps of up to 0.007 s are interpolated" in repair.warnings[0]
    assert len(split_at_gaps(repair.log)) == 1
