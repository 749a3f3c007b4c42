"""Every way to put a robot together at given actuated positions: each closes the loops, and the count says what it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.kinematics.assembly import list_robot_modes
from tau_dyn.kinematics.assembly.robot_modes import search_tree_modes
from tau_dyn.mechanism import TreePose, build_rods, forward_kinematics
from tau_dyn.robot import load_robot


def beside_home(robot, size: float = 0.04) -> np.ndarray:
    """Return positions (na,) a little off home, each joint by another amount."""
    return robot.home + size * np.cos(1.3 * np.arange(robot.na))


@pytest.mark.parametrize(
    ("name", "given", "count", "proved"),
    [
        ("gantry_tau", {}, 2, True),
        ("gantry_tau", {"arms": "complete"}, 6, True),
        ("gantry_tau_f1", {}, 8, True),
        ("hexa_321", {}, 4, True),  # rods that share points of the plate 3, 2, 1: eight modes with the complex ones
        ("stewart", {}, 8, False),
        ("delta", {}, 16, False),
    ],
)
def test_modes_of_rods_hold_every_rod(name, given, count, proved) -> None:
    """Each mode keeps all rods' lengths, no two are the same, and the first is where forward kinematics puts the tool."""
    robot = load_robot(name, **given)
    rods, q = build_rods(robot), beside_home(robot)
    modes = list_robot_modes(robot, q)
    assert (modes.tool.n_samples, modes.proved) == (count, proved)
    gaps = rods.gap(np.repeat(q[None], count, axis=0), rods.plate_poses(modes.tool))
    assert np.abs(gaps).max() < 1e-9
    found = forward_kinematics(robot, q).poses
    assert modes.home and modes.names[:2] == ["home", "2"]
    assert_allclose(modes.tool.position[0], found.position[0], atol=1e-9)
    flat = np.concatenate([modes.tool.position, modes.tool.rotation.reshape(count, 9)], axis=1)
    assert (np.linalg.norm(flat[:, None] - flat, axis=2) + 9 * np.eye(count)).min() > 1e-4


@pytest.mark.parametrize(("name", "given"), [("gantry_tau", {}), ("gantry_tau_f1", {}), ("stewart", {})])
def test_many_starts_find_what_the_homotopy_proves(name, given) -> None:
    """Newton's method on the passive joints, which knows nothing of rods, meets the same modes: two independent solvers."""
    robot = load_robot(name, **given)
    q = beside_home(robot)
    proved, found = list_robot_modes(robot, q).tool, search_tree_modes(TreePose(robot), q).tool
    assert found.n_samples == proved.n_samples
    away = np.abs(found.rotation[:, None] - proved.rotation).max(axis=(2, 3))
    away += np.linalg.norm(found.position[:, None] - proved.position, axis=2)
    assert away.min(axis=1).max() < 1e-7 and away.min(axis=0).max() < 1e-7


def test_a_four_bar_is_parallel_or_crossed() -> None:
    """The two modes are the two points in which a circle about A_2 and one about B_1 meet (Freudenstein 1955)."""
    robot = load_robot("parallelogram")
    q, length, width, h = 0.3, 0.95, 0.25, 0.1
    modes = list_robot_modes(robot, np.array([q]))
    b1 = np.array([-width / 2 + length * np.sin(q), -length * np.cos(q)])
    a2 = np.array([width / 2, 0.0])
    d = b1 - a2
    along = (length**2 - width**2 + d @ d) / (2 * d @ d)
    high = np.sqrt(length**2 - along**2 * (d @ d)) / np.linalg.norm(d)
    expected = []
    for side in (1, -1):
        b2 = a2 + along * d + side * high * np.array([-d[1], d[0]])
        x = (b2 - b1) / width
        expected.append((b1 + b2) / 2 - h * np.array([-x[1], x[0]]))
    tool = modes.tool.position[:, [0, 2]]
    order = [int(np.argmin(np.linalg.norm(tool - e, axis=1))) for e in expected]
    assert sorted(order) == [0, 1] and not modes.proved
    assert_allclose(tool[order], expected, atol=1e-9)


def test_a_wrist_follows_both_modes_of_its_plate() -> None:
    """A serial wrist shifts the tool by the same vector in both modes of the plate, which keeps its orientation."""
    plain = load_robot("gantry_tau", wrist="serial2")
    moving = load_robot("gantry_tau", wrist="serial2", wrist_moves="true")
    q = moving.home + 0.05
    carts = [moving.actuated.index(j) for j in plain.actuated]
    modes = list_robot_modes(moving, q)
    plates = build_rods(plain).both_forward(q[carts])[0]
    assert modes.tool.n_samples == 2 and not modes.proved and "no bound" in modes.why
    assert_allclose(modes.tool.position[0] - modes.tool.position[1], plates[0] - plates[1], atol=1e-9)


def test_a_serial_robot_has_one_mode() -> None:
    """Without loops the positions determine the pose: one mode, proved."""
    robot = load_robot("linear_axis")
    modes = list_robot_modes(robot, np.array([0.2]))
    assert modes.names == ["home"] and modes.proved
    assert_allclose(modes.tool.position, forward_kinematics(robot, np.array([[0.2]])).poses.position)


def test_out_of_reach_there_is_no_mode() -> None:
    """Carts farther apart than the rods reach leave the spheres without a point in common: no real mode, and that is proved."""
    robot = load_robot("gantry_tau")
    modes = list_robot_modes(robot, np.array([-5.0, 5.0, 0.0]))
    assert modes.tool.n_samples == 0 and modes.proved and not modes.home
