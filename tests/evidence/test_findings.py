"""What a finding says of its parameters is what the data tell, and no more."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import JointwiseEffect
from tau_dyn.evidence.findings import estimate_uncertainty, format_reduction
from tau_dyn.parameters import Parameters


class Motor(JointwiseEffect):
    """A further drive's inertia, which the baseline's mass takes, and its quadratic drag, which nothing takes."""

    name = "motor"
    equation = "tau += inertia a + drag v |v|"
    reveals = "any motion"
    quantities = (("inertia", "F"), ("drag", "F"))

    def per_joint(self, joint):
        """Return acceleration and the speed's square with its sign."""
        return [joint.a, joint.v * np.abs(joint.v)]


def test_what_the_baseline_absorbs_has_no_standard_error(make, rng):
    """The inertia is the mass's own column: no data tell it; the drag has the standard error of its own regression."""
    channel = make.bench(rng, lambda m: 40.0 * m.v * np.abs(m.v))
    null_model, effect = make.null_model(channel), Motor(("x",), ("N",))
    values = Parameters([p for p in effect.parameters])
    found = estimate_uncertainty(null_model, [effect], values, 1.0)
    inertia, drag = found
    assert inertia.stderr is None
    column = null_model.whiten_columns([c[:, :, 1:] for c in channel.columns(effect)])
    assert_allclose(drag.stderr, null_model.gram(column)[0, 0] ** -0.5, rtol=1e-6)


@pytest.mark.parametrize(("percent", "says"), [(12.4, "12 % smaller"), (0.34, "0.3 % smaller"), (-0.6, "not smaller")])
def test_a_weak_cause_is_not_said_to_predict_better_than_it_does(percent, says):
    """White rows may be sure of a cause that takes nothing off the raw error; the sentence says so."""
    assert format_reduction(percent) == says
