"""The geometry of rods: predictions close the rods, and all derivatives are those of the predictions."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import family_at, rods_of, spoiled

from tau_dyn.calibrate.laws import RodLoads
from tau_dyn.calibrate.rod_geometry import RodGeometry

ROBOTS = {
    "simplified": ({}, "nonparallel+periodic+piecewise+compliant"),
    "complete": ({"prototype": "d1", "arms": "complete"}, "paths+periodic+piecewise+compliant"),
    "f1": ({"name": "gantry_tau_f1"}, "complete"),
    "delta": ({"name": "delta"}, "complete"),
}


@pytest.fixture(params=ROBOTS, scope="module")
def rig(request):
    """A robot with every law that it can have, its parameters off nominal, and a few positions."""
    arguments, model = ROBOTS[request.param]
    rods, rng = rods_of(**arguments), np.random.default_rng(1)
    family = family_at(rods)
    geometry = family.build(family.spec(model))
    theta = spoiled(geometry, rng, 2e-3)
    for k, p in enumerate(geometry.parameters):
        if p.origin == "law" and not p.name.endswith("period"):
            theta[k] = {"m": 5e-5, "1": 1e-3, "m/N": 1e-7}[p.unit] * rng.standard_normal()
    q = rods.robot.home + 0.1 * rng.standard_normal((4, rods.na))
    return geometry, theta, q


def _difference(a, b):
    turn = Rotation.from_matrix(a.rotation @ np.swapaxes(b.rotation, 1, 2)).as_rotvec()
    return np.concatenate([a.position - b.position, turn], axis=1)


def test_predicted_poses_close_every_rod(rig):
    """A predicted pose leaves no gap between rod ends and carts."""
    geometry, theta, q = rig
    found = geometry.forward(theta, q)
    assert found.ok.all()
    assert np.abs(geometry.closure(theta, q, found.poses).gap).max() < 1e-9


def test_tool_moves_with_each_parameter_as_the_derivative_says(rig):
    """The tool's twist per parameter is the slope of the prediction, laws and turning joints included."""
    geometry, theta, q = rig
    at = geometry.forward(theta, q).poses
    columns = geometry.tool_by_parameter(theta, q, at)
    for k, p in enumerate(geometry.parameters):
        h = 1e-9 if p.unit == "m/N" else 1e-5
        step = h * np.eye(len(theta))[k]
        plus, minus = geometry.forward(theta + step, q, at).poses, geometry.forward(theta - step, q, at).poses
        slope = _difference(plus, minus) / (2 * h)
        assert np.abs(columns[:, :, k] - slope).max() < 3e-5 * max(np.abs(slope).max(), 1.0), p.name


def test_closure_turns_with_pose_parameters_and_joints_as_the_derivatives_say(rig):
    """Along a prediction the closure stays zero: its derivatives by pose, parameter and joint cancel."""
    geometry, theta, q = rig
    at = geometry.forward(theta, q).poses
    closure = geometry.closure(theta, q, at)
    by_parameter = closure.by_parameter + closure.by_pose @ geometry.tool_by_parameter(theta, q, at)
    by_joint = closure.by_joint + closure.by_pose @ geometry.tool_by_joint(theta, q, at)
    assert np.abs(by_parameter).max() < 1e-9
    assert np.abs(by_joint).max() < 1e-9


def test_tool_moves_with_each_joint_as_the_derivative_says():
    """The tool's twist per joint is the slope of the prediction, cyclic errors included."""
    rods = rods_of(prototype="d1", arms="complete")
    family = family_at(rods)
    geometry = family.build(family.spec("complete+periodic"), dict.fromkeys(rods.robot.actuated, 0.2))
    theta = spoiled(geometry, np.random.default_rng(2), cart2__error_sin=2e-3)
    q = rods.robot.home[None] + 0.05
    at = geometry.forward(theta, q).poses
    columns = geometry.tool_by_joint(theta, q, at)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        slope = (
            _difference(geometry.forward(theta, q + step, at).poses, geometry.forward(theta, q - step, at).poses) / 2e-6
        )
        np.testing.assert_allclose(columns[:, :, k], slope, atol=1e-5)


def test_turning_joint_keeps_a_unit_quaternion_and_its_gear():
    """However far a turning joint's frame is turned, its rotation stays one and its axis of unit length."""
    geometry = RodGeometry(rods_of("gantry_tau_f1"))
    theta = spoiled(geometry, np.random.default_rng(0), 0.3)
    for joint in geometry.numbers(theta).joints:
        if not joint.slides:
            assert np.linalg.norm(Rotation.from_matrix(joint.rotation).as_quat()) == pytest.approx(1.0, abs=1e-12)
            assert np.linalg.norm(joint.direction) == pytest.approx(1.0, abs=1e-12)


def test_unreachable_positions_are_told():
    """Carts too far apart leave no pose, and the prediction says so instead of making one up."""
    rods = rods_of()
    geometry = RodGeometry(rods)
    q = rods.robot.home + np.array([[0.0, 0.0, 0.0], [5.0, 0.0, -5.0]])
    found = geometry.forward(geometry.parameters.values, q)
    assert found.ok.tolist() == [True, False]
    assert np.isnan(found.poses.position[1]).all()
    assert found.reason[1]


def test_half_of_every_rod_hangs_on_the_plate():
    """A triangle of one link and two balls counts as two rods, which together weigh what the link weighs."""
    rods = rods_of("gantry_tau_queensland")
    masses = {link.link: float(link.nominal[0]) for link in rods.robot.links}
    of_rods = [mass for link, mass in masses.items() if link.startswith(("rod", "triangle"))]
    assert "triangle3_1" in rods.names and masses["triangle3_link"] > 0
    assert RodLoads(rods).half.sum() == pytest.approx(0.5 * sum(of_rods))
