"""A mass-damper-spring structure in continuous time and under held inputs."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from structures import DT, chain

from tau_dyn.modes.mechanical import SecondOrder
from tau_dyn.modes.mechanical.structure import pack, unpack

HZ = (7.4, 11.5, 14.0)


def steps(structure: SecondOrder, output: str, force: np.ndarray, n: int) -> np.ndarray:
    """Return the response (n, 3) to a force (3,) that stays on."""
    model = structure.sampled(DT, range(3), range(3), output)
    x, out = np.zeros(6), []
    for _ in range(n):
        out.append(model.C @ x + model.D @ force)
        x = model.A @ x + model.B @ force
    return np.array(out)


def test_a_lasting_force_ends_at_the_static_deflection() -> None:
    """K times the rest position is the force."""
    structure, force = chain(HZ), np.array([1.0, -2.0, 0.5])
    assert_allclose(structure.K @ steps(structure, "displacement", force, 6000)[-1], force, rtol=1e-9)


def test_a_mass_alone_accelerates_first() -> None:
    """At the moment a force comes on, nothing has moved and M times the acceleration is the force."""
    structure, force = chain(HZ), np.array([1.0, -2.0, 0.5])
    assert_allclose(structure.M @ steps(structure, "acceleration", force, 1)[0], force, rtol=1e-9)


@pytest.mark.parametrize("output, later", [("displacement", "velocity"), ("velocity", "acceleration")])
def test_sensors_are_each_others_derivatives(output: str, later: str) -> None:
    """Displacement gains in a step what velocity amounts to (Simpson's rule on a step too short to matter)."""
    structure, force = chain(HZ), np.array([1.0, -2.0, 0.5])
    low, high = steps(structure, output, force, 201), steps(structure, later, force, 201)
    gained = DT / 3 * (high[:-2:2] + 4 * high[1:-1:2] + high[2::2])
    assert_allclose(np.diff(low[::2], axis=0), gained, atol=3e-4 * np.abs(np.diff(low[::2], axis=0)).max())


def test_compliance_inverts_the_equation_of_motion() -> None:
    """(M s^2 + D s + K) times the compliance is one: (6.14), the right way up."""
    structure = chain(HZ)
    s = np.array([2j * np.pi * 9.0, 3.0 + 40j])
    impedance = structure.M * s[:, None, None] ** 2 + structure.D * s[:, None, None] + structure.K
    assert_allclose(impedance @ structure.compliance(s), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)


def test_poles_have_the_asked_frequencies() -> None:
    """Weak damping shifts |s| only in second order."""
    assert_allclose(np.abs(chain(HZ).poles())[::2] / (2 * np.pi), HZ, rtol=1e-3)


def test_upper_triangles_hold_everything() -> None:
    """Packing and unpacking returns the same matrices."""
    structure = chain(HZ)
    again = unpack(pack(structure), 3)
    for name in "MDK":
        assert_allclose(getattr(again, name), getattr(structure, name), rtol=1e-12)


def test_an_unknown_output_is_named() -> None:
    """A sensor of jerk is refused with the list of those that exist."""
    with raises_code("invalid_value"):
        chain(HZ).sampled(DT, [0], [0], "jerk")
