"""The nearest physical parameters: what is moved, what is left alone, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import AsymmetricFriction
from tau_dyn.estimate import InertialBody, PhysicalConstraints, find_base, pseudo_inertia, solve_consistent
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import INERTIAL

LINK = tuple(f"arm_link.{quantity}" for quantity in INERTIAL)
PHYSICAL = np.array([2.0, 0.1, 0.0, 0.2, 0.5, 0.0, 0.5, 0.0, 0.0, 0.5])
PHYSICS = PhysicalConstraints((InertialBody("arm_link", LINK, np.eye(10)),))


def link_parameters(values: np.ndarray) -> Parameters:
    """Return a link's ten parameters, the mass bounded below by zero."""
    return Parameters(
        Parameter(n, x, "1", 0.0 if n.endswith("mass") else -np.inf) for n, x in zip(LINK, values, strict=True)
    )


def masses(*values: float) -> Parameters:
    return Parameters(Parameter(f"m{k}", x, "kg", 0.0) for k, x in enumerate(values))


@pytest.fixture
def seen():
    """Return the base parameters of ten columns that are all independent."""
    return find_base(np.eye(10), LINK)


def test_a_physical_estimate_is_not_touched(seen):
    """Within bounds and with a positive pseudo-inertia, the answer is the least-squares estimate to the last digit."""
    found = solve_consistent(link_parameters(PHYSICAL + 0.05), seen, PHYSICAL, np.eye(10), PHYSICS)
    assert_allclose(found.parameters.values, PHYSICAL, rtol=0, atol=0)
    assert not found.moved


def test_an_impossible_estimate_becomes_possible_and_is_named(seen):
    """A moment of inertia against the triangle inequality: the answer lies on the edge of the physical, and says for whom."""
    beta = PHYSICAL.copy()
    beta[4] = 1.5
    found = solve_consistent(link_parameters(PHYSICAL), seen, beta, 10 * np.eye(10), PHYSICS)
    J = pseudo_inertia(found.parameters.values)
    assert np.linalg.eigvalsh(J)[0] > -1e-7
    assert np.linalg.eigvalsh(J)[0] < 1e-4
    assert set(found.moved) == {"arm_link inertia"}
    assert found.moved["arm_link inertia"] < 0


def test_what_the_data_know_well_is_not_moved_for_what_they_hardly_know(seen):
    """Only the moment about x may give way: it stops where `(S_xx - mx^2/m) (S_zz - mz^2/m) = (mx mz / m)^2`.

    With `S_xx = (iyy + izz - ixx) / 2` and the like, m = 2, mx = 0.1, mz = 0.2: `(1 - x - 0.01) (x - 0.04) = 4e-4`.
    """
    beta = PHYSICAL.copy()
    beta[4] = 1.5
    found = solve_consistent(link_parameters(PHYSICAL), seen, beta, np.diag([1e3] * 4 + [1.0] + [1e3] * 5), PHYSICS)
    edge = np.roots([-1.0, 1.03, -0.0396 - 4e-4]).max()
    assert_allclose(found.parameters.values[4], edge, atol=2e-3)
    assert_allclose(np.delete(found.parameters.values - PHYSICAL, 4), 0, atol=1e-3)
    assert set(found.moved) == {"arm_link inertia"}


def test_it_is_the_nearest_in_the_metric_of_the_data():
    """Two negatively correlated masses, one negative: it goes to zero, and the other to the conditional mean given that.

    With `R' R = cov^-1`, `m1 = b1 + cov_10 / cov_00 (0 - b0)`.
    """
    cov = np.array([[4.0, -1.8], [-1.8, 1.0]])
    beta = np.array([-3.0, 5.0])
    R = np.linalg.cholesky(np.linalg.inv(cov)).T
    found = solve_consistent(masses(1.0, 2.0), find_base(np.eye(2), ("m0", "m1")), beta, R, None)
    assert_allclose(found.parameters.values, [0.0, 5.0 - 1.8 / 4.0 * 3.0], atol=2e-3)  # 1e-4 of pull to the robot file
    assert found.moved == {"m0": -3.0}
    assert found.parameters["m0"].at_bound


def test_a_small_step_over_a_bound_is_still_named():
    """A mass of -2 +- 20 kg is held at zero; a reader must hear of it though the data hardly mind."""
    R = np.diag([1 / 20.0, 1.0])
    found = solve_consistent(masses(1.0, 2.0), find_base(np.eye(2), ("m0", "m1")), np.array([-2.0, 2.0]), R, None)
    assert found.moved == {"m0": -2.0}
    assert found.parameters["m0"].value == 0.0


def test_what_the_data_do_not_see_keeps_its_nominal_value():
    """Only `m0 + m1` is seen: as 2 instead of 4 it shares the loss, but nothing becomes negative and the sum is kept."""
    W = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    base = find_base(W, ("m0", "m1", "m2"))
    found = solve_consistent(masses(1.0, 3.0, 1.0), base, np.array([2.0, -1.0]), 100 * np.eye(2), None)
    m0, m1, m2 = found.parameters.values
    assert_allclose(m0 + m1, 2.0, atol=1e-4)
    assert min(m0, m1) >= 0
    assert m2 == 0.0
    assert set(found.moved) == {"m2"}  # m1 keeping 3 would need m0 = -1: no fault of the data
    untouched = solve_consistent(masses(1.0, 3.0, 1.0), base, np.array([4.5, 1.0]), 100 * np.eye(2), None)
    assert_allclose(untouched.parameters.values, [1.5, 3.0, 1.0])


def test_a_fixed_part_of_a_body_counts(seen):
    """With the mass fixed at 2 kg, a first moment beyond what the fixed inertia allows is pulled back."""
    parameters = link_parameters(PHYSICAL).update({n: {"free": False} for n in LINK if n != "arm_link.mx"})
    base = find_base(np.ones((1, 1)), ("arm_link.mx",))
    found = solve_consistent(parameters, base, np.array([5.0]), np.ones((1, 1)), PHYSICS)
    assert np.linalg.eigvalsh(pseudo_inertia(found.parameters.values))[0] > -1e-7
    assert 0 < found.parameters["arm_link.mx"].value < 2


def test_contradictory_bounds_are_the_users_fault():
    """Diagonal inertias of 1, 0.001 and 0.001 kg m^2 belong to no body; the sentence names the link."""
    values = {"ixx": 1.0, "iyy": 0.001, "izz": 0.001}
    rows = [
        Parameter(n, values.get(q, 1.0 if q == "mass" else 0.0), "kg", free=q not in values)
        for n, q in zip(LINK, INERTIAL, strict=True)
    ]
    free = tuple(p.name for p in rows if p.free)
    base, beta = find_base(np.eye(len(free)), free), np.array([p.value for p in rows if p.free])
    with raises_code("infeasible", "arm_link"):
        solve_consistent(Parameters(rows), base, beta, np.eye(len(free)), PHYSICS)


def test_bounds_alone_are_never_the_contradiction(monkeypatch):
    """Bounds leave room for some answer; a solver that finds none has been given data that tell too little."""
    import cvxpy

    def gives_up(problem, **_):
        raise cvxpy.SolverError

    monkeypatch.setattr(cvxpy.Problem, "solve", gives_up)
    seen = find_base(np.eye(2), ("m0", "m1"))
    with raises_code("too_little_data"):
        solve_consistent(masses(1.0, 1.0), seen, np.array([1.0, -1.0]), np.eye(2), None)


@pytest.mark.parametrize("precision", [1e2, 1e4, 1e6, 1e8])
def test_data_almost_without_noise_have_an_answer_too(seen, precision, rng):
    """However precise the data, an impossible estimate has a nearest possible one; it is no contradiction in the user's input."""
    beta = PHYSICAL.copy()
    beta[0], beta[9] = 0.001, -0.3  # a mass of 1 g with the moments of 2 kg, and a negative one
    R = precision * np.linalg.qr(rng.normal(size=(10, 10)))[1] * np.geomspace(1, 1e-6, 10)
    found = solve_consistent(link_parameters(PHYSICAL), seen, beta, R, PHYSICS)
    J = pseudo_inertia(found.parameters.values)
    assert np.linalg.eigvalsh(J)[0] > -1e-6 * np.trace(J)
    assert "arm_link inertia" in found.moved


FRICTION = ("axis.coulomb_pos", "axis.coulomb_neg", "axis.viscous_pos", "axis.viscous_neg")


@pytest.mark.parametrize("offset", [-30.0, 0.0, 30.0])
def test_an_offset_of_the_force_may_exceed_the_coulomb_friction(offset):
    """A constant offset c makes the two Coulomb values F + c and F - c; their sum stays 2 F, so the estimate is admissible."""
    friction = AsymmetricFriction(("axis",), {"axis": "N"}).parameters
    beta = np.array([20.0 + offset, 20.0 - offset, 3.0, 3.0])
    found = solve_consistent(friction, find_base(np.eye(4), FRICTION), beta, np.eye(4), None)
    assert_allclose(found.parameters.values, beta, rtol=0, atol=0)
    assert not found.moved and not any(found.parameters.is_at_bound(name) for name in FRICTION)


def test_a_negative_sum_of_coulomb_values_is_moved_to_zero():
    """Friction that drives on average has no physical reading; of the two values only the difference is left, an offset."""
    friction = AsymmetricFriction(("axis",), {"axis": "N"}).parameters
    beta = np.array([-5.0, 1.0, 3.0, 3.0])
    found = solve_consistent(friction, find_base(np.eye(4), FRICTION), beta, np.eye(4), None)
    assert_allclose(found.parameters.values, [-3.0, 3.0, 3.0, 3.0], atol=1e-3)
    assert_allclose(found.moved["axis.coulomb_pos + axis.coulomb_neg"], -4.0)
    assert [found.parameters.is_at_bound(name) for name in FRICTION] == [True, True, False, False]


def test_the_sum_of_coulomb_values_counts_one_that_is_fixed():
    """With one value given, the other one may fall to its negative."""
    rows = [Parameter(FRICTION[0], 4.0, "N"), replace(Parameter(FRICTION[1], 2.0, "N"), free=False)]
    found = solve_consistent(
        Parameters(rows), find_base(np.eye(1), FRICTION[:1]), np.array([-7.0]), np.eye(1), None
    ).parameters
    assert_allclose(found.values, [-2.0, 2.0], atol=1e-5)
