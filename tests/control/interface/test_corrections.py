"""What a learned correction adds to speeds, and how fast it may jump."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control.interface.correction import Correction, _require_small


def build_correction(dq: np.ndarray, dt: float = 0.004) -> Correction:
    return Correction(("turn",), dt, dq[:, None], "0" * 16)


def test_speeds_are_the_derivative_of_positions() -> None:
    """A tenth of a millimetre at 2 Hz, faded in and out: the added speed is its derivative."""
    t = np.arange(0, 2, 0.004)
    fade = np.sin(np.pi * t / 2) ** 2
    slope = 2 * np.pi * 2 * np.cos(4 * np.pi * t) * fade + np.sin(4 * np.pi * t) * 0.5 * np.pi * np.sin(np.pi * t)
    dv = build_correction(1e-4 * np.sin(4 * np.pi * t) * fade).dv[:, 0]
    assert_allclose(dv[1:-1], 1e-4 * slope[1:-1], atol=2e-6)


@pytest.mark.parametrize(("jump", "refused"), [(5e-4, True), (3e-4, False)])
def test_a_jump_is_held_against_the_drives_speed(jump, refused) -> None:
    """Half a millimetre from sample to sample of 4 ms is 0.125 m/s, which a drive of 0.1 m/s cannot do; 0.3 mm is 0.075."""
    limits = cast(Any, SimpleNamespace(correction=np.array([1e-3]), speed=np.array([0.1])))
    correction = build_correction(np.array([0.0, jump, jump, 0.0]))
    if refused:
        with raises_code("invalid_value", "turn", "0.125"):
            _require_small(correction, limits, ["m"])
    else:
        _require_small(correction, limits, ["m"])
