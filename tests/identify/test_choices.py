"""What a user fixes, frees, bounds or knows beforehand, by name or pattern."""

from importlib import import_module

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.identify import Choices, build_model, identify


@pytest.fixture(scope="module")
def model(l1):
    return build_model(l1, "asymmetric")


def test_fixing_by_name_value_and_pattern(model):
    """A name alone keeps the nominal value, `=` sets one, `+-` makes it a measurement that is still estimated."""
    fix = ("cart1_link.mass", "plate_link.mass=9.5", "rod?_link.mass=1.25+-0.05", "cart2_link.mass=13±0.1")
    p = Choices(fix=fix).apply(model).parameters
    assert (p["cart1_link.mass"].free, p["cart1_link.mass"].value) == (False, 13.58)
    assert (p["plate_link.mass"].free, p["plate_link.mass"].value, p["plate_link.mass"].origin) == (False, 9.5, "given")
    for name in ("rod1_link.mass", "rod2_link.mass", "rod3_link.mass"):
        assert (p[name].free, p[name].value, p[name].prior_stderr) == (True, 1.25, 0.05)
    assert p["cart2_link.mass"].prior_stderr == 0.1
    assert p["cart3_link.mass"] == model.parameters["cart3_link.mass"]


def test_freeing_and_bounding(model):
    """Drive inertia is fixed until it is freed; a bound takes a nominal value along, and either side may be open."""
    assert not model.parameters["cart1.armature"].free
    p = (
        Choices(free=("*.armature",), bound=("cart*.viscous_pos=50:400", "plate_link.mass=:8", "rod1_link.mass=0.5:"))
        .apply(model)
        .parameters
    )
    assert all(p[f"cart{k}.armature"].free for k in (1, 2, 3))
    assert (p["cart2.viscous_pos"].lower, p["cart2.viscous_pos"].upper, p["cart2.viscous_pos"].value) == (50, 400, 50)
    assert (p["plate_link.mass"].upper, p["plate_link.mass"].value) == (8, 8)
    assert (p["rod1_link.mass"].lower, p["rod1_link.mass"].upper) == (0.5, np.inf)


def test_a_named_inertial_number_comes_loose_from_its_mass(model):
    """`--free plate_link.mx` makes a parameter of what follows the mass by default; a pattern only matches what is there."""
    p = Choices(free=("cart1_link.izz",)).apply(model).parameters
    assert "cart1_link.izz" in p
    with raises_code("unknown_name"):
        Choices(free=("*.izz",)).apply(model)


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({"fix": ("plate.mass=9",)}, "no parameter named 'plate.mass'"),
        ({"fix": ("*.weight",)}, "no parameter named"),
        ({"free": ("plate_link.volume",)}, "no parameter named 'plate_link.volume'"),
        ({"fix": ("plate_link.mass=heavy",)}, "'heavy' is not a finite number"),
        ({"fix": ("plate_link.mass=nan",)}, "not a finite number"),
        ({"fix": ("plate_link.mass=",)}, "not a finite number"),
        ({"fix": ("plate_link.mass=9+-",)}, "not a finite number"),
        ({"fix": ("plate_link.mass=9+-0",)}, "must be positive"),
        ({"fix": ("plate_link.mass=9+--1",)}, "must be positive"),
        ({"fix": ("plate_link.mass=-9",)}, "is outside its bounds, 0 to inf"),
        ({"fix": ("plate_link.mass=9",), "bound": ("plate_link.mass=0:8",)}, "is outside its bounds, 0 to 8"),
        ({"bound": ("plate_link.mass=9",)}, "write NAME=LO:HI"),
        ({"bound": ("plate_link.mass",)}, "write NAME=LO:HI"),
        ({"bound": ("plate_link.mass=3:2",)}, "lower bound is above"),
        ({"bound": ("plate_link.mass=a:2",)}, "'a' is not a finite number"),
    ],
)
def test_a_faulty_choice_is_an_input_error_that_quotes_it(model, choices, sentence):
    """Nothing is guessed from a misspelt name or a number that is none."""
    with pytest.raises(InputError, match="parameter|plate") as fault:
        Choices(**choices).apply(model)
    assert sentence in str(fault.value)
    assert fault.value.exit_status == 2


def test_drive_gains_are_read_by_joint_and_pattern(l1):
    """`NAME.drive_gain=F+-S` gives the factor and its relative error; they are no parameters of the model."""
    gains = Choices(fix=("*.drive_gain=0.98+-0.049", "cart2.drive_gain=1.1", "plate_link.mass")).gains(l1.actuated)
    assert gains["cart1"] == pytest.approx((0.98, 0.05))
    assert gains["cart2"] == (1.1, 0.0)
    assert set(gains) == set(l1.actuated)
    for text in ("cart9.drive_gain=1", "cart1.drive_gain", "cart1.drive_gain=-1", "cart1.drive_gain=0"):
        with pytest.raises(InputError):
            Choices(fix=(text,)).gains(l1.actuated)


def test_a_weighed_payload_sharpens_the_plate_and_what_leans_on_it(l1, monday, found, truth):
    """A plate weighed to 5 g: its error becomes at most 5 g, the rods' shrink, nobody's grows; the truth stays within reach."""
    true = truth.parameters["plate_link.mass"].value
    known = identify(l1, monday, choices=Choices(fix=(f"plate_link.mass={true}+-0.005",)))
    before, after = found.parameters, known.parameters
    assert after["plate_link.mass"].stderr < 0.0052
    assert before["plate_link.mass"].stderr > 0.02
    assert after["rod3_link.mass"].stderr < 0.95 * before["rod3_link.mass"].stderr
    assert all(after[p.name].stderr < 1.1 * p.stderr for p in before if p.stderr is not None)
    assert abs(after["plate_link.mass"].value - true) < 4.5 * after["plate_link.mass"].stderr
    row = {r["name"]: r for r in known.rows()}["plate_link.mass"]
    assert row["nominal_stderr"] == 0.005


def test_fixed_as_exact_it_is_no_longer_estimated(l1, monday):
    """A payload given without an error keeps its value, and stands among the fixed parameters."""
    known = identify(l1, monday, choices=Choices(fix=("plate_link.mass=9.13",)))
    assert known.model.parameters["plate_link.mass"].value == 9.13
    assert "plate_link.mass" not in [r["name"] for r in known.rows()]
    fixed = {r["name"]: r for r in known.to_dict()["fixed_parameters"]}
    assert fixed["plate_link.mass"] == {"name": "plate_link.mass", "value": 9.13, "unit": "kg", "origin": "given"}


def test_a_motor_constant_scales_the_answer_and_carries_its_error(l1, monday, found):
    """All forces times 0.98 is all parameters times 0.98; 2 % of doubt about each joint ends up in its friction."""
    known = identify(l1, monday, choices=Choices(fix=("*.drive_gain=0.98+-0.0196",)))
    for p in found.parameters:
        if p.free:
            assert_allclose(known.parameters[p.name].value, 0.98 * p.value, rtol=1e-6)
    for joint in l1.actuated:
        p = known.parameters[f"{joint}.coulomb_pos"]
        assert 0.012 * p.value < p.stderr < 0.035 * p.value  # that of one joint, shared by the others through the rods
    exact = identify(l1, monday, choices=Choices(fix=("*.drive_gain=0.98",)))
    assert_allclose(
        exact.parameters["cart1.coulomb_pos"].stderr, 0.98 * found.parameters["cart1.coulomb_pos"].stderr, rtol=1e-6
    )
    assert_allclose(known.train.rms, 0.98 * found.train.rms, rtol=1e-6)


def test_with_everything_fixed_the_sentence_says_how_a_model_is_judged(axis, axis_log):
    """Nothing is left to estimate; held-out logs are the way to judge a model on new data."""
    with raises_code("bad_option", "every parameter is fixed", "--holdout"):
        identify(axis, axis_log, choices=Choices(fix=("*",)))


def test_a_bound_holds_and_is_said(axis, axis_log, monkeypatch):
    """A viscous coefficient bounded below what the log says sits on its bound, and a warning names it with the plain value."""
    monkeypatch.setattr(
        import_module("tau_dyn.identify.identification"), "build_offset_columns", lambda *_: None
    )  # the times as logged
    known = identify(axis, axis_log, choices=Choices(bound=("axis.viscous_neg=0:200",)), estimator="wls")
    assert known.parameters["axis.viscous_neg"].value == 200
    row = {r["name"]: r for r in known.rows()}["axis.viscous_neg"]
    assert row["at_bound"]
    assert any(text.startswith("axis.viscous_neg: the unconstrained estimate 2") for text in known.warnings)
    assert known.parameters["carriage_link.mass"].value != pytest.approx(93.0, abs=0.01)
    fixed = identify(axis, axis_log, choices=Choices(fix=("axis.viscous_neg=200",)), estimator="wls")
    assert_allclose(
        known.parameters.values, fixed.parameters.values, rtol=1e-4
    )  # constrained least squares, not a projection


def test_gains_count_wherever_they_stand_among_what_is_fixed():
    """Before, after and between other requests, by pattern, the last word on a joint; its doubt relative to its factor."""
    fix = (
        "a_link.mass=3",
        "x.drive_gain=0.5+-0.01",
        "*.armature",
        "[yz].drive_gain=2",
        "b_link.mass",
        "z.drive_gain=4+-1",
    )
    expected = {"x": (0.5, 0.02), "y": (2.0, 0.0), "z": (4.0, 0.25)}
    assert Choices(fix=fix).gains("xyz") == expected
    assert Choices(fix=fix[:3]).gains("xyz") == {"x": (0.5, 0.02)} and Choices(fix=fix[:1]).gains("xyz") == {}
