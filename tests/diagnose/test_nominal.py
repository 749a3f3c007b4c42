"""Refitted masses against trusted nominal ones: a payload, a wrong link mass, a wrong motor constant, or nothing."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tau_dyn.diagnose.nominal import find_parameter_changes
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot, load_robot_from_urdf


@pytest.fixture(scope="module")
def l1() -> Model:
    return Model.of(load_robot("gantry_tau", prototype="l1"))


@pytest.fixture
def one(write) -> Model:
    """Return a block, whose single mass hides a gain."""
    return Model.of(load_robot_from_urdf(write.block(), "block"))


def judged(model, factor, stderr=0.005, only=()):
    """Return findings of a fit in which masses are `factor` (by name, or all) times nominal, each with a relative error."""
    masses = [p for p in model.parameters if p.name.endswith(".mass") and (not only or p.name in only)]
    rows = []
    for p in masses:
        k = factor.get(p.name, 1.0) if isinstance(factor, dict) else factor
        rows.append(Parameter(p.name, k * p.value, "kg", 0.0, stderr=stderr * p.value))
    return find_parameter_changes(model, model.parameters, Parameters(rows))


def test_masses_within_two_per_cent_are_as_the_file_says(l1, one):
    """Nominal masses are trusted to 2 %: up to two sigma off, nothing is said, of one mass or of all."""
    rng = np.random.default_rng(0)
    names = [p.name for p in l1.parameters]
    assert judged(l1, {n: 1 + 0.02 * rng.uniform(-1, 1) for n in names}) == []
    assert judged(l1, 1.0) == []
    assert judged(one, 1.03) == []


def test_one_heavier_plate_is_a_payload(l1):
    """2 kg more at the plate, all else as the file says: a payload, which a link mass cannot be told from."""
    plate = f"{l1.robot.plate}.mass"
    heavier = 1 + 2.0 / l1.parameters[plate].value
    (found,) = judged(l1, {plate: heavier})
    assert found.cause == "payload" and found.status == "parameter" and found.joints == (l1.robot.plate,)
    assert found.indistinguishable_from == ("link_mass",)
    assert found.gain is None and found.effects == ()
    assert found.p_value < 1e-6 and found.score > 30
    assert found.experiment and "kg instead of" in found.sentence


def test_a_lighter_plate_or_another_link_is_a_link_mass(l1):
    """A payload cannot be negative, and carts carry none: both are link masses, and nothing else comes into question."""
    plate, cart = f"{l1.robot.plate}.mass", "cart1_link.mass"
    (lighter,) = judged(l1, {plate: 0.7})
    assert lighter.cause == "link_mass" and lighter.indistinguishable_from == ()
    (other,) = judged(l1, {cart: 1.4})
    assert other.cause == "link_mass" and other.joints == ("cart1_link",) and other.indistinguishable_from == ()


def test_all_masses_off_by_one_factor_are_a_drive_gain(l1):
    """8 % on every mass is what a wrong motor constant does: one finding with its factor, not ten wrong masses."""
    (found,) = judged(l1, 1.08)
    assert found.cause == "drive_gain" and "link_mass" in found.indistinguishable_from
    (factor,) = found.parameters
    n = sum(p.name.endswith(".mass") and p.value > 0 for p in l1.parameters)
    assert_allclose(factor.value, 1.08, rtol=1e-9)
    assert_allclose(factor.stderr, np.hypot(0.02, 0.005) / np.sqrt(n), rtol=1e-6)
    assert found.p_value <= 1.0


@pytest.mark.parametrize(("factor", "status"), [(1.003, "suspected"), (1.01, "parameter")])
def test_a_gain_nearer_to_one_than_forces_are_calibrated_is_suspected(l1, factor, status):
    """Of masses weighed to 1 ppm, 0.3 % on all forces is significant; no torque constant is known to that."""
    weighed = Parameters(replace(p, stderr=1e-6 * p.value) if p.name.endswith(".mass") else p for p in l1.parameters)
    masses = [replace(p, value=factor * p.value) for p in weighed if p.name.endswith(".mass")]
    (found,) = find_parameter_changes(l1, weighed, Parameters(masses))
    assert found.cause == "drive_gain" and found.status == status
    assert ("calibrated" in found.why_not_confirmed) is (status == "suspected")


def test_two_masses_off_by_different_factors_are_no_gain(l1):
    """Plus 40 % and minus 30 % have no common factor: two link masses."""
    names = ("cart1_link.mass", "cart2_link.mass")
    found = judged(l1, dict(zip(names, (1.4, 0.7), strict=True)))
    assert sorted(f.joints for f in found) == [("cart1_link",), ("cart2_link",)]
    assert {f.cause for f in found} == {"link_mass"}


def test_a_single_mass_may_always_be_the_gain(one):
    """With one mass in the model payload, link mass and gain are the same number: all are said."""
    (found,) = judged(one, 1.3)
    assert found.cause == "payload"
    assert set(found.indistinguishable_from) == {"link_mass", "drive_gain"}
    (less,) = judged(one, 0.7)
    assert less.cause == "link_mass" and less.indistinguishable_from == ("drive_gain",)


def test_what_the_fit_does_not_know_is_not_compared(l1):
    """A mass with an error above 30 %, without one, or held fixed is no evidence against the file."""
    assert judged(l1, 1.5, stderr=0.5) == []
    for change in ({"stderr": None}, {"free": False}):
        p = l1.parameters["cart1_link.mass"]
        row = Parameter(p.name, 1.5 * p.value, "kg", **{"stderr": 0.01, **change})
        assert find_parameter_changes(l1, l1.parameters, Parameters([row])) == []


def test_a_robot_file_that_trusts_its_mass_less_is_believed(one):
    """20 % off is nothing where the file says 15 %."""
    vague = one.parameters.update({"block_link.mass": {"prior_stderr": 0.15 * 5}})
    row = Parameters([Parameter("block_link.mass", 6.0, "kg", stderr=0.01)])
    assert find_parameter_changes(one, vague, row) == []
    assert len(find_parameter_changes(one, one.parameters, row)) == 1


def test_a_number_that_no_machine_has_is_suspected():
    """A carriage a hundred times as heavy as its file says is a unit, not a payload; one of twice its mass may be loaded."""
    robot = load_robot("linear_axis")
    model = Model.of(robot)
    nominal = model.parameters
    mass = nominal["carriage_link.mass"].value
    for factor, status in ((2.0, "parameter"), (100.0, "suspected")):
        changes = {"carriage_link.mass": {"value": factor * mass, "stderr": 0.001 * factor * mass}}
        (finding,) = find_parameter_changes(model, nominal, nominal.update(changes))
        assert finding.status == status and ("plausible" in finding.why_not_confirmed) == (status == "suspected")


@pytest.mark.parametrize("factor", [1.07, 0.93])
def test_a_mass_may_be_off_to_either_side(one, factor):
    """7 % off, known to half a per cent and trusted to two: the chance is that of both tails at 0.07 over their root sum."""
    (found,) = judged(one, factor)
    z = 0.07 / np.hypot(0.02, 0.005)
    assert_allclose(found.p_value, 2 * stats.norm.sf(z), rtol=1e-9)
    assert_allclose(found.score, z**2, rtol=1e-9)


def test_masses_that_scatter_about_their_mean_factor_are_no_gain(l1):
    """Plus 40 % and plus 20 % raise the mean factor by four of its errors or more, yet the others stand still: no gain."""
    names = ("cart1_link.mass", "cart2_link.mass")
    found = judged(l1, dict(zip(names, (1.4, 1.2), strict=True)))
    assert sorted(f.joints for f in found) == [("cart1_link",), ("cart2_link",)]
