"""What stands in the end: causes that every part of the data bears out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.diagnose import within
from tau_dyn.diagnose.confirm import Confirmation
from tau_dyn.diagnose.encoders import NoiseOnly
from tau_dyn.diagnose.parts import GAIN
from tau_dyn.diagnose.search import search
from tau_dyn.diagnose.stages import confirmation, confirmed, supported
from tau_dyn.effects import QuadraticDrag


@pytest.mark.parametrize(("last", "within", "stands"), [(1.0, False, True), (-1.0, False, False), (-1.0, True, True)])
def test_the_last_part_has_a_veto(make, last: float, within: bool, stands: bool):
    """A drag that pushes where the gain is measured, and brakes everywhere else, is found and confirmed, and does not stand.

    Unless held-out logs were found unable to show it: then blocks of the training logs have confirmed it.
    """
    rng = np.random.default_rng(5)

    def hidden(motion):
        own = np.where(make.turns(len(motion.t)) == GAIN, last, 1.0)
        return 90 * own[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=8000, causes=(QuadraticDrag,))
    hunt = search(channel, rng, lambda step: None)
    tests = [replace(confirmation(channel, hunt, one), within=within) for one in hunt.found]
    kept = confirmed(channel, hunt, tests)
    assert [one.candidate.cause for one in kept] == ["quadratic_drag"]
    stood, bars = supported(channel, hunt, tests, kept, rng)
    assert stood == (kept if stands else [])
    assert len(bars.gains) == len(stood)


def test_without_held_out_logs_there_is_no_second_search(make, rng):
    """Blocks that take turns have heard all that the logs can say: what is silent there stays as it is, and nothing is made."""
    channel = make.bench(rng, causes=(QuadraticDrag,))
    hunt = search(channel, rng, lambda step: None)
    tests = within.Tests((Confirmation(0.1, 0.9, 0.4),), None)
    assert tests.causes[0].silent
    never = NoiseOnly(lambda: pytest.fail("noise was made for a search that cannot say anything"))
    assert within.heard(channel, hunt, tests, 0.1, rng, never) is tests


def test_noise_is_made_once_and_divided_as_a_second_search_is(make, rng):
    """The second search looks at the same noise-only logs, in its own blocks."""
    channel, made = make.bench(rng), []
    noise = NoiseOnly(lambda: made.append(1) or [channel])
    inner = noise.within((np.full(len(channel.runs[0].t), -1),))
    assert np.all(inner.channels[0].parts[0] == -1) and noise.channels == [channel]
    assert len(made) == 1 and np.any(channel.parts[0] != -1)
