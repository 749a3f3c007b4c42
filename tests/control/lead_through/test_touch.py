"""A contact's stiffness from a log of one touch: offsets of the sensor and free travel do not change it."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.control.lead_through import fit_contact_stiffness

STIFFNESS = 25e3


def press(rng, *, free: bool, offset: float = 0.0, side: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return position [m] and force [N] of a slow touch of 3 mm, or of motion within the contact."""
    depth = (2e-3 if free else 8e-4) * np.sin(2 * np.pi * 0.15 * np.arange(0, 12, 0.004) - np.pi / 2) + 1e-3
    force = STIFFNESS * np.maximum(depth, 0) + offset
    return side * depth + 1e-5 * rng.normal(size=len(depth)), force + rng.normal(size=len(depth))


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("free", "offset"), [(False, 0.0), (True, 0.0), (True, 12.0), (True, -30.0)])
def test_free_travel_and_an_offset_do_not_soften_a_contact(rng, free, offset, side):
    """`F = F0 + k max(0, x - x0)`: samples of the free travel would lower the slope, and with it the safety of the gain."""
    stiffness, stderr = fit_contact_stiffness(*press(rng, free=free, offset=offset, side=side))
    assert stiffness == pytest.approx(STIFFNESS, rel=0.02) and stderr < 0.01 * STIFFNESS


def test_a_position_in_mm_is_refused(rng):
    """Nothing is pressed in by a metre; the gain would be a thousand times too large."""
    position, force = press(rng, free=False)
    with raises_code("wrong_unit", "in mm", "scale: 0.001"):
        fit_contact_stiffness(1e3 * position, force)
