"""A cause's own force is compared with what is measurable, and not the fall of an error that noise makes up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tau_dyn.evidence import claims
from tau_dyn.evidence.result import Gain


@pytest.mark.parametrize(("own", "rejected"), [(2e-4, False), (2e-6, True)])
def test_a_small_force_in_noise_is_a_force(own: float, rejected: bool) -> None:
    """Of 1 N measured with 0.01 N of noise 2e-4 N is measurable, although it lowers the rms by 2e-6 N; 2e-6 N is not."""
    effect = SimpleNamespace(joints=("x",), felt_by_all=False)
    one = SimpleNamespace(candidate=SimpleNamespace(effects=(effect,)))
    run = SimpleNamespace(y=np.ones((10, 1)))
    channel = SimpleNamespace(name="force", outputs=("x",), runs=(run,), scene=SimpleNamespace(joints=("x",)))
    found = claims.Claims(cast(Any, (one,)), ("",), cast(Any, (None,)))
    gain = Gain(float(np.hypot(0.01, own)), 0.01, 0.02, (0.01, 0.03))
    waterfall = claims.Waterfall([], [], [gain])
    judged = claims._reject_without_gain(cast(Any, channel), found, waterfall)
    assert bool(judged.why_not[0]) is rejected
