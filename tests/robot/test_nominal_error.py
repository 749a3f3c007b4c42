"""How well a robot file's values are known: what is stated, else one share of a mass."""

import pytest

from tau_dyn.parameters import Parameter
from tau_dyn.robot import NOMINAL_MASS_STDERR, compute_nominal_stderr


def test_a_stated_error_counts_before_the_default() -> None:
    """A weighed mass has its own error, another one a share of itself, and friction has no trusted nominal value."""
    assert compute_nominal_stderr(Parameter("arm_link.mass", 9.0, "kg", prior_stderr=0.05)) == 0.05
    assert compute_nominal_stderr(Parameter("arm_link.mass", -9.0, "kg")) == pytest.approx(9.0 * NOMINAL_MASS_STDERR)
    assert compute_nominal_stderr(Parameter("axis.coulomb_pos", 20.0, "N")) is None
