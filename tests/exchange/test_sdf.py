"""SDF as libsdformat reads it, in Drake: the same forces, and half a second that is ours."""

from __future__ import annotations

from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from tau_dyn.effects import SymmetricFriction
from tau_dyn.exchange import build_sdf
from tau_dyn.model import Model
from tau_dyn.robot import list_stock_robots, load_robot, load_robot_from_urdf
from tau_dyn.simulate import free_motion

ROBOTS = {
    "l1": lambda write: load_robot("gantry_tau"),
    "delta": lambda write: load_robot("delta"),
    "stewart": lambda write: load_robot("stewart"),
    "ur5": lambda write: load_robot("ur5"),
    "panda": lambda write: load_robot("panda"),
    "arm": lambda write: load_robot_from_urdf(write.two_link(), "arm"),
}


@pytest.fixture(params=ROBOTS)
def model(request, write) -> Model:
    """A robot with drive inertia and viscous friction of half its mass matrix' diagonal."""
    if request.param in ("ur5", "panda") and request.param not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    robot = ROBOTS[request.param](write)
    made = Model.of(robot, [SymmetricFriction(robot.actuated, robot.force_units)])
    mass = np.diag(made.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[0])
    sizes = [(f"{j}.{n}", 0.5 * m) for j, m in zip(robot.actuated, mass, strict=True) for n in ("armature", "viscous")]
    return made.with_values(dict(sizes))


def test_drake_reads_the_same_forces(model, in_drake, rng):
    """Over random states the tree's forces, projected through the loops, agree to 1e-7 of the largest."""
    robot = model.robot
    q = robot.home + rng.uniform(-0.03, 0.03, (3, robot.na))
    v, a = rng.standard_normal((2, 3, robot.na))
    want = model.torque(q, v, a, np.zeros_like(q))
    found = in_drake.compute_drake_forces(model, build_sdf(model).text, q, v, a)
    assert np.abs(found - want).max() < 1e-7 * np.abs(want).max()


def test_drake_moves_as_we_do(model, in_drake, rng):
    """Half a second of Drake, loops as ball constraints, ends within 0.1 % of our own motion."""
    robot = model.robot
    v0 = (0.02 if robot.source == "stewart" else 0.2) * rng.standard_normal(robot.na)
    room = np.minimum(robot.upper - robot.home, robot.home - robot.lower)  # limits are Drake's alone
    v0 = np.clip(v0, -room, room)
    weight = model.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[1]
    ours = free_motion(model, robot.home, v0, 0.5, dt=2.5e-4, tau=weight).q
    found = in_drake.move_in_drake(model, build_sdf(model).text, v0, weight, 0.5)
    assert np.abs(found - ours[-1]).max() < 1e-3 * np.ptp(ours, axis=0).max()


def test_what_sdf_lacks_is_said():
    """Drive inertia stands in Drake's extension alone, and a robot with loops counts from home."""
    robot = load_robot("gantry_tau", gravity_mass=22.38)
    model = Model.of(robot).with_values({f"{j}.armature": 3.0 for j in robot.actuated})
    made = build_sdf(model)
    for said in ("drive inertia of cart1, cart2, cart3", "count from home", "only gravity feels", "shapes"):
        assert any(said in sentence for sentence in made.left_out)
    limit = fromstring(made.text).find("model/joint[@name='cart1']/axis/limit")
    assert limit is not None
    low, high = (float(limit.findtext(x, "")) for x in ("lower", "upper"))
    assert low == pytest.approx(robot.lower[0] - robot.home[0]) and high == pytest.approx(
        robot.upper[0] - robot.home[0]
    )
    assert made.carried.robot.parameters["cart1.armature"].value == 0.0
