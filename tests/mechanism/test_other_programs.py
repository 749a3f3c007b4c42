"""The same file in Pinocchio's constrained dynamics, Drake and MuJoCo gives the same forces and accelerations."""

from __future__ import annotations

from xml.etree.ElementTree import fromstring

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import TreeMechanism, build_mechanism

KINDS = ["four_bar", "l1 simplified uniform", "d1 simplified uniform", "l1 complete uniform", "d1 complete uniform"]


@pytest.mark.parametrize("kind", [*KINDS, "l1 complete point"])
def test_forward_dynamics_equals_pinocchios_constrained_dynamics(robots, motion, kind: str) -> None:
    """Proximal iterations to 1e-12 on the constraint forces, against `M^-1 (tau - h)` in actuated coordinates, to 1e-8."""
    robot = robots(kind)
    mechanism, tree = build_mechanism(robot), TreeMechanism(robot)
    model = robot.model_with(robot.parameters)
    loops = pin.StdVec_RigidConstraintModel()
    for loop in robot.loops:
        a, b = model.frames[loop.frame_a], model.frames[loop.frame_b]
        ends = a.parentJoint, a.placement, b.parentJoint, b.placement
        loops.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.ReferenceFrame.LOCAL))
    data, loop_data = model.createData(), pin.StdVec_RigidConstraintData()
    for loop in loops:
        loop_data.append(loop.createData())
    pin.initConstraintDynamics(model, data, loops, loop_data)
    q, v, tau = motion(robot, 5)
    for k in range(5):
        state = tree.solver.state(q[k], v[k], np.zeros(robot.na))
        force = np.zeros(model.nv)
        force[robot.active_v] = 50 * tau[k]
        settings = pin.ProximalSettings(1e-12, 1e-10, 20)
        a = pin.constraintDynamics(model, data, state.q, state.v, force, loops, loop_data, settings)
        ours = mechanism.forward_dynamics(q[k], v[k], 50 * tau[k])
        assert_allclose(ours, a[robot.active_v], atol=1e-8 * max(1, np.abs(a).max()))


def balls(urdf: str):
    """Return the file's loops as (link, point, link, point)."""
    tag = "{http://drake.mit.edu}ball_constraint"
    for ball in fromstring(urdf).findall(tag):
        part = {p: ball.find(f"{tag}_{p}") for p in ("body_A", "p_AP", "body_B", "p_BQ")}
        points = [np.array([float(x) for x in part[p].get("value").split()]) for p in ("p_AP", "p_BQ")]
        yield part["body_A"].get("name"), points[0], part["body_B"].get("name"), points[1]


@pytest.mark.parametrize("kind", KINDS)
def test_inverse_dynamics_equals_drakes(robots, motion, kind: str) -> None:
    """Drake's tree, Drake's constraint Jacobians and its constraint forces by Lagrange multipliers; only `q` is ours."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

    robot = robots(kind)
    plant = MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(robot.urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    context, by_v = plant.CreateDefaultContext(), JacobianWrtVariable.kV
    names = list(robot.model.names)[1:]
    order = np.array([plant.GetJointByName(n).velocity_start() for n in names])  # one velocity a joint
    active = order[robot.active_v]
    passive = np.setdiff1d(order, active)
    mechanism, tree = build_mechanism(robot), TreeMechanism(robot)
    q, v, a = motion(robot, 4)
    for k in range(4):
        positions = np.zeros(len(order))
        positions[order] = tree.solver.close(q[k])
        plant.SetPositions(context, positions)
        rows, gaps = [], []
        world = plant.world_frame()
        ends = [(plant.GetFrameByName(x), p) for a_, pa, b_, pb in balls(robot.urdf) for x, p in ((a_, pa), (b_, pb))]
        for frame, point in ends:
            rows.append(plant.CalcJacobianTranslationalVelocity(context, by_v, frame, point, world, world))
            gaps.append(plant.CalcPointsPositions(context, frame, point, world)[:, 0])
        assert_allclose(gaps[::2], gaps[1::2], atol=1e-10)
        J = np.concatenate([x - y for x, y in zip(rows[::2], rows[1::2], strict=True)])
        inverse = np.linalg.pinv(J[:, passive])
        speed, acceleration = np.zeros((2, len(order)))
        speed[active], acceleration[active] = v[k], a[k]
        speed[passive] = -inverse @ J[:, active] @ v[k]
        plant.SetVelocities(context, speed)
        bias = [plant.CalcBiasTranslationalAcceleration(context, by_v, f, p, world, world)[:, 0] for f, p in ends]
        gamma = np.concatenate([x - y for x, y in zip(bias[::2], bias[1::2], strict=True)])
        acceleration[passive] = -inverse @ (J[:, active] @ a[k] + gamma)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        tau = plant.CalcInverseDynamics(context, acceleration, forces)
        multipliers = inverse.T @ tau[passive]  # no drive at the passive joints: the loops' forces hold them
        assert_allclose(J[:, passive].T @ multipliers, tau[passive], atol=1e-9 * np.abs(tau).max())
        expected = tau[active] - J[:, active].T @ multipliers
        ours = mechanism.inverse_dynamics(q[[k]], v[[k]], a[[k]])[0]
        assert_allclose(ours, expected, atol=1e-9 * max(1, np.abs(tau).max()))


@pytest.mark.parametrize("kind", KINDS)
def test_inverse_dynamics_equals_mujocos(robots, motion, kind: str) -> None:
    """MuJoCo's `mj_inverse` of the tree, projected; the 1e-9 kg that it demands of massless links are taken out again."""
    mujoco = pytest.importorskip("mujoco")
    robot = robots(kind)
    bound = '<mujoco><compiler boundmass="1e-9" boundinertia="1e-12"/></mujoco>'
    urdf = robot.urdf if "<mujoco" in robot.urdf else robot.urdf.replace("</robot>", bound + "</robot>")
    model = mujoco.MjModel.from_xml_string(urdf)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # ranges of joints push
    light = model.body_mass < 1e-6
    model.body_mass[light], model.body_inertia[light] = 0.0, 0.0
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    order = [model.joint(n).dofadr[0] for n in list(robot.model.names)[1:]]
    mechanism, tree = build_mechanism(robot), TreeMechanism(robot)
    q, v, a = motion(robot, 6)
    for k in range(6):
        state = tree.solver.state(q[k], v[k], a[k])
        data.qpos[order], data.qvel[order], data.qacc[order] = state.q, state.v, state.a
        mujoco.mj_inverse(model, data)
        expected = state.G.T @ data.qfrc_inverse[order]
        ours = mechanism.inverse_dynamics(q[[k]], v[[k]], a[[k]])[0]
        assert_allclose(ours, expected, atol=1e-9 * max(1, np.abs(data.qfrc_inverse).max()))
