"""Accelerations of a tool that its actuators cannot have caused are refused with the line of the column map."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.control.observers import refuse_odd_accelerations

DT = 0.002


@pytest.fixture
def motion(rng) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 2) of a tool that goes there and back, and noisy accelerations of a tool that sways at 9 Hz."""
    t = np.arange(0, 8, DT)
    there, back = (np.clip((t - start) / 1.5, 0, 1) for start in (1.5, 5.0))
    way = np.outer(there**3 * (10 - 15 * there + 6 * there**2) - back**3 * (10 - 15 * back + 6 * back**2), [0.3, -0.1])
    sway = 2e-4 * np.sin(2 * np.pi * 9 * t) * ((t > 1.5) & (t < 7))
    return way, np.gradient(np.gradient(way + sway[:, None], DT, axis=0), DT, axis=0) + 0.05 * rng.normal(
        size=way.shape
    )


def refuse(motion, change) -> None:
    """Check accelerations after a change."""
    refuse_odd_accelerations(["ax", "ay"], change(motion[1]), ["kx", "ky"], motion[0], DT)


def test_accelerations_of_the_tool_pass(motion):
    """A sway of 0.6 m/s^2 and noise are no unit."""
    refuse(motion, lambda a: a)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: a / 9.80665, "ax_tool: {column: ax, scale: 9.80665}"),
        (lambda a: a * [1, -1], "ay_tool: {column: ay, scale: -1}"),
        (lambda a: 1e3 * a, "ax_tool: {column: ax, scale: 0.001}"),
    ],
)
def test_units_and_signs_are_named(motion, change, said):
    """The slow acceleration of a tool is that of its actuators."""
    with raises_code("wrong_unit", said):
        refuse(motion, change)


def test_gravity_is_named(motion):
    """From rest to rest the mean acceleration is zero, unless the sensor measures gravity."""
    with raises_code("invalid_value", "ay_tool: {column: ay, offset: -9.8"):
        refuse(motion, lambda a: a + [0, 9.81])
