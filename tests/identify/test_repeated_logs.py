"""Logs as users hand them over: the same samples count once, and what is left out is said in the order of the logs."""

from __future__ import annotations

import numpy as np

from tau_dyn.identify import drop_repeated_logs
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code


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
    assert {get_code(w) for w in warnings} == {"copied_data"}
    assert "counts once" in warnings[0] and "held-out errors" in warnings[1] and "counts once" in warnings[2]
    assert drop_repeated_logs([one], [other]) == ([one], [other], [])


def test_a_copy_under_another_name_is_left_out_with_its_original() -> None:
    """A file with one more newline has another hash and the same samples."""
    random, t = np.random.default_rng(0), np.arange(500) / 100
    channels = {"q_axis": np.sin(t), "tau_axis": np.cos(t) + 0.1 * random.standard_normal(500)}
    one, copy = (Log(t, channels, name, sha256=name) for name in ("monday.csv", "copy.csv"))
    train, held, warnings = drop_repeated_logs([one], [copy])
    assert (train, held) == ([one], [])
    assert "copy.csv is both trained on and held out: it holds samples of monday.csv" in warnings[0]
