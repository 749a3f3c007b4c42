"""Learning on the nonlinear plant: carts with their cascade, sharp friction, encoder noise; the model knows a lag and a delay."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments"))

from ilc_parts.carts import NOISE  # noqa: E402
from ilc_parts.rates import measure_rates  # noqa: E402

from tau_dyn.simulate import compiled_plant  # noqa: E402


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """Let the trials, a hundred of one robot, pay the compiled plant that is equal to rounding (`test_compiled_plant.py`)."""
    monkeypatch.setattr(compiled_plant, "MIN_SAMPLES", 0)
    monkeypatch.setattr(compiled_plant, "MIN_SAMPLES_PER_DRIVE", 0)


@pytest.mark.parametrize(("friction", "left"), [(False, 0.05), (True, 0.3)])
@pytest.mark.parametrize("seed", range(5))
def test_errors_fall_as_fast_as_predicted(friction, left, seed) -> None:
    """(7.28) promises a rate a trial: it is measured without friction; friction, which no linear model has, slows it down."""
    found = measure_rates(friction, seed)
    errors = found.history.rms("motor_errors")
    assert found.history.convergence.monotone
    assert np.all(np.diff(errors, axis=0) < 2 * NOISE)
    assert np.all(errors[-1] < left * errors[0] + 2 * NOISE)
    if friction:
        assert np.all(found.measured[1:] > found.predicted[1:]) and np.all(found.measured < 1)
    else:
        np.testing.assert_allclose(found.measured[0], found.predicted[0], rtol=0.1)
        assert found.whole < found.singular
