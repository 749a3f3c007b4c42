"""The simplified Gantry-Tau: closed form, Pinocchio with loops, and the thesis' equations as printed agree."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import GantryTauMechanism, TreeMechanism, build_mechanism
from tau_dyn.robot import Robot, load_robot


@pytest.mark.parametrize("rods", ["uniform", "point"])
@pytest.mark.parametrize("prototype", ["l1", "l2", "d1", "t1"])
def test_closed_form_equals_pinocchio_with_loops(robots, motion, prototype: str, rods: str) -> None:
    """On random states to 1e-9, D1's slightly crooked guideways included.

    T1's uniform rods weigh grams: the 1e-12 kg m^2 that the file gives them along their axis is 1e-8 of their inertia.
    """
    robot = robots(f"{prototype} simplified {rods}")
    closed, tree = GantryTauMechanism(robot), TreeMechanism(robot)
    q, v, a = motion(robot, 12, 0.05 if prototype == "t1" else 0.25)
    scale = 100 if (prototype, rods) == ("t1", "uniform") else 1
    Y = tree.regressor(q, v, a)
    assert_allclose(closed.regressor(q, v, a), Y, atol=1e-9 * scale * max(1, np.abs(Y).max()))
    assert_allclose(closed.inverse_dynamics(q, v, a), tree.inverse_dynamics(q, v, a), atol=1e-9 * scale)
    assert_allclose(closed.tool_position(q), tree.tool_position(q), atol=1e-10)
    for k in range(4):
        for ours, theirs in zip(closed.mass_and_bias(q[k], v[k]), tree.mass_and_bias(q[k], v[k]), strict=True):
            assert_allclose(ours, theirs, atol=1e-9 * scale)


def thesis_forces(robot: Robot, T: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the cart forces of one sample by Dressler 2012, (6.3)-(6.7), coded as printed (with T'' after M_1)."""
    origins = np.array([[0.04, 0, 1.44], [0.25, -1.31, 1.46], [0, 0, 0]])  # Table 5.7
    m_c, m_a = ([robot.parameters[f"{part}{i}_link.mass"].value for i in (1, 2, 3)] for part in ("cart", "rod"))
    m_c, m_a, m_p = np.array(m_c), np.array(m_a), robot.parameters["plate_link.mass"].value
    D = T - (origins + np.outer(q, [1, 0, 0]))  # (6.4)
    assert_allclose(np.array([2.05, 1.82, 1.81]) ** 2 - np.sum(D**2, axis=1), 0, atol=1e-12)  # (6.3)
    X, Y, Z = D.T
    J = np.linalg.inv(np.column_stack([np.ones(3), Y / X, Z / X]))  # (6.5)
    T1 = J @ v
    T2 = J @ a - np.linalg.inv(D) @ ((T1[0] - v) ** 2 + T1[1] ** 2 + T1[2] ** 2)  # (6.6)
    M1 = np.diag([m_p + sum(m_a) / 2, m_p + sum(m_a) / 4, m_p + sum(m_a) / 4])
    M1[1, 0], M1[2, 0] = np.sum(m_a / 4 * Y / X), np.sum(m_a / 4 * Z / X)
    M2 = np.array([m_c + m_a / 2, Y / X * (m_c + m_a / 4), Z / X * (m_c + m_a / 4)])
    G = 9.81 * np.array([0, 0, m_p + sum(m_a) / 2])
    return J.T @ (M1 @ T2 + M2 @ a + G)  # (6.7)


def test_thesis_equations_hold_for_point_masses(robots, motion) -> None:
    """(6.3)-(6.7) with point masses at mid-rod, against both of ours, to 1e-9 N."""
    robot = robots("l1 simplified point")
    closed, tree = build_mechanism(robot), TreeMechanism(robot)
    q, v, a = motion(robot, 30)
    expected = [thesis_forces(robot, *x) for x in zip(closed.tool_position(q), q, v, a, strict=True)]
    assert_allclose(closed.inverse_dynamics(q, v, a), expected, atol=1e-9)
    assert_allclose(tree.inverse_dynamics(q, v, a), expected, atol=1e-9)


def test_uniform_rods_are_not_point_masses(robots, motion) -> None:
    """A rod's own turning costs m L^2 / 12: tenths of newtons that the thesis' model leaves out."""
    q, v, a = motion(robots("l1 simplified uniform"), 30)
    point, uniform = (build_mechanism(robots(f"l1 simplified {rods}")) for rods in ("point", "uniform"))
    assert 0.1 < np.abs(uniform.inverse_dynamics(q, v, a) - point.inverse_dynamics(q, v, a)).max() < 20
    rest = np.zeros_like(q)
    assert_allclose(uniform.inverse_dynamics(q, rest, rest), point.inverse_dynamics(q, rest, rest), atol=1e-9)


def test_build_takes_the_closed_form_only_where_it_is_exact(robots) -> None:
    """Thick rods, untied inertia and complete arms go through Pinocchio; guideways need not be parallel."""
    assert isinstance(build_mechanism(robots("l1 simplified uniform")), GantryTauMechanism)
    assert isinstance(build_mechanism(robots("d1 simplified uniform")), GantryTauMechanism)
    assert isinstance(build_mechanism(robots("l1 simplified uniform").untied(["rod2_link.mx"])), TreeMechanism)
    assert isinstance(build_mechanism(robots("l1 complete uniform")), TreeMechanism)
    assert isinstance(build_mechanism(load_robot("gantry_tau", rod_radius=0.02)), TreeMechanism)


def test_closed_form_holds_at_masses_other_than_nominal(robots, motion, rng) -> None:
    """Identified masses move centre and inertia along, in both ways of computing."""
    robot = robots("l1 simplified uniform")
    robot = robot.with_parameters(robot.parameters.with_values(robot.parameters.values * rng.uniform(0.5, 2, 10)))
    q, v, a = motion(robot)
    closed, tree = GantryTauMechanism(robot), TreeMechanism(robot)
    assert_allclose(closed.inverse_dynamics(q, v, a), tree.inverse_dynamics(q, v, a), atol=1e-9)
