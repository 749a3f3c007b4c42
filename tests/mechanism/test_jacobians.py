"""The tool's velocity and acceleration against differences of forward kinematics, and what singular means."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism import (
    build_kinematics,
    forward_kinematics,
    frames,
    get_rods,
    jacobian,
)
from tau_dyn.robot import load_robot

ROBOTS = ["gantry_tau", "gantry_tau_f1", "gantry_tau_queensland", "delta", "stewart", "hexarot", "h4", "linear_axis"]


def twist_between(before, after, h: float) -> np.ndarray:
    """Return the central difference (N, 6) of poses `2 h` apart."""
    turn = Rotation.from_matrix(after.rotation @ np.swapaxes(before.rotation, 1, 2)).as_rotvec()
    return np.concatenate([after.position - before.position, turn], axis=1) / (2 * h)


@pytest.mark.parametrize("name", ROBOTS)
def test_velocity_and_acceleration_maps(name, rng):
    """`J v` and `dJ/dt v` along a straight line in `q` equal the poses' differences, to 1e-6."""
    robot = load_robot(name)
    n = 3 if name == "h4" else 20
    q = robot.home + 0.03 * rng.standard_normal((n, robot.na))
    v, h = rng.standard_normal((n, robot.na)), 1e-5
    J = jacobian(robot, q)
    rows = J.shape[1]
    before, after = (forward_kinematics(robot, q + s * h * v).poses for s in (-1, 1))
    size = np.abs(J).max()
    assert_allclose(np.einsum("nij,nj->ni", J, v), twist_between(before, after, h)[:, :rows], atol=1e-6 * size)
    rates = [np.einsum("nij,nj->ni", jacobian(robot, q + s * h * v), v) for s in (-1, 1)]
    bias = build_kinematics(robot).acceleration_bias(q, v)
    assert_allclose(bias, (rates[1] - rates[0]) / (2 * h), atol=1e-5 * max(size, np.abs(bias).max()))


def test_a_sample_without_numbers_leaves_the_acceleration_of_its_neighbours_alone(rng):
    """Of a tree with loops, not-a-number and positions beyond any robot give nan, and the others what they give alone."""
    robot = load_robot("h4")
    q, v = robot.home + 0.01 * rng.standard_normal((4, robot.na)), rng.standard_normal((4, robot.na))
    alone = build_kinematics(robot).acceleration_bias(q[:1], v[:1])
    q[1, 0], q[2, 1], q[3, 2] = np.nan, 1e300, -1e300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        together = build_kinematics(robot).acceleration_bias(q, v)
        reason = forward_kinematics(robot, q).reason.tolist()
    assert_allclose(together[0], alone[0], rtol=1e-12)
    assert np.isnan(together[1:]).all() and reason == ["", "not a number", "out of reach", "out of reach"]


@pytest.mark.parametrize("name", ["gantry_tau", "gantry_tau_f1", "delta", "stewart"])
def test_rods_stay_closed(name, rng):
    """`G_x J + G_q = 0`: the gap does not open as the actuators move."""
    robot = load_robot(name)
    rods = get_rods(robot)
    assert rods is not None
    q = robot.home + 0.03 * rng.standard_normal((10, robot.na))
    total = rods.closure_by_pose(q) @ jacobian(robot, q) + rods.gap_by_q(q, forward_kinematics(robot, q).plate)
    assert_allclose(total, 0.0, atol=1e-12)


def test_singularities_show():
    """Rods that come into one plane lose hold of the plate; a rod across its guideway no longer moves it."""
    robot = load_robot("gantry_tau")
    usual = build_kinematics(robot).singularity(robot.home)
    assert usual.parallel[0] > 0.2 and usual.serial[0] > 0.5
    rods = get_rods(robot)
    assert rods is not None
    from tau_dyn.mechanism import SlidingPlate

    engine = SlidingPlate(rods)
    away = np.linspace(0, 3, 4000)[:, None] * np.array([1.0, -1.0, 0.0]) + robot.home  # carts apart until out of reach
    _, code = engine.forward(away)
    last = away[np.flatnonzero(code == 0)[-1]]
    assert build_kinematics(robot).singularity(last).parallel[0] < 0.1 * usual.parallel[0]


def test_a_slide_on_a_turn_has_its_coriolis_acceleration(rng):
    """Points on a turn, a slide on it and a turn again: their acceleration at rest of the drives, against differences."""
    joints, parent = [], -1
    for k, slides in enumerate((False, True, False)):
        origin, direction = rng.standard_normal((2, 3))
        rotation = Rotation.random(random_state=k).as_matrix()
        joints.append(frames.ChainJoint(f"j{k}", parent, k, slides, origin, direction, rotation))
        parent = k
    carried = frames.Carried((2, 1), rng.standard_normal((2, 3)))
    q, v, h = rng.standard_normal((3, 4)), rng.standard_normal((3, 4)), 1e-4
    before, here, after = (frames.compute_points(joints, carried, q + s * h * v) for s in (-1, 0, 1))
    bias = frames.compute_accelerations(joints, carried, q, v)
    assert_allclose(bias, (before - 2 * here + after) / h**2, atol=1e-5 * np.abs(bias).max())
