"""What stands in the end: causes that every part of the data bears out."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.diagnose.parts import GAIN
from tau_dyn.diagnose.search import search
from tau_dyn.diagnose.stages import confirmation, confirmed, supported
from tau_dyn.effects import QuadraticDrag


@pytest.mark.parametrize(("last", "stands"), [(1.0, True), (-1.0, False)])
def test_the_last_part_has_a_veto(make, last: float, stands: bool):
    """A drag that pushes where the gain is measured, and brakes everywhere else, is found and confirmed, and does not stand."""
    rng = np.random.default_rng(5)

    def hidden(motion):
        own = np.where(make.turns(len(motion.t)) == GAIN, last, 1.0)
        return 90 * own[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=8000, causes=(QuadraticDrag,))
    hunt = search(channel, rng, lambda step: None)
    kept = confirmed(channel, hunt, [confirmation(channel, hunt, one) for one in hunt.found])
    assert [one.candidate.cause for one in kept] == ["quadratic_drag"]
    stood, bars = supported(channel, kept, rng)
    assert stood == (kept if stands else [])
    assert len(bars.gains) == len(stood)
