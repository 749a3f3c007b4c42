"""A recording splits where the robot rests."""

import numpy as np
import pytest

from tau_dyn.log import Log, split_by_motion

RATE = 500.0


def strokes(rng, pauses=(2.0, 0.1, 3.0)):
    """Return a log of smooth strokes of 2 s, each followed by a pause, with encoder noise."""
    pieces, end = [np.zeros(int(RATE))], 0.0
    for k, pause in enumerate(pauses):
        s = np.linspace(0, 1, int(2 * RATE))
        stroke = 0.2 * (-1) ** k * (10 * s**3 - 15 * s**4 + 6 * s**5)
        pieces += [end + stroke, np.full(int(pause * RATE), end + stroke[-1])]
        end += stroke[-1]
    q = np.concatenate(pieces)
    return Log(np.arange(len(q)) / RATE, {"q_axis": q + rng.normal(0, 2e-6, len(q))})


def test_motions_are_the_stretches_between_rests(rng):
    """Three strokes with pauses of 2, 0.1 and 3 s are two motions: a tenth of a second is no rest."""
    log = strokes(rng)
    parts = split_by_motion(log)
    assert len(parts) == 2
    assert sum(p.n_samples for p in parts) == log.n_samples
    assert parts[0].t[-1] == pytest.approx(4.0, abs=0.1)


def test_a_log_that_never_moves_has_no_motion(rng):
    """Encoder noise alone is not motion."""
    assert split_by_motion(Log(np.arange(5000) / RATE, {"q_axis": rng.normal(0, 5e-6, 5000)})) == []


def test_a_log_that_never_rests_is_one_motion():
    """A steady sine, its reversals included, is one motion."""
    t = np.arange(10000) / RATE
    assert len(split_by_motion(Log(t, {"q_axis": 0.1 * np.sin(2 * np.pi * 0.5 * t)}))) == 1
