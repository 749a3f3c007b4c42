"""Which inertial numbers some distribution of positive mass has."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.estimate import pseudo_inertia
from tau_dyn.estimate.physical_consistency import PSEUDO_INERTIA_BASIS


def of_points(masses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the ten numbers of point masses (n,) at places (n, 3), about the origin."""
    inertia = sum(m * (x @ x * np.eye(3) - np.outer(x, x)) for m, x in zip(masses, places, strict=True))
    first = masses @ places
    return np.array(
        [masses.sum(), *first, *(inertia[i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))]
    )


def test_it_holds_the_second_moments_of_the_mass(rng):
    """`J = [[sum m x x', sum m x], [., sum m]]`, by its definition over point masses."""
    masses, places = rng.uniform(0.1, 2.0, 7), rng.normal(size=(7, 3))
    lifted = np.column_stack([places, np.ones(7)])
    assert_allclose(
        pseudo_inertia(of_points(masses, places)), lifted.T @ np.diag(masses) @ lifted, rtol=1e-12, atol=1e-12
    )


def test_it_agrees_with_pinocchios(rng):
    """Pinocchio's pseudo-inertia of a random body is ours: an independent source for order and frame."""
    body = pin.Inertia.Random()
    theirs = body.toPseudoInertia().toMatrix()
    assert_allclose(pseudo_inertia(body.toDynamicParameters()), theirs, rtol=1e-9, atol=1e-12)


def test_positive_masses_are_physical_and_a_negative_one_is_not(rng):
    """Seven points make a positive definite matrix, one a semidefinite one; a negative mass an indefinite one."""
    places = rng.normal(size=(7, 3))
    assert np.linalg.eigvalsh(pseudo_inertia(of_points(np.ones(7), places)))[0] > 0
    assert abs(np.linalg.eigvalsh(pseudo_inertia(of_points(np.ones(1), places[:1])))[0]) < 1e-12
    assert np.linalg.eigvalsh(pseudo_inertia(of_points(np.array([2.0, -0.1]), places[:2])))[0] < 0


@pytest.mark.parametrize("change", [(0, -2.0), (4, 9.0), (1, 50.0)])
def test_impossible_numbers_are_not_physical(change):
    """A negative mass, moments against the triangle inequality, a centre outside what the inertia allows."""
    pi = np.array([2.0, 0.1, 0.0, 0.2, 0.5, 0.0, 0.5, 0.0, 0.0, 0.5])
    assert np.linalg.eigvalsh(pseudo_inertia(pi))[0] > 0
    pi[change[0]] = change[1]
    assert np.linalg.eigvalsh(pseudo_inertia(pi))[0] < -1e-3


def test_it_is_linear_in_the_ten_numbers(rng):
    """`J(x + 2 y) = J(x) + 2 J(y)`, and the basis is its derivative: what lets a conic program use it."""
    x, y = rng.normal(size=(2, 10))
    assert_allclose(pseudo_inertia(x + 2 * y), pseudo_inertia(x) + 2 * pseudo_inertia(y), rtol=1e-12, atol=1e-12)
    assert_allclose(PSEUDO_INERTIA_BASIS, [pseudo_inertia(unit) for unit in np.eye(10)])
