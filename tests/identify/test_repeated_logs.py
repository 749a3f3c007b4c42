"""Logs as users hand them over: the same samples count once, and what is left out is said in the order of the logs."""

from __future__ import annotations

import numpy as np

from tau_dyn.identify import drop_repeated_logs
from tau_dyn.log import Log


def made(name: str, start: float = 0.0) -> Log:
    """Return a log of a file of this name, whose hash is its name."""
    t = start + np.arange(20) / 100
    return Log(t, {"q_axis": np.sin(t)}, name, sha256=name)


def test_each_log_counts_once_and_on_one_side() -> None:
    """Twice trained on, trained on and held out, held out twice; another stretch of one file is other data."""
    one, later, other = made("a.csv"), made("a.csv", 5.0), made("b.csv")
    train, held, warnings = drop_repeated_logs([one, one, later], [one, other, other])
    assert train == [one, later] and held == [other]
    assert [w.split(" is ")[0] for w in warnings] == ["a.csv", "a.csv", "b.csv"]
    assert "counts once" in warnings[0] and "held-out errors" in warnings[1] and "counts once" in warnings[2]
    assert drop_repeated_logs([one], [other]) == ([one], [other], [])
