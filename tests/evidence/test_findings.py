"""What a finding says of its parameters is what the data tell, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import JointwiseEffect
from tau_dyn.evidence import Finding, Gain, explain_gain, find_out_of_range
from tau_dyn.evidence.findings import estimate_uncertainty, format_reduction
from tau_dyn.parameters import Parameter, Parameters


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


def build_gain(p_value: float | None, low: float) -> Gain:
    """Return a gain of 20 % with an interval from `low`."""
    return Gain(1e-3, 0.8e-3, 20.0, (low, 30.0), p_value)


@pytest.mark.parametrize(
    ("gain", "why"),
    [
        (build_gain(1e-3, 5.0), ""),
        (build_gain(0.03, 5.0), "held-out data do not show it"),
        (build_gain(1e-3, -2.0), "its gain is not above zero (95 % interval -2 to 30 %)"),
        (build_gain(None, 5.0), ""),
        (build_gain(None, 0.0), "its gain is not above zero (95 % interval 0 to 30 %)"),
    ],
)
def test_a_gain_confirms_by_its_p_value_and_its_interval(gain: Gain, why: str) -> None:
    """Of poses 2 % are the level of the paired test; time series have the interval alone."""
    assert explain_gain(gain) == why


def test_a_number_beyond_its_range_counts_from_two_standard_errors() -> None:
    """A joint that rises by 1e-5 rad/(N m) is one that does not yield, if the standard error is 6e-6, and implausible if 4e-6."""
    rising = Parameter("j2.gravity_compliance", -1e-5, "rad/(N m)", lower=0.0)
    assert find_out_of_range([replace(rising, stderr=6e-6)]) == ""
    assert "j2.gravity_compliance = -10 µrad/(N m)" in find_out_of_range([replace(rising, stderr=4e-6)])
    assert "at most" in find_out_of_range([Parameter("j1.eccentricity_sin", 6e-3, "rad", upper=5e-3, stderr=1e-4)])


def test_a_finding_of_poses_has_the_interval_of_its_degrees_of_freedom() -> None:
    """With 10 degrees of freedom a 95 % interval is 2.23 standard errors to either side; rejected, its first reason stays."""
    number = Parameter("arm1.length", 2.0, "m", stderr=0.1)
    found = Finding("rod_length", (), "confirmed", 1.0, 1e-3, (number,), build_gain(1e-3, 5.0), (), "", "", dof=10)
    told = found.reject("first").reject("second").to_dict()
    assert told["parameters"][0]["ci95"] == pytest.approx([2 - 0.2228, 2 + 0.2228], abs=1e-4)
    assert (told["status"], told["why_not_confirmed"], told["detection_limit"]) == ("suspected", "first", None)
    assert (
        told["gain"]["p_value"] == 1e-3
        and "p_value" not in replace(found, gain=build_gain(None, 5.0)).to_dict()["gain"]
    )


def test_the_score_of_a_gain_is_twice_the_log_likelihood_ratio() -> None:
    """`2 n log(rms_before / rms_after)` of Gaussian numbers whose variance is free."""
    assert build_gain(None, 5.0).compute_score(100) == pytest.approx(200 * np.log(1 / 0.8))
