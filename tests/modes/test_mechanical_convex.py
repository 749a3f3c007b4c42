"""The conic program: physical matrices where plain least squares gives others, and no cost where it would not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

sys.path.insert(0, str(Path(__file__).parent))
from structures import chain, relative_error

from tau_dyn.modes.mechanical import SecondOrder
from tau_dyn.modes.mechanical.estimation import _clipped, _program, _triangle, is_physical, solve_conic
from tau_dyn.modes.mechanical.structure import pack, unpack

RATE = 2 * np.pi * 10.0


@pytest.fixture(scope="module")
def scaled() -> SecondOrder:
    """A structure with M, D, K of order one."""
    truth = chain((7.4, 11.5, 14.0), 3)
    unit = np.trace(truth.K) / 3
    return SecondOrder(truth.M * RATE**2 / unit, truth.D * RATE / unit, truth.K / unit)


S = 2j * np.pi * np.geomspace(1, 40, 60) / RATE


def test_an_exact_response_gives_the_exact_structure(scaled: SecondOrder) -> None:
    """One force and all sensors are enough."""
    found = solve_conic(S, scaled.compliance(S)[:, :, :1], (0,))
    for name in "MDK":
        assert relative_error(getattr(found, name), getattr(scaled, name)) < 1e-5


def test_a_noisy_response_still_gives_a_physical_structure(scaled: SecondOrder) -> None:
    """Where plain least squares gives a damping matrix that feeds energy in, the program's does not."""
    rng, unphysical = np.random.default_rng(0), 0
    for _ in range(5):
        H = scaled.compliance(S)
        H = H * (1 + 0.3 * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)))
        R, target = _triangle(S, H, np.broadcast_to(np.eye(3), H.shape), (0, 1, 2))
        unphysical += not is_physical(unpack(np.linalg.solve(R, target), 3))
        found = solve_conic(S, H, (0, 1, 2))
        assert np.linalg.eigvalsh(found.M)[0] > 0 and np.linalg.eigvalsh(found.K)[0] > 0
        assert np.linalg.eigvalsh(found.D)[0] > -1e-6
    assert unphysical > 0


def test_the_program_finds_the_least_error_of_all_physical_structures() -> None:
    """No physical structure nearby has a smaller error (a one-mass problem whose plain solution has negative damping)."""
    R, target = np.eye(3), np.array([1.0, -0.5, 2.0])
    assert_allclose(pack(_program(R, target, 1)), [1.0, 0.0, 2.0], atol=1e-6)
    clipped = _clipped(R, target, 1)
    assert_allclose(pack(clipped), [1.0, 0.0, 2.0])
    R = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert_allclose(pack(_program(R, target, 1)), [1.0, 0.0, 2.0], atol=1e-6)
