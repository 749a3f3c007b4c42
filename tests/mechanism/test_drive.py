"""Position-controlled drives: what is no drive, and what is one without a word about its delay."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.mechanism import PositionDrives


def test_a_drive_is_on_time_where_nobody_says_otherwise() -> None:
    """One sample of `q^-1` is the hold's; five of them at 4 ms leave 16 ms of delay; a pole at 1/e lags by one step."""
    assert PositionDrives((0.1,)).delay == 0.0
    assert PositionDrives.from_sampled([np.exp(-1.0)], 0.004, 1) == PositionDrives((0.004,), 0.0)
    assert PositionDrives.from_sampled([0.5], 0.004, 5).delay == pytest.approx(0.016)


@pytest.mark.parametrize("lag", [0.0, -0.1, np.inf, np.nan])
def test_lags_that_no_drive_has_are_refused(lag: float) -> None:
    """Among good ones too."""
    with raises_code("invalid_value"):
        PositionDrives((0.1, lag))


@pytest.mark.parametrize(("pole", "samples"), [(0.0, 1), (1.0, 1), (1.2, 1), (-0.1, 1), (0.5, 0)])
def test_sampled_lags_need_a_stable_pole_and_a_sample(pole: float, samples: int) -> None:
    """A pole at one never arrives, one below zero swings, and no input acts in its own sample."""
    with raises_code("invalid_value", "0", "1"):
        PositionDrives.from_sampled((0.9, pole), 0.004, samples)


@pytest.mark.parametrize("delay", [-1e-3, np.inf])
def test_delays_are_not_negative(delay: float) -> None:
    """Nobody answers before the question."""
    with raises_code("invalid_value"):
        PositionDrives((0.1,), delay)
