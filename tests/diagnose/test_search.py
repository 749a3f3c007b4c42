"""Which of several laws that explain the same is named, and that a name is not lost to smooth functions that explain no more."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.diagnose.search import search
from tau_dyn.effects import QuadraticDrag, Stribeck


@pytest.mark.parametrize("seed", [1, 6])
def test_laws_that_explain_the_same_are_told_by_their_freedom(make, seed):
    """A drag that varies from block to block scatters more than a Stribeck peak that explains no more: it keeps its name."""
    rng = np.random.default_rng(seed)

    def hidden(motion):
        n = len(motion.t)
        size = np.repeat(1 + 0.6 * rng.standard_normal(n // 100 + 1), 100)[:n]
        return 60 * size[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=6000, causes=(Stribeck, QuadraticDrag))
    (found,) = search(channel, np.random.default_rng(1), lambda step: None).found
    assert found.candidate.cause == "quadratic_drag"
    assert found.rivals == ("stribeck",)
