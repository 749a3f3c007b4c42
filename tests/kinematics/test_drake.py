"""Poses against Drake on the same file: its tree, its frames; only the closed positions of passive joints are found by ours."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import LoopSolver, build_rods, forward_kinematics
from tau_dyn.robot import load_robot

ROBOTS = [
    "gantry_tau", "gantry_tau_f1", "gantry_tau_t2", "gantry_tau_5dof", "gantry_tau_queensland", "delta", "stewart",
    "hexa_321", "hexaglide", "hexarot", "scara_tau", "triglide",
]  # fmt: skip


def root_link(robot) -> str:
    """Return the link that stands still."""
    return next(f.name for f in robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint == 0)


@pytest.mark.parametrize("name", ROBOTS)
def test_poses_and_points_equal_drakes(name, rng):
    """Drake puts tool and rod ends where forward kinematics has them, with the passive joints where the loops close."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    robot = load_robot(name)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(robot.urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(root_link(robot)))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    q = robot.home + 0.02 * rng.standard_normal((5, robot.na))
    found = forward_kinematics(robot, q)
    rods, solver = build_rods(robot), LoopSolver(robot)
    assert found.ok.all()
    for k in range(len(q)):
        tree = solver.close(q[k])
        positions = np.zeros(plant.num_positions())
        for joint in robot.model.names[1:]:
            index = robot.model.joints[robot.model.getJointId(joint)].idx_q
            positions[plant.GetJointByName(joint).position_start()] = tree[index]
        plant.SetPositions(context, positions)
        pose = plant.GetFrameByName("tool_link").CalcPoseInWorld(context)
        assert_allclose(found.poses.position[k], pose.translation(), atol=1e-11)
        assert_allclose(found.poses.rotation[k], pose.rotation().matrix(), atol=1e-11)
        plate = plant.GetFrameByName(rods.plate).CalcPoseInWorld(context)
        assert_allclose(found.plate.position[k], plate.translation(), atol=1e-11)
