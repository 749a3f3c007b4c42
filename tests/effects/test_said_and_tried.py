"""What effects say of themselves, and which settings they have tried: units, places, lags, distances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS, Scene, describe_missing_state, format_quantity
from tau_dyn.parameters import Parameter, Parameters


def scene(duration: float, way: float = 1.0) -> Scene:
    one = np.ones(1)
    return Scene(("x",), ("N",), 0 * one, way * one, 0.01 * one, one, 60.0, duration)


@pytest.mark.parametrize(
    ("value", "unit", "stderr", "said"),
    [
        (0.0782, "m/s", None, "78.2 mm/s"),
        (2.5e-5, "m/s", None, "25 µm/s"),
        (1.8e-3, "rad/s", None, "1.8 mrad/s"),
        (0.0, "m", None, "0 m"),
        (0.0, "m", 2e-3, "0.0 ± 2.0 mm"),
        (0.3, "m", None, "300 mm"),
        (1.0, "m", None, "1 m"),
        (1.8, "N", 0.2, "1.80 ± 0.20 N"),
    ],
)
def test_amounts_take_the_prefix_that_leaves_a_handy_number(value, unit, stderr, said):
    """A value of nothing takes the prefix of its error, and none where it has none."""
    assert format_quantity(value, unit, stderr) == said


def test_lags_are_tried_up_to_a_third_of_the_recording():
    """No lag first, then 3 s and at most doublings up to 40 s of a recording of 120 s; of 6 s only no lag."""
    lags = [g["lag"] for g in EFFECTS["thermal_drift"].grid(scene(120.0), ("x",))]
    assert lags[:2] == [0.0, 3.0] and lags[-1] == pytest.approx(40.0)
    assert max(b / a for a, b in zip(lags[1:], lags[2:], strict=False)) <= 2.0
    assert EFFECTS["thermal_drift"].grid(scene(6.0), ("x",)) == [{"lag": 0.0}]


def test_hysteresis_is_tried_over_shares_of_the_way():
    """Twice the way, twice the distances, from a ten-thousandth to a tenth of it."""
    one, two = ([g["distance"] for g in EFFECTS["hysteresis"].grid(scene(60.0, way), ("x",))] for way in (0.5, 1.0))
    assert_allclose(two, 2 * np.array(one))
    assert_allclose([one[0], one[-1]], [0.5e-4, 0.05])


def test_position_friction_says_where_it_is_high_and_low():
    """Friction of 3 q over the middle half metre either side of 0.2 m: high at the far end, low at the near one."""
    effect = EFFECTS["position_friction"](["x"], ["N"], middle=0.2, half=0.5, degree=1)
    named = Parameters([Parameter(p.name, 3.0, p.unit) for p in effect.parameters][:1])
    said = effect.words("x", {"linear": named[named.names[0]]})
    assert said.endswith("higher at 700 mm than at -300 mm")


def test_what_a_state_cannot_give_is_named():
    """A history is missing from a state; a law of the speed misses nothing; a delay is the recording's."""
    assert "temperature" in describe_missing_state(EFFECTS["thermal_drift"](["x"], ["N"]), ())
    assert describe_missing_state(EFFECTS["quadratic_drag"](["x"], ["N"]), ()) == ""
    assert "recorded" in describe_missing_state(EFFECTS["delay"](["x"], ["N"]), ())


def test_a_resonances_damping_is_said_in_per_cent():
    """1 % of critical is 1 %."""
    effect = EFFECTS["structural_compliance"](["x"], ["N"], frequency=12.5, damping=0.01)
    assert "damping 1 %" in effect.describe(Parameters([Parameter(p.name, 1e-7, p.unit) for p in effect.parameters]))
