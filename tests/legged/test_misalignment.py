"""An IMU at an angle on the trunk: the forces that are missed are those of `compute_imu_turn`, and no turn of the ground's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.legged import compute_contact_jacobian, compute_imu_turn, eliminate_contacts
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import load_robot

STEP_S = 1e-3


def move(t: np.ndarray) -> np.ndarray:
    """Return coordinates (N, 18) of a walker that heads 70 degrees to the left, sways, tilts, turns and moves its legs."""
    middle = np.concatenate([[0.3, -0.2, 0.35, 1.2, 0.1, -0.15], np.tile([0.0, 0.6, -1.2], 4)])
    size = np.concatenate([[0.03] * 3, [0.3] * 3, [0.1] * 12])
    number = np.arange(18)
    return middle + size * np.sin(2 * np.pi * (1.6 + 0.05 * number) * t[:, None] + number)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_forces_missed_are_those_of_the_turned_base(walker_file, axis):
    """Log an orientation turned by 1 mrad: without contacts the equations err by the turn's forces, to first order.

    Feet are points here: the place where a ball touches the ground moves by its radius times the turn.
    """
    feet = [f"{leg}_foot=0" for leg in ("fl", "fr", "hl", "hr")]
    robot = load_robot(walker_file, base="floating", contacts=feet)
    q = move(STEP_S * np.arange(400))
    v = np.gradient(q, STEP_S, axis=0, edge_order=2)
    a = np.gradient(v, STEP_S, axis=0, edge_order=2)
    mechanism = build_mechanism(robot)
    rigid = mechanism.inverse_dynamics(q, v, a)
    J = compute_contact_jacobian(robot, q)
    tau = rigid - (J.swapaxes(1, 2) @ (np.linalg.pinv(J[:, :, :6].swapaxes(1, 2)) @ rigid[:, :6, None]))[:, :, 0]
    turn = 1e-3 * np.eye(3)[axis]
    missed = []
    for sign in (1, -1):
        logged = q.copy()
        turned = Rotation.from_euler("ZYX", q[:, 3:6]) * Rotation.from_rotvec(-sign * turn)
        logged[:, 3:6] = turned.as_euler("ZYX")
        v = np.gradient(logged, STEP_S, axis=0, edge_order=2)
        a = np.gradient(v, STEP_S, axis=0, edge_order=2)
        free = eliminate_contacts(robot, logged, np.ones((len(q), 4), bool))
        missed.append(free.project(tau - mechanism.inverse_dynamics(logged, v, a)))
    found = eliminate_contacts(robot, q, np.ones((len(q), 4), bool)).project(compute_imu_turn(mechanism, q, v, a))
    inner = slice(5, -5)  # where differences are central
    wanted = ((missed[0] - missed[1]) / 2e-3)[inner]
    assert np.abs(wanted).max() > 50  # [N/rad and N m/rad]
    assert_allclose(found[inner, :, axis], wanted, atol=0.002 * np.abs(wanted).max())
