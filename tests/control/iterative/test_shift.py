"""A shift forwards in time: what it does to a sine is what its response says."""

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.control.iterative.filters import TimeShift


def test_a_shift_forwards_leads_the_phase() -> None:
    """Five samples earlier a wave leads by `2 pi f 5 dt`: applied, and by its matrix, it is the response."""
    shift, t = TimeShift(0.7, 5, 0.004), 0.004 * np.arange(200)
    for f in (1.0, 7.0, 30.0):
        wave = np.exp(2j * np.pi * f * t)
        expected = shift.response(np.array([f]))[0] * wave
        assert_allclose(shift.apply(wave)[:-5], expected[:-5], rtol=1e-9)
        assert_allclose((shift.matrix(200) @ wave)[:-5], expected[:-5], rtol=1e-9)
