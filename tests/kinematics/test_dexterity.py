"""Dexterity and stiffness against finite differences, springs loaded by hand, and poses built to be singular."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics import Rates
from tau_dyn.kinematics.dexterity import (
    compute_dexterity,
    compute_tool_jacobian,
    compute_worst_force,
    compute_worst_speed,
    find_softest,
    homogenise_jacobians,
)
from tau_dyn.kinematics.workspace import Quality, build_elasticity, build_machine
from tau_dyn.mechanism import FlexibleModel, Poses, forward_kinematics, state_springs
from tau_dyn.robot import load_robot

ROBOTS = [("gantry_tau", {}), ("stewart", {}), ("gantry_tau_f1", {})]


@pytest.fixture(scope="module", params=ROBOTS, ids=lambda p: p[0])
def machine(request: pytest.FixtureRequest):
    name, arguments = request.param
    return build_machine(load_robot(name, **arguments))


def beside_home(machine) -> tuple[np.ndarray, Poses]:
    q = machine.robot.home + 0.03 * np.cos(np.arange(machine.robot.na) + 1.0)
    found = forward_kinematics(machine.robot, q[None])
    assert found.ok.all()
    return q[None], found.poses


def test_jacobian_is_the_slope_of_forward_kinematics(machine) -> None:
    """Moving one actuator by a micrometre moves the tool as its column of J says."""
    q, poses = beside_home(machine)
    J, h = compute_tool_jacobian(machine.rates(q, poses))[0], 1e-6
    for k in range(machine.robot.na):
        step = np.zeros_like(q)
        step[0, k] = h
        ahead, behind = (forward_kinematics(machine.robot, q + s * step).poses for s in (1, -1))
        slope = (ahead.position - behind.position)[0] / (2 * h)
        np.testing.assert_allclose(J[:3, k], slope, atol=1e-7)
        if len(J) == 6:
            turn = Rotation.from_matrix(ahead.rotation[0] @ behind.rotation[0].T).as_rotvec() / (2 * h)
            np.testing.assert_allclose(J[3:, k], turn, atol=1e-7)


def test_stiffness_is_that_of_loaded_springs(machine) -> None:
    """Second differences of the springs' energy over tool and actuators, the actuators left to balance, give K.

    The springs are so stiff that the weight's share of the linearised robot's stiffness is below 1e-6.
    """
    rods, (q, poses) = machine.rods, beside_home(machine)
    n, na, d = rods.n, rods.na, 3 if rods.translates else 6
    k_rod, k_drives = 1e11, np.linspace(0.5, 1.5, na) * 1e11
    h = 1e-4
    steps = np.array([si * h * np.eye(na + d)[i] + sj * h * np.eye(na + d)[j]
                      for i in range(na + d) for j in range(na + d) for si in (1, -1) for sj in (1, -1)])  # fmt: skip
    turn = Rotation.from_rotvec(steps[:, na + 3 :]) if d == 6 else Rotation.identity(len(steps))
    moved = Poses(poses.position + steps[:, na : na + 3], turn.as_matrix() @ poses.rotation[0])
    stretch = rods.gap(q + steps[:, :na], rods.plate_poses(moved))
    energy = 0.5 * (k_rod * stretch**2 @ np.ones(n) + steps[:, :na] ** 2 @ k_drives)
    same, other, against, both = energy.reshape(na + d, na + d, 4).transpose(2, 0, 1)
    H = (same - other - against + both) / (4 * h**2)
    K = H[na:, na:] - H[na:, :na] @ np.linalg.solve(H[:na, :na], H[:na, na:])
    drives = dict(zip(machine.robot.actuated, k_drives, strict=True))
    found = FlexibleModel(state_springs(machine.robot, rods=k_rod, drives=drives)).at(q[0]).compliance()
    expected = np.linalg.inv(K)[:3, :3]
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_rigid_rods_leave_the_formula_of_the_textbook() -> None:
    """C = J diag(1/k) J' for rigid rods and one spring an actuator; K = J_x' diag(k) J_x for rigid actuators."""
    machine = build_machine(load_robot("stewart"))
    q, poses = beside_home(machine)
    rates, k = machine.rates(q, poses), np.linspace(1, 2, 6) * 1e11
    J = compute_tool_jacobian(rates)[0]
    drives = dict(zip(machine.robot.actuated, k, strict=True))
    found = FlexibleModel(state_springs(machine.robot, rods=np.inf, drives=drives)).at(q[0]).compliance()
    expected = (J @ np.diag(1 / k) @ J.T)[:3, :3]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    rows = rates.tool[0]
    found = FlexibleModel(state_springs(machine.robot, rods=1e11)).at(q[0]).compliance()
    expected = np.linalg.inv(rows.T @ rows)[:3, :3] / 1e11
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_the_softest_direction_is_named() -> None:
    """Compliances along x, y and z: each direction is as stiff as its spring, the softest comes first."""
    found = find_softest(np.diag([1 / 3e6, 1 / 1e6, 1 / 2e6])[None])
    np.testing.assert_allclose(found.stiffness[0], [1e6, 2e6, 3e6])
    np.testing.assert_allclose(np.abs(found.directions[0][:, 0]), [0, 1, 0], atol=1e-12)


def test_distance_is_zero_where_three_rods_lie_in_a_plane() -> None:
    """Rods in one plane cannot hold the plate across it: the parallel distance is zero and falls to it linearly."""
    lift = np.array([0.0, 1e-3, 1e-2])
    rods = np.array([[[1, 0, z], [-0.5, 0.8, z], [-0.5, -0.8, z]] for z in lift])
    rods /= np.linalg.norm(rods, axis=2, keepdims=True)
    found = compute_dexterity(Rates(rods, np.tile(np.eye(3), (3, 1, 1)), np.zeros(3, bool), 1.0))
    assert found.parallel[0] < 1e-12 and np.isinf(found.condition[0])
    np.testing.assert_allclose(found.parallel[2] / found.parallel[1], 10, rtol=0.01)


def test_distance_is_zero_where_a_rod_stands_across_its_guideway() -> None:
    """A rod at right angles to its cart's way is not moved by it: the serial distance is zero, and so is the speed."""
    way = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1.0]]])
    rates = Rates(way, np.array([[[1.0, 0, 0], [0, 1, 0], [0, 0, 0]]]), np.zeros(3, bool), 1.0)
    found = compute_dexterity(rates)
    assert found.serial[0] == 0 and found.manipulability[0] == 0 and np.isinf(found.condition[0])
    assert compute_worst_speed(rates, np.ones(3))[0] == 0


def test_speed_and_force_hold_in_every_direction(machine, rng: np.random.Generator) -> None:
    """No direction is slower or weaker than the worst, and the worst is met by some direction."""
    q, poses = beside_home(machine)
    rates, limits = machine.rates(q, poses), np.linspace(1, 2, machine.robot.na)
    J = compute_tool_jacobian(rates)[0]
    way = rng.normal(size=(20000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    needed = np.linalg.pinv(J) @ np.concatenate([way, np.zeros((len(way), len(J) - 3))], axis=1).T
    speeds = (limits[:, None] / np.abs(needed)).min(axis=0)
    forces = (limits[:, None] / np.abs(J[:3].T @ way.T)).min(axis=0)
    for worst, every in (
        (compute_worst_speed(rates, limits)[0], speeds),
        (compute_worst_force(rates, limits)[0], forces),
    ):
        assert worst <= every.min() * (1 + 1e-9)
        np.testing.assert_allclose(every.min(), worst, rtol=0.02)


def test_condition_does_not_depend_on_the_unit_of_length() -> None:
    """The homogenised Jacobian of a hexapod twice as large has the same condition number."""
    machine = build_machine(load_robot("stewart"))
    rates = machine.rates(*beside_home(machine))
    tool = rates.tool.copy()
    tool[:, :, 3:] *= 2
    larger = rates._replace(tool=tool, length=2 * rates.length)
    np.testing.assert_allclose(compute_dexterity(larger).condition, compute_dexterity(rates).condition, rtol=1e-12)


def test_an_arms_turns_are_lengths_too() -> None:
    """Of a serial arm, the rows of the tool's turns grow by the length and the columns of turning joints shrink by it."""
    J = np.arange(36.0).reshape(1, 6, 6) + np.eye(6)
    tool, joints = homogenise_jacobians(Rates(np.eye(6)[None], J, np.arange(6) > 2, 0.25))
    unit = np.array([1, 1, 1, 0.25, 0.25, 0.25])
    np.testing.assert_allclose(tool[0], np.eye(6))
    np.testing.assert_allclose(joints[0], unit[:, None] * J[0] / unit)


def test_nan_stays_nan() -> None:
    """A pose without positions has no figures, and spoils no other pose."""
    rods = np.tile(np.eye(3), (2, 1, 1))
    rods[0] = np.nan
    rates = Rates(rods, np.tile(np.eye(3), (2, 1, 1)), np.zeros(3, bool), 1.0)
    found = compute_dexterity(rates)
    assert np.isnan(found.condition[0]) and found.condition[1] == pytest.approx(1.0)


def test_springs_at_fault_are_refused() -> None:
    """A stiffness of zero, an unknown joint, a map that does not exist: one sentence each."""
    machine = build_machine(load_robot("gantry_tau"))
    with raises_code("invalid_value"):
        build_elasticity(machine, 0.0)
    with raises_code("unknown_name", "cart9"):
        build_elasticity(machine, None, {"cart9": 1e6})
    q, poses = beside_home(machine)
    with raises_code("unknown_name", "map"):
        Quality(machine, build_elasticity(machine)).compute_maps(["beauty"], q, poses)
