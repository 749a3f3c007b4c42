"""An exported SDF in Drake, which reads it with libsdformat: its tree as it is, its balls and followers as constraints."""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, fromstring, tostring

import numpy as np
import pydrake.all as drake

from tau_dyn.mechanism import LoopSolver
from tau_dyn.model import Model

STEP_S = 5e-4  # as MuJoCo's


def read_in_drake(text: str, step: float = 0.0) -> Any:
    """Return Drake's plant of an SDF; Drake's parser takes no loops, so balls become constraints where time is discrete."""
    root = fromstring(text)
    top = root.find("model")
    assert top is not None
    balls = top.findall("joint[@type='ball']")
    for ball in balls:
        top.remove(ball)
    plant, at_rest = (_parse(root, x) for x in (step, 0.0))
    if step:
        at_rest.Finalize()
        for ball in balls:
            _tie(plant, at_rest, ball)
        for joint in (j for j in top.findall("joint") if j.find("axis/mimic") is not None):
            _couple(plant, joint)
    plant.Finalize()
    return plant


def _parse(root: Element, step: float) -> Any:
    plant = drake.MultibodyPlant(step)
    if step:  # the only solver that takes balls and followers
        plant.set_discrete_contact_approximation(drake.DiscreteContactApproximation.kSap)
    drake.Parser(plant).AddModelsFromString(tostring(root, encoding="unicode"), "sdf")
    return plant


def _tie(plant: Any, at_rest: Any, ball: Element) -> None:
    """Tie both ends of a ball where they meet as the file is read."""
    context = at_rest.CreateDefaultContext()
    names = [ball.findtext(end, "") for end in ("parent", "child")]
    place = np.array([float(x) for x in ball.findtext("pose", "").split()[:3]])
    frames = [at_rest.world_frame() if name == "world" else at_rest.GetFrameByName(name) for name in names]
    held = at_rest.CalcPointsPositions(context, frames[1], place, frames[0])[:, 0]
    a, b = (plant.world_body() if name == "world" else plant.GetBodyByName(name) for name in names)
    plant.AddBallConstraint(a, held, b, place)


def _couple(plant: Any, joint: Element) -> None:
    """Let a joint follow another, which Drake's parser leaves out."""
    mimic = joint.find("axis/mimic")
    assert mimic is not None
    ratio, offset = (float(mimic.findtext(key, "0")) for key in ("multiplier", "offset"))
    follower, leader = (plant.GetJointByName(x.get(key, "")) for x, key in ((joint, "name"), (mimic, "joint")))
    plant.AddCouplerConstraint(follower, leader, ratio, offset)


def list_places(plant: Any, model: Model) -> tuple[list[int], list[int]]:
    """Return where the joints of our tree stand in Drake's positions and speeds."""
    joints = [plant.GetJointByName(n) for n in list(model.robot.model.names)[1:]]
    return [j.position_start() for j in joints], [j.velocity_start() for j in joints]


def find_zero(model: Model) -> np.ndarray:
    """Return the positions (nv,) of our tree at which the file's joints are zero: home where there are loops."""
    robot, solver = model.robot, LoopSolver(model.robot)
    nothing = np.zeros(robot.na)
    return solver.state(robot.home, nothing, nothing).q if robot.loops else np.zeros(robot.model.nv)


def compute_drake_forces(model: Model, text: str, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return forces (N, na) without dry friction of Drake's inverse dynamics over the tree, projected through our loops."""
    plant, solver, zero = read_in_drake(text), LoopSolver(model.robot), find_zero(model)
    context, (places, dofs) = plant.CreateDefaultContext(), list_places(plant, model)
    found = np.empty_like(q)
    for k, state in enumerate(solver.state(*row) for row in zip(q, v, a, strict=True)):
        at, speed, change = np.zeros(plant.num_positions()), *np.zeros((2, plant.num_velocities()))
        at[places], speed[dofs], change[dofs] = state.q - zero, state.v, state.a
        plant.SetPositions(context, at)
        plant.SetVelocities(context, speed)
        elements = drake.MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, elements)
        found[k] = state.G.T @ plant.CalcInverseDynamics(context, change, elements)[dofs]
    return found


def move_in_drake(model: Model, text: str, v0: np.ndarray, force: np.ndarray, seconds: float) -> np.ndarray:
    """Return the actuated positions (na,) after a time from home under constant forces, within the file's effort limits."""
    robot, plant = model.robot, read_in_drake(text, STEP_S)
    simulator = drake.Simulator(plant)
    context = simulator.get_mutable_context()
    places, dofs = list_places(plant, model)
    at, speed = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
    state = LoopSolver(robot).state(robot.home, v0, 0 * v0)
    at[places], speed[dofs] = state.q - find_zero(model), state.v
    plant.SetPositions(context, at)
    plant.SetVelocities(context, speed)
    given = np.zeros(plant.num_actuators())
    for k in range(plant.num_actuators()):
        actuator = plant.get_joint_actuator(drake.JointActuatorIndex(k))
        given[actuator.input_start()] = force[robot.actuated.index(actuator.joint().name())]
    plant.get_actuation_input_port().FixValue(context, given)
    simulator.AdvanceTo(seconds)
    ends = [places[list(robot.model.names).index(j) - 1] for j in robot.actuated]
    offset = find_zero(model)[[list(robot.model.names).index(j) - 1 for j in robot.actuated]]
    return plant.GetPositions(context)[ends] + offset
